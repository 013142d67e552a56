# SPDX-License-Identifier: Apache-2.0
"""A recording as a camera: it is published into topics of ROS 2."""
