# SPDX-License-Identifier: Apache-2.0
"""Maps that robots drive by: bands of heights, costs, the robot's own body, what moves."""
