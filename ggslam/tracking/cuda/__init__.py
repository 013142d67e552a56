# SPDX-License-Identifier: Apache-2.0
"""Tracking on an NVIDIA GPU."""
