# SPDX-License-Identifier: Apache-2.0
"""Poses and exposures of the keyframes on an NVIDIA GPU, where they are optimised along with the map.

An iteration reads them there and steps them there, so that the host never waits for a gradient. The arithmetic is that
of `PoseAdam`, `ExposureAdam` and the sums of `Mapper.iterate`, in double precision.
"""

from __future__ import annotations

import ctypes
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np
import torch

from ggslam.abi.cuda import AdamMoments, KeyframeState, KeyframeStepJob, KeyframeWriteJob
from ggslam.cuda.library import CudaLibrary, library_and_device
from ggslam.cuda.streams import let_go
from ggslam.cuda.transfers import upload
from ggslam.errors import RenderError
from ggslam.mapping.losses import LossValues
from ggslam.mapping.settings import ExposureSettings
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning

_RESULTS = torch.Size([len(LossValues.__dataclass_fields__) + 6])
_TWIST, _FLAG = torch.Size([6]), torch.Size([1])


class KeyframeStateTuning(Tuning):
    """Table of the keyframes' poses and exposures on a GPU."""

    initial_rows = 64
    """Rows allocated at the start."""


@dataclass(frozen=True)
class IterationSums:
    """Of all iterations so far that were not skipped; see `LossValues`.

    Attributes:
        total, color, ssim, depth: sums of these terms.
        last_psnr: of the last iteration, NaN before the first.
        iterations: how many there were.
    """

    total: float
    color: float
    ssim: float
    depth: float
    last_psnr: float
    iterations: int


class KeyframeStates:
    """A table on the device with one row for each keyframe. Work is only started, on torch's current stream, but for
    the methods whose names begin with `read`. One instance serves one caller and one stream at a time; `read_poses`
    and `read_exposures` may be called from other threads meanwhile.

    Args:
        device: CUDA device; None: the current one.
        library: the compiled kernels; None: those of the device, compiled if need be.

    Raises:
        MissingDependency: no CUDA device, or the kernels cannot be compiled.
        NativeCoreError: the compiled kernels do not fit this code.
    """

    def __init__(self, device: torch.device | str | None = None, library: CudaLibrary | None = None) -> None:
        self.library, self.device = library_and_device(device, library)
        self._count = 0
        self._stream: torch.cuda.Stream | None = None  # that rows were written on last
        self._use(self._new_table(KeyframeStateTuning.initial_rows))
        self.report = torch.zeros(7, dtype=torch.float64, device=self.device)
        """On the device, to be fetched as one: `totals`, then eight bytes that are the caller's."""
        self.totals = self.report[:6]
        """On the device, float64 [6]: the numbers of `IterationSums` in their order."""
        self.totals[4].fill_(torch.nan)
        self._step_job = KeyframeStepJob(device=self.device.index or 0, totals=self.totals.data_ptr())
        self._changes = 0
        self._read_table: tuple[int, np.ndarray] = (-1, np.empty((0, 0), np.uint8))  # after so many changes
        self._read_sums: IterationSums | None = None

    def __len__(self) -> int:
        return self._count

    # --- one keyframe ------------------------------------------------------------------------------------------------

    def append(self, T_camera_world: np.ndarray, exposure: np.ndarray) -> int:
        """Adds a keyframe, for which no step was made yet; returns its number. Views of other keyframes that were
        handed out before are invalid afterwards: the table may have moved.

        Args:
            T_camera_world: [4, 4].
            exposure: gain and offset per channel [3, 2].

        Raises:
            RenderError: another shape.
        """
        if self._count == len(self.table):
            table = self._new_table(2 * self._count)
            table[: self._count] = self.table
            let_go(self.table)
            self._use(table)
        self._write(self._count, T_camera_world, exposure)
        self._count += 1
        self._changes += 1  # whoever read before that has a row too few
        return self._count - 1

    def pose(self, i: int) -> torch.Tensor:
        """First three rows of keyframe i's T_camera_world, as the rasterizer takes them: a view, float32 [12], that
        changes with its steps; valid until the next `append`."""
        return self._poses[self._check_index(i)]

    def exposure(self, i: int) -> torch.Tensor:
        """Keyframe i's exposure, as the image loss takes it: a view, float32 [3, 2], as `pose`."""
        return self._exposures[self._check_index(i)]

    def exact_pose(self, i: int) -> torch.Tensor:
        """Keyframe i's T_camera_world: a view, float64 [4, 4], as `pose`."""
        return self._doubles_of(KeyframeState.pose, i).view(4, 4)

    def step(
        self,
        i: int,
        twist: torch.Tensor,
        loss_results: torch.Tensor,
        skipped: torch.Tensor | None = None,
        pose_rate: float = 0.0,
        exposure: ExposureSettings | None = None,
    ) -> None:
        """Pose and exposure of keyframe i follow their gradients, and the terms of the loss are added to the sums.

        A gradient with a number that is not finite is passed over, that of the pose and that of the exposure each by
        itself.

        Args:
            twist: d loss / d xi, float64 [6], see `CudaGradients`.
            loss_results: `CudaLossResult.results`, float64 [15].
            skipped: int32 [1], such as the rasterizer's `last_overflowed`: where it is not 0, nothing changes, the
                sums neither. None: it is 0.
            pose_rate: size of the pose's step in metres and radians; 0: the pose stays.
            exposure: rate and regularization of the exposure; None: it stays.

        Raises:
            IndexError: no such keyframe.
            RenderError: a tensor of another type, shape or device.
        """
        job = self._step_job
        job.state = self.address(i)
        job.twist = self._pointer_of("twist", twist, torch.float64, _TWIST)
        job.results = self._pointer_of("loss_results", loss_results, torch.float64, _RESULTS)
        job.skipped = None if skipped is None else self._pointer_of("skipped", skipped, torch.int32, _FLAG)
        job.pose_rate, job.step_exposure = pose_rate, exposure is not None
        if exposure is not None:
            job.exposure_rate, job.exposure_regularization = exposure.rate, exposure.regularization
        job.stream = self.begin_steps()
        self.library.call("keyframe_step", ctypes.byref(job))
        self.note_steps()

    def begin_steps(self) -> int | None:
        """Others are about to start steps, with `address` and `totals`; returns the stream for them."""
        if self.library.device_type == "cuda":
            self._stream = torch.cuda.current_stream(self.device)
        return self.library.stream(self.device)

    def note_steps(self) -> None:
        """They have started them. What another thread reads meanwhile is of before, and not kept for what comes after.
        """
        self._changes += 1
        self._read_sums = None

    def write_pose(self, i: int, T_camera_world: np.ndarray) -> None:
        """Sets keyframe i's pose [4, 4]; the moments of its steps stay.

        Raises:
            IndexError: no such keyframe.
            RenderError: another shape.
        """
        self._write(self._check_index(i), T_camera_world, None)

    def write_exposure(self, i: int, exposure: np.ndarray) -> None:
        """Sets keyframe i's exposure [3, 2]; the moments of its steps stay."""
        given = self._upload_exposure(exposure)
        self._doubles_of(KeyframeState.exposure, i).copy_(given)
        self._exposures[self._check_index(i)].copy_(given.view(3, 2))
        self._changes += 1

    def write_anchor(self, i: int, anchor: np.ndarray) -> None:
        """Sets the exposure [3, 2] to which steps pull keyframe i's; at first it is the identity."""
        self._doubles_of(KeyframeState.exposure_anchor, i).copy_(self._upload_exposure(anchor))

    def scale_gradients(self, gain: np.ndarray) -> None:
        """The moments of all exposures follow a map that became `gain` [3] times as bright: gradients with respect to
        a gain are as large as the map is bright."""
        offset, rows = KeyframeState.exposure_moments.offset, self.table[: self._count]
        moments = rows[:, offset : offset + ctypes.sizeof(AdamMoments)].view(torch.float64).view(-1, 2, 3, 2)
        factors = upload(np.stack([gain, np.square(gain)]).astype(np.float64), self.device)
        moments[..., 0].mul_(factors)
        self._changes += 1

    def write_poses(self, T_camera_world: np.ndarray) -> None:
        """Sets the poses of all keyframes [K, 4, 4], as `write_pose`."""
        if len(T_camera_world) != self._count:
            raise RenderError(f"T_camera_world: expected {quantity(self._count, 'pose')}, found {len(T_camera_world)}")
        for i, pose in enumerate(T_camera_world):
            self.write_pose(i, pose)

    # --- all of them, on the host ------------------------------------------------------------------------------------

    def read_poses(self) -> np.ndarray:
        """T_camera_world of all keyframes, float64 [K, 4, 4]. Waits for the device, unless nothing changed since."""
        return self._read_doubles(KeyframeState.pose).reshape(-1, 4, 4)

    def read_exposures(self) -> np.ndarray:
        """Exposures of all keyframes, float64 [K, 3, 2], as `read_poses`."""
        return self._read_doubles(KeyframeState.exposure).reshape(-1, 3, 2)

    def read_sums(self) -> IterationSums:
        """The sums so far. Waits for the device, unless nothing was added since."""
        if self._read_sums is None:
            total, color, ssim, depth, last_psnr, iterations = self.totals.tolist()
            self._read_sums = IterationSums(total, color, ssim, depth, last_psnr, int(iterations))
        return self._read_sums

    # --- the table ---------------------------------------------------------------------------------------------------

    def _new_table(self, rows: int) -> torch.Tensor:
        return torch.empty(rows, ctypes.sizeof(KeyframeState), dtype=torch.uint8, device=self.device)

    def _use(self, table: torch.Tensor) -> None:
        self.table = table
        """On the device, uint8, a row for each keyframe; another tensor after an `append` that found no room."""
        for_rasterizer, for_loss = KeyframeState.pose_copy.offset // 4, KeyframeState.exposure_copy.offset // 4
        numbers = table.view(torch.float32)
        self._poses = numbers[:, for_rasterizer : for_rasterizer + 12]
        self._exposures = numbers[:, for_loss : for_loss + 6].unflatten(1, (3, 2))

    def _doubles_of(self, field: ctypes._CField, i: int) -> torch.Tensor:
        """Doubles of keyframe i's row, a view [n]."""
        return self.table[self._check_index(i), field.offset : field.offset + field.size].view(torch.float64)

    def _upload_exposure(self, exposure: np.ndarray) -> torch.Tensor:
        """float64 [6] on the device."""
        if np.shape(exposure) != (3, 2):
            raise RenderError(f"exposure of a keyframe: expected [3, 2], found {list(np.shape(exposure))}")
        return upload(np.asarray(exposure, np.float64).reshape(-1), self.device)

    def _check_index(self, i: int) -> int:
        if not 0 <= i < self._count:
            raise IndexError(f"keyframe {i} of {self._count}")
        return i

    def address(self, i: int) -> int:
        """Of keyframe i's row; valid until the next `append`."""
        return self.table.data_ptr() + self._check_index(i) * ctypes.sizeof(KeyframeState)

    def _write(self, i: int, T_camera_world: np.ndarray, exposure: np.ndarray | None) -> None:
        job = KeyframeWriteJob(stream=self.begin_steps(), device=self.device.index or 0)
        job.state = self.table.data_ptr() + i * ctypes.sizeof(KeyframeState)
        for name, array, shape in (("pose", T_camera_world, (4, 4)), ("exposure", exposure, (3, 2))):
            if array is None:
                continue
            if np.shape(array) != shape:
                raise RenderError(f"{name} of a keyframe: expected {list(shape)}, found {list(np.shape(array))}")
            getattr(job, name)[:] = np.asarray(array, np.float64).ravel().tolist()
        job.is_new = exposure is not None
        self.library.call("keyframe_write", ctypes.byref(job))
        self._changes += 1

    def _read_doubles(self, field: ctypes._CField) -> np.ndarray:
        after, table = self._read_table
        changes = self._changes  # as of before the copy: another thread may go on meanwhile
        if after != changes:
            with self.in_turn():
                table = self.table[: self._count].cpu().numpy().copy()
            self._read_table = changes, table
        part = table[:, field.offset : field.offset + field.size]
        return part.copy().view(np.float64)

    def in_turn(self) -> AbstractContextManager[object]:
        """Within, this thread works on the stream that the rows are written on: what it reads is between two steps."""
        return nullcontext() if self._stream is None else torch.cuda.stream(self._stream)

    def _pointer_of(self, name: str, tensor: torch.Tensor, dtype: torch.dtype, shape: torch.Size) -> int:
        if tensor.dtype != dtype or tensor.shape != shape or tensor.device != self.device:
            expected, found = f"{dtype} {list(shape)} on {self.device}", f"{tensor.dtype} {list(tensor.shape)}"
            raise RenderError(f"{name}: expected {expected}, found {found} on {tensor.device}")
        if not tensor.is_contiguous():
            raise RenderError(f"{name}: expected a contiguous tensor, found strides {tensor.stride()}")
        return tensor.data_ptr()
