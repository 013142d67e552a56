# SPDX-License-Identifier: Apache-2.0
"""Work on the cells of grid stores, whatever the work is."""
