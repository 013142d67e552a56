# SPDX-License-Identifier: Apache-2.0
"""Paths through maps: what `ggslam plan` does."""
