# SPDX-License-Identifier: Apache-2.0
"""Detection of movers on an NVIDIA GPU."""
