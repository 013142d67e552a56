# SPDX-License-Identifier: Apache-2.0
"""Nearest neighbours on an NVIDIA GPU for the identity loss, by comparing with all points: unlike the tree of
`ggslam.mapping.cpu.neighbours` there is nothing to build or to go stale."""

from __future__ import annotations

import ctypes

import torch

from ggslam.abi.cuda import MOST_NEIGHBOURS, NeighbourJob
from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.system.tuning import Tuning


class CudaNeighbourTuning(Tuning):
    """Search for neighbours on a GPU."""

    distances_at_once = 1 << 24
    """Distances that are in memory at a time."""


def cuda_neighbours(points: torch.Tensor, rows: torch.Tensor, k: int, library: CudaLibrary) -> torch.Tensor:
    """The k nearest other points of some, in order of their distance. Started on torch's current stream; nothing waits.

    Another point is one of another number, be it at the same place. Of equally near ones the lowest numbers are taken
    (up to 32 neighbours; beyond that, where torch sorts all distances, any). Points that are not finite are nobody's
    neighbours and have none. A row that has fewer than k names itself in the last columns.

    Args:
        points: float32 [N, 3], N < 2^31.
        rows: int64 or int32 [M], numbers of points. That they are in range is not checked.
        k: number of neighbours, k >= 0.
        library: the compiled kernels.

    Returns:
        int64 [M, min(k, N - 1)].

    Raises:
        RenderError: an array has another shape, type or device.
    """
    _check(points, rows, library)
    k = max(0, min(k, points.shape[0] - 1))
    if k == 0 or rows.shape[0] == 0:
        return torch.empty(rows.shape[0], k, dtype=torch.int64, device=points.device)
    rows = rows.to(torch.int64).contiguous()
    if k > MOST_NEIGHBOURS:
        return _by_sorting(points, rows, k)
    job = NeighbourJob(device=points.device.index or 0, point_count=points.shape[0], row_count=rows.shape[0], k=k)
    found = torch.empty(rows.shape[0], k, dtype=torch.int64, device=points.device)
    size = library.functions.ggslam_cuda_neighbours_bytes(ctypes.byref(job))
    workspace = torch.empty(size, dtype=torch.uint8, device=points.device)
    job.points, job.rows, job.neighbours = points.data_ptr(), rows.data_ptr(), found.data_ptr()
    job.workspace, job.stream = workspace.data_ptr(), library.stream(points.device)
    library.call("neighbours", ctypes.byref(job))
    return found


def _check(points: torch.Tensor, rows: torch.Tensor, library: CudaLibrary) -> None:
    on_device = points.device.type == library.device_type and rows.device == points.device
    if points.dtype != torch.float32 or points.ndim != 2 or points.shape[1] != 3 or not on_device:
        found = f"{points.dtype} {list(points.shape)} on {points.device}"
        raise RenderError(f"points: expected torch.float32 [N, 3] on {library.device_type} as rows, found {found}")
    if not points.is_contiguous():
        raise RenderError(f"points: expected a contiguous tensor, found strides {points.stride()}")
    if rows.dtype not in (torch.int64, torch.int32) or rows.ndim != 1:
        raise RenderError(f"rows: expected integers [M], found {rows.dtype} {list(rows.shape)}")


def _by_sorting(points: torch.Tensor, rows: torch.Tensor, k: int) -> torch.Tensor:
    """The slower way, for more neighbours than a warp has lanes."""
    found = []
    for part in rows.split(max(1, CudaNeighbourTuning.distances_at_once // points.shape[0])):
        distances = torch.zeros(part.shape[0], points.shape[0], device=points.device)
        for coordinate in points.unbind(1):
            distances += (coordinate[part][:, None] - coordinate).square_()
        distances.scatter_(1, part[:, None], torch.inf).nan_to_num_(nan=torch.inf, posinf=torch.inf)
        nearest, index = distances.topk(k, dim=1, largest=False)
        found.append(torch.where(nearest < torch.inf, index, part[:, None]))
    return torch.cat(found)
