# SPDX-License-Identifier: Apache-2.0
"""Maps on disk, cut in cells of a grid, of which only the neighbourhood of the sensor is in memory."""
