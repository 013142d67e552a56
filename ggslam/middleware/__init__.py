# SPDX-License-Identifier: Apache-2.0
"""Messages of ROS 2 over the network, without ROS: their types, and the nodes that send and take them."""
