# SPDX-License-Identifier: Apache-2.0
"""Many like pieces of work at once: in processes of this machine, or on a Ray cluster."""
