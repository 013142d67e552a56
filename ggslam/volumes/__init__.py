# SPDX-License-Identifier: Apache-2.0
"""Volumetric maps that planners read: TSDF and mesh, distance field, occupancy."""
