# SPDX-License-Identifier: Apache-2.0
"""A map for robots: what is published of it, and what can be asked of it."""
