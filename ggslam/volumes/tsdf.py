# SPDX-License-Identifier: Apache-2.0
"""A truncated signed distance field of what a depth camera saw, in blocks of 8^3 voxels found by hashing.

Voxel (i, j, k) of block (x, y, z) has its centre at (8 x + i + 0.5, 8 y + j + 0.5, 8 z + k + 0.5) voxels from the map's
origin, in the frame of the poses. The map's origin is the frame's own unless the first camera is far from it, where
voxels could not be numbered nor vertices be placed in single precision (`scene.origin`). Blocks that are free space
throughout are remembered as such and hold no voxels.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np

from ggslam.abi.core import FusionSettings, FusionStats, VoxelArrays
from ggslam.errors import CoreInputError, InputError, VoxelError
from ggslam.native.loader import NativeContext, load_library
from ggslam.scene.camera import Camera
from ggslam.scene.frame_checks import wrong_unit
from ggslam.scene.origin import local_origin, moved_pose
from ggslam.volumes.fusion_view import FusionView
from ggslam.volumes.settings import INTEGRATORS, TsdfSettings
from ggslam.volumes.working_voxel import working_voxel

SIDE: Final = 8
"""Voxels along the edge of a block."""
VOXELS = SIDE**3
FREE_VALUE: Final = 32767
"""Value of a free voxel: the largest of 16 bits."""
FULL_WEIGHT: Final = 65535
"""The largest weight: 16 bits."""
LEAST_WEIGHT: Final = 65
"""Decay forgets voxels of less weight; 65535 is full."""
MOST_VOXELS: Final = 1e9
"""Voxels farther from the origin than this cannot be numbered."""
_DTYPES = {"value": np.int16, "weight": np.uint16, "label": np.uint16, "color": np.uint8, "votes": np.uint8,
           "hits": np.uint8, "octants": np.uint8}  # fmt: skip
OCCUPIED_HITS: Final = 128
"""Evidence from which a voxel holds measured points; the compiled core counts in 8 bits."""


@dataclass(frozen=True)
class BlockList:
    """The blocks of a map.

    Attributes:
        coordinates: int32 [B, 3].
        dense: bool [B], whether a block has voxels; the others are free throughout.
        free_weight: uint16 [B], weight of the others' voxels, in 65535ths of the largest.
        frozen: bool [B], whether decay leaves a block alone.
        revision: uint32 [B], the map's `revision` when the block last changed.
    """

    coordinates: np.ndarray
    dense: np.ndarray
    free_weight: np.ndarray
    frozen: np.ndarray
    revision: np.ndarray


@dataclass(frozen=True)
class BlockVoxels:
    """Voxels of blocks; row i + 8 j + 64 k of a block is its voxel (i, j, k).

    Attributes:
        value: int16 [B, 512], signed distance in 32767ths of the truncation, positive in front of the surface.
        weight: uint16 [B, 512], in 65535ths of the largest; 0: never seen.
        color: uint8 [B, 512, 3].
        label: uint16 [B, 512], the object; 0: none.
        votes: uint8 [B, 512], for the label, less those against it.
        hits: uint8 [B, 512], evidence of measured points in the voxel: log-odds in steps of 1 / 23.6 above 128, of hits
            and misses that count as those of `OccupancySettings.with_raised_odds`; 0: none.
        octants: uint8 [B, 512], where in the voxel they lie: octant (x, y, z) is bit x + 2 y + 4 z.
    """

    value: np.ndarray
    weight: np.ndarray
    color: np.ndarray
    label: np.ndarray
    votes: np.ndarray
    hits: np.ndarray
    octants: np.ndarray


@dataclass(frozen=True)
class IntegrationStats:
    """What fusing one view did.

    Attributes:
        blocks: blocks that the view tells about (with a surface, or free throughout, or with voxels in view).
        updated: of them, those whose voxels were updated.
        made: blocks new to the map.
        freed: blocks that became free throughout and gave their voxels back.
        prepare_ms, select_ms, update_ms: time for the images, for finding the blocks, and for their voxels.
    """

    blocks: int
    updated: int
    made: int
    freed: int
    prepare_ms: float
    select_ms: float
    update_ms: float

    @property
    def milliseconds(self) -> float:
        """The whole."""
        return self.prepare_ms + self.select_ms + self.update_ms


class TsdfMap:
    """The map; its memory belongs to the compiled core.

    Args:
        settings: of the fusion.
        context: threads to work on.
        origin: where in the world blocks are counted from, [3] metres; None: as goes with the first view.
        points: whether measured points are counted, of which a distance field and ROS maps have what is thinner than a
            voxel; a mesh does not need them. They are in any case where some were written.
    """

    def __init__(
        self, settings: TsdfSettings | None = None, context: NativeContext | None = None,
        origin: np.ndarray | None = None, points: bool = True,
    ) -> None:  # fmt: skip
        self.settings, self.points = settings or TsdfSettings(), points
        self.origin = np.zeros(3) if origin is None else np.array(origin, np.float64)
        self._has_origin = origin is not None
        self.context = context or NativeContext()
        self._library = load_library()
        self._handle: int | None = self._library.ggslam_tsdf_create(
            self.settings.voxel, self.settings.truncation, self.settings.max_weight
        )

    def __del__(self) -> None:
        if getattr(self, "_handle", None) is not None:
            self._library.ggslam_tsdf_destroy(self._handle)

    @property
    def handle(self) -> int:
        """Pointer for the core."""
        assert self._handle is not None
        return self._handle

    def __len__(self) -> int:
        """Number of blocks."""
        return int(self._library.ggslam_tsdf_size(self.handle))

    @property
    def dense_blocks(self) -> int:
        """Blocks with voxels."""
        return int(self._library.ggslam_tsdf_dense(self.handle))

    @property
    def memory_bytes(self) -> int:
        """Memory held by the map."""
        return int(self._library.ggslam_tsdf_bytes(self.handle))

    @property
    def revision(self) -> int:
        """Counts the changes of the map."""
        return int(self._library.ggslam_tsdf_revision(self.handle))

    # --- fusion ------------------------------------------------------------------------------------------------------

    def integrate(
        self,
        depth: np.ndarray,
        camera: Camera,
        T_world_camera: np.ndarray,
        color: np.ndarray | None = None,
        labels: np.ndarray | None = None,
        within: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> IntegrationStats:
        """Fuses a view.

        Every voxel of a block near a measured surface, or between it and the camera, is projected into the depth image
        and averaged with sdf = clamp(depth - z, -truncation, truncation), of weight 1 / z^2 that drops linearly from
        one voxel to the truncation behind the surface (B. Curless and M. Levoy, "A volumetric method for building
        complex models from range images", 1996; weights as in H. Oleynikova et al., "Voxblox", 2017). What lies farther
        behind the surface, and what has no depth, stays as it is. Depth beyond the range is no surface's, but frees
        what lies before it, up to the range. Voxels within the truncation take the pixel's colour; those within two
        voxels of the surface vote for its label (R. Boyer and J. Moore's majority vote).

        Args:
            depth: float32 [H, W], metres along the optical axis; 0, negative, NaN or nearer than the range: none. +inf:
                the sensor found nothing (REP 117), so all is free up to the range.
            camera: of the images.
            T_world_camera: [4, 4] pose.
            color: uint8 [H, W, 3].
            labels: uint16 [H, W], 0: none.
            within: least and greatest coordinates [3] of blocks; others stay as they are. None: all.

        Raises:
            VoxelError: the view shows too many blocks for voxels of this size. Where these are free space before depth
                beyond the range, that depth is left out instead.
            InputError: an image of another size or kind than the camera's, a pose that is not finite and rigid, or
                depth that cannot be in metres.
        """
        limit = MOST_VOXELS * self.settings.voxel
        view = FusionView(depth, camera, self._relative_pose(T_world_camera), color, labels, limit)
        s, stats = self.settings, FusionStats()
        if within is None and has_beyond(view.depth, s.max_depth) and (unit := wrong_unit(view.depth)):
            raise InputError(unit)
        numbers = FusionSettings(
            s.min_depth, s.max_depth, s.free_share, s.edge_voxels * s.voxel, s.clearing, s.max_free_weight,
            INTEGRATORS.index(s.integrator), s.least_rays, int(self.points),
        )  # fmt: skip
        if within is not None:
            low, high = (np.asarray(ends).astype(int).tolist() for ends in within)
            numbers.bounded, numbers.low[:], numbers.high[:] = 1, low, [end + 1 for end in high]
        try:
            self._library.ggslam_tsdf_integrate(
                self.handle, self.context.handle, ctypes.byref(view.structure()), ctypes.byref(numbers),
                ctypes.byref(stats),
            )  # fmt: skip
        except CoreInputError as error:
            if "blocks" in str(error) and (view.depth > s.max_depth).any():
                near = np.where(view.depth <= s.max_depth, view.depth, np.float32(0))
                return self.integrate(near, camera, T_world_camera, color, labels, within)
            raise self._too_small(error, view.depth, camera, T_world_camera) from None
        return IntegrationStats(*(getattr(stats, field.name) for field in fields(IntegrationStats)))

    def _relative_pose(self, T_world_camera: np.ndarray) -> np.ndarray:
        """The pose relative to the map's origin, which the first view decides."""
        T = np.asarray(T_world_camera, np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            return T  # is refused
        if not self._has_origin:
            self.origin, self._has_origin = local_origin(T[:3, 3]), True
        return moved_pose(T, -self.origin)

    def _too_small(
        self, error: InputError, depth: np.ndarray, camera: Camera, T_world_camera: np.ndarray
    ) -> InputError:
        """The core's refusal of a view; where that shows too many blocks, one that names voxels that work."""
        if "blocks" not in str(error):
            return error

        def blocks_of(edge: float) -> int:
            other = TsdfMap(replace(self.settings, voxel=edge), self.context, points=False)
            other.integrate(depth, camera, T_world_camera)
            return other.dense_blocks

        works = working_voxel(blocks_of, self.settings.voxel)
        if works is None:
            return error
        seen = depth[(depth > 0) & (depth <= self.settings.max_depth)]
        return VoxelError(
            f"voxels of {self.settings.voxel:g} m are too small for a view that shows depth up to "
            f"{float(seen.max()):.3g} m: {works:g} m works"
        )

    def decay(self, spare_in_view: bool = False) -> int:
        """Lets the map forget: all weights are multiplied by `TsdfSettings.decay`.

        Voxels of less than a thousandth of the largest weight are forgotten, and blocks without others erased. Frozen
        blocks stay as they are.

        Args:
            spare_in_view: blocks that the last view told about keep their weights, too.

        Returns:
            Number of blocks erased.
        """
        return int(
            self._library.ggslam_tsdf_decay(
                self.handle, self.context.handle, self.settings.decay, LEAST_WEIGHT, int(spare_in_view)
            )
        )

    # --- blocks ------------------------------------------------------------------------------------------------------

    def blocks(self) -> BlockList:
        """All blocks, in no particular order."""
        n = len(self)
        coordinates, dense, frozen = np.empty((n, 3), np.int32), np.empty(n, np.uint8), np.empty(n, np.uint8)
        free_weight, revision = np.empty(n, np.uint16), np.empty(n, np.uint32)
        self._library.ggslam_tsdf_list(
            self.handle, *(a.ctypes.data for a in (coordinates, dense, free_weight, frozen, revision))
        )
        return BlockList(coordinates, dense.astype(bool), free_weight, frozen.astype(bool), revision)

    def read(self, coordinates: np.ndarray) -> BlockVoxels:
        """Voxels of the blocks at coordinates [n, 3], from the origin; of a block that is not there, as never seen."""
        at = _coordinates(coordinates)
        shapes = {name: (len(at), VOXELS) + ((3,) if name == "color" else ()) for name in _DTYPES}
        arrays = {name: np.empty(shapes[name], dtype) for name, dtype in _DTYPES.items()}
        pointers = VoxelArrays(**{name: array.ctypes.data for name, array in arrays.items()})
        self._library.ggslam_tsdf_read(self.handle, len(at), at.ctypes.data, ctypes.byref(pointers))
        return BlockVoxels(**arrays)

    def write(self, coordinates: np.ndarray, **voxels: np.ndarray) -> None:
        """Writes voxels of the blocks at coordinates [n, 3], which are made where there are none.

        Args:
            coordinates: of the blocks.
            voxels: `value`, `weight`, `color`, `label`, `votes`, `hits`, `octants` as in `BlockVoxels`; what is not
                given stays.

        Raises:
            InputError: an array of another name or shape.
        """
        at = _coordinates(coordinates)
        arrays = {}
        for name, array in voxels.items():
            if name not in _DTYPES:
                raise InputError(f"expected some of {', '.join(_DTYPES)}, found {name!r}")
            arrays[name] = np.ascontiguousarray(array, _DTYPES[name])
            expected = (len(at), VOXELS) + ((3,) if name == "color" else ())
            if arrays[name].shape != expected:
                raise InputError(f"{name}: expected shape {expected}, found {arrays[name].shape}")
        pointers = VoxelArrays(**{name: array.ctypes.data for name, array in arrays.items()})
        self._library.ggslam_tsdf_write(self.handle, len(at), at.ctypes.data, ctypes.byref(pointers))

    def write_free(self, coordinates: np.ndarray, weight: np.ndarray) -> None:
        """Makes the blocks at coordinates [n, 3] free throughout, with weights uint16 [n] of 65535."""
        at, weights = _coordinates(coordinates), np.ascontiguousarray(weight, np.uint16)
        if weights.shape != (len(at),):
            raise InputError(f"weight: expected shape {(len(at),)}, found {weights.shape}")
        self._library.ggslam_tsdf_write_free(self.handle, len(at), at.ctypes.data, weights.ctypes.data)

    def erase(self, coordinates: np.ndarray) -> None:
        """Forgets the blocks at coordinates [n, 3], where there are any."""
        at = _coordinates(coordinates)
        self._library.ggslam_tsdf_erase(self.handle, len(at), at.ctypes.data)

    def clear(self) -> None:
        """Forgets everything."""
        self._library.ggslam_tsdf_clear(self.handle)

    def freeze(self, frozen: bool = True) -> None:
        """From now on decay leaves all blocks that are there alone (or no longer)."""
        self._library.ggslam_tsdf_freeze(self.handle, int(frozen))


def has_beyond(depth: np.ndarray, max_depth: float) -> bool:
    """Whether some of every eighth pixel and row lie beyond the range."""
    return bool((depth[::8, ::8] > max_depth).any())


def _coordinates(values: np.ndarray) -> np.ndarray:
    at = np.ascontiguousarray(values, np.int32)
    if at.ndim != 2 or at.shape[1] != 3:
        raise InputError(f"expected block coordinates [n, 3], found an array of shape {at.shape}")
    return at
