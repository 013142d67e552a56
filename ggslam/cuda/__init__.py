# SPDX-License-Identifier: Apache-2.0
"""The CUDA kernels of all parts (kernels/), compiled by nvcc when first used, and what calling them takes."""
