# SPDX-License-Identifier: Apache-2.0
"""ggslam: RGB-D Gaussian SLAM that runs on two CPU cores."""

import os as _os

# With one other busy process, OpenMP's spinning barriers make torch's own operators many times slower; this must be
# set before torch is imported for the first time.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
