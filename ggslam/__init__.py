# SPDX-License-Identifier: Apache-2.0
"""ggslam: RGB-D Gaussian SLAM that runs on two CPU cores."""

import os as _os

# With one other busy process, OpenMP's spinning barriers make torch's own operators many times slower; this must be
# set before torch is imported for the first time.
_os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# And after every matrix product the threads of numpy's and scipy's OpenBLAS spin for milliseconds, on a core that the
# compiled core needs: learning objects took twice as much processor time (2^4 cycles instead of 2^26).
_os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")

__version__ = "0.1.0"
