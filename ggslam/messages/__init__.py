# SPDX-License-Identifier: Apache-2.0
"""What is told of a map in messages, whoever takes them: nouns, and how ROS 2 and Foxglove write them."""
