# SPDX-License-Identifier: Apache-2.0
"""What is different between two visits: what `ggslam changes` does."""
