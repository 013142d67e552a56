# SPDX-License-Identifier: Apache-2.0
"""Image features: what tells a place from another, and a pose from matches."""
