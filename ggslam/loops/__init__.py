# SPDX-License-Identifier: Apache-2.0
"""Closing loops: which old keyframes see the same place, whether they really do, and what that means for all poses."""
