# SPDX-License-Identifier: Apache-2.0
"""What moves while a recording is made: found in each frame, kept out of the map."""
