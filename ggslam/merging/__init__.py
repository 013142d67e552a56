# SPDX-License-Identifier: Apache-2.0
"""One map from many: common ground of finished runs, one graph over their keyframes, one map and one set of objects."""
