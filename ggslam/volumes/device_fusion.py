# SPDX-License-Identifier: Apache-2.0
"""TSDF and distance field of a recording on a device: by CUDA kernels where there are any, else the TSDF in torch."""

from __future__ import annotations

import numpy as np
import torch

from ggslam.errors import ConfigError, MissingDependency
from ggslam.native.loader import NativeContext
from ggslam.scene.camera import Camera
from ggslam.volumes.cuda.field import CudaField
from ggslam.volumes.cuda.tsdf import CudaTsdf
from ggslam.volumes.esdf import DistanceField
from ggslam.volumes.tsdf import TsdfMap
from ggslam.volumes.tsdf_torch import TorchTsdf
from ggslam.volumes.volume_settings import VolumeSettings


class DeviceFusion:
    """Maps on a device until all is fused.

    Args:
        device: of torch.
        settings: of the volumes.
        onto: a TSDF that was to be gone on with.
        esdf: whether a distance field is wanted.

    Raises:
        ConfigError: no such device, or something is wanted that is not done on one.
    """

    def __init__(self, device: str, settings: VolumeSettings, onto: TsdfMap | None, esdf: bool) -> None:
        if onto is not None or settings.decay_every:
            raise ConfigError("`device`: on a device a TSDF neither decays nor is one gone on with")
        self._device, self._esdf = _find_device(device), esdf
        self._field: CudaField | None = None
        self._tsdf = self._begin(settings)

    def begin(self, settings: VolumeSettings) -> None:
        """Begins anew, from nothing."""
        if isinstance(self._tsdf, CudaTsdf):
            self._tsdf.clear()  # nothing under way holds its memory any more
            if settings == self._settings:
                return
        self._tsdf = self._begin(settings)

    def _begin(self, settings: VolumeSettings) -> CudaTsdf | TorchTsdf:
        self._settings, self._field = settings, None
        if self._device.type == "cuda":
            try:
                tsdf = CudaTsdf(settings.tsdf, self._device, self._esdf)
                self._field = CudaField(tsdf, settings.esdf) if self._esdf else None
                return tsdf
            except MissingDependency:
                pass  # no nvcc: in torch, slower
        return TorchTsdf(settings.tsdf, self._device, self._esdf)

    def __len__(self) -> int:
        """Number of blocks; of the CUDA kernels, some frames ago."""
        return self._tsdf.recent_blocks if isinstance(self._tsdf, CudaTsdf) else len(self._tsdf)

    def integrate(
        self, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray, color: np.ndarray | None = None,
        labels: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Fuses a view, see `TsdfMap.integrate`."""
        self._tsdf.integrate(depth, camera, T_world_camera, color, labels)

    def update_field(self) -> None:
        """Starts to bring the distance field up to date; in torch it waits for the end."""
        if self._field is not None:
            self._field.update()

    def to_native(self, context: NativeContext) -> tuple[TsdfMap, DistanceField | None]:
        """TSDF and distance field in the compiled core; waits for the device."""
        if self._field is not None:
            self._field.update()
        tsdf = self._tsdf.to_native(context)
        if self._field is not None:
            return tsdf, self._field.to_native(tsdf)
        return tsdf, DistanceField(tsdf, self._settings.esdf) if self._esdf else None


def _find_device(device: str) -> torch.device:
    try:
        torch.zeros(1, device=device).cpu()
        return torch.device(device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ConfigError(f"`device` {device}: {str(error).splitlines()[0]}") from None
