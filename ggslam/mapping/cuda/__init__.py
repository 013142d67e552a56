# SPDX-License-Identifier: Apache-2.0
"""Mapping on an NVIDIA GPU."""
