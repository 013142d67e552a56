# SPDX-License-Identifier: Apache-2.0
"""What is different between two visits to one place."""
