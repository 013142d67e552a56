# SPDX-License-Identifier: Apache-2.0
"""Signed distances, the distance field made of them, and rays cast into them, by the CUDA kernels."""
