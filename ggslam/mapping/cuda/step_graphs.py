# SPDX-License-Identifier: Apache-2.0
"""CUDA graphs of training steps, which the library makes of steps that are made again."""

from __future__ import annotations

import ctypes

from ggslam.abi.cuda import GraphCounts
from ggslam.cuda.library import CudaLibrary


class StepGraphs:
    """A place where the library keeps graphs of the steps that one thread makes.

    Args:
        library: the kernels.
        device_index: of the CUDA device.
    """

    def __init__(self, library: CudaLibrary, device_index: int) -> None:
        self._library = library
        self.handle = ctypes.c_void_p()
        library.call("graphs_create", device_index, ctypes.byref(self.handle))

    @property
    def counts(self) -> GraphCounts:
        """What became of the steps so far."""
        counts = GraphCounts()
        self._library.functions.ggslam_cuda_graph_counts(self.handle, ctypes.byref(counts))
        return counts

    def __del__(self) -> None:
        if self.handle:
            self._library.functions.ggslam_cuda_graphs_destroy(self.handle)
