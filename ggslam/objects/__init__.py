# SPDX-License-Identifier: Apache-2.0
"""Objects: segments become objects, objects are listed, edited and taken out of the map."""
