# SPDX-License-Identifier: Apache-2.0
"""A run's map as its keyframes see it: rendered depth, colour and object ids, without the recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ggslam.errors import InputError
from ggslam.formats.point_sampling import PointSamplingTuning
from ggslam.formats.voxel_cloud import VoxelCloud
from ggslam.geometry.scene_size import scale_of_depth, voxel_times
from ggslam.mapping.keyframe import FROM_EARLIER_RUN
from ggslam.objects.rendered_ids import object_ids
from ggslam.objects.segmented_map import SegmentedMap
from ggslam.objects.table import ObjectTable
from ggslam.rendering.cpu import CpuRasterizer
from ggslam.reporting.pictures import color_to_uint8
from ggslam.runs.map_index import MapInParts
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.sequence import SequenceRecord
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.scene.poses import inverse
from ggslam.system.tuning import Tuning
from ggslam.volumes.posed_view import PosedView
from ggslam.volumes.surface_points import SurfacePointTuning, surface_points


class RenderedViewTuning(Tuning):
    """When a pixel has rendered depth, and at which size views are rendered."""

    min_alpha = 0.5
    """Smallest cover of a pixel with depth."""
    max_spread = 0.02
    """Largest difference of mean and median depth, as a share: along outlines, two surfaces are blended."""
    coarse = 0.25
    """Size of views that only tell how far they reach, as a share."""
    finest = 4.0
    """Largest size of views, in sizes of the training views, for voxels small against their pixels."""
    max_voxel_m = 1.0
    """Largest voxel, in metres."""
    voxels_per_pixel = 1.5
    """Most voxels that a pixel spans at the usual depth."""


@dataclass
class RenderedViews:
    """The map rendered from the poses of the keyframes.

    Attributes:
        cameras, poses: of each keyframe: its camera, and T_world_camera float64 [4, 4].
        in_view: the Gaussians that a camera at a pose T_camera_world may see.
        segmented: those Gaussians with their objects; None: views have no object ids.
    """

    cameras: Sequence[Camera]
    poses: Sequence[np.ndarray]
    in_view: Callable[[Camera, np.ndarray], GaussianMap]
    segmented: Callable[[GaussianMap], SegmentedMap] | None = None
    _rasterizer: CpuRasterizer = field(default_factory=CpuRasterizer)

    @staticmethod
    def of_records(
        recording: SequenceRecord, keyframes: KeyframesRecord, parts: MapInParts,
        segmented: Callable[[GaussianMap], SegmentedMap] | None,
    ) -> RenderedViews:  # fmt: skip
        """Those of a run's keyframes.

        Args:
            recording: tells the cameras.
            keyframes: tell where they were.
            parts: the map.
            segmented: see the class.
        """
        places = keyframes.keyframes
        cameras = [recording.camera if k.frame == FROM_EARLIER_RUN else recording.camera_of(k.frame) for k in places]
        return RenderedViews(cameras, [k.T_world_camera for k in places], parts.in_view, segmented)

    @staticmethod
    def of_files(folder: Path, parts: MapInParts) -> RenderedViews:
        """Those of the files of a run, whether it is complete yet or not, and of the map in them.

        Raises:
            RunFolderError, FormatError: one is missing or damaged.
        """
        segmented = None
        if (folder / "objects.json").is_file():
            table = ObjectTable.load(folder / "objects.json")
            classifier = IdentityClassifier.from_file(folder / "classifier.npz")
            segmented = lambda gaussians: SegmentedMap(gaussians, classifier, table)  # noqa: E731
        return RenderedViews.of_records(SequenceRecord.read(folder), KeyframesRecord.read(folder), parts, segmented)

    def __len__(self) -> int:
        return len(self.poses)

    def in_order(self) -> RenderedViews:
        """The same in the order of their places along the longest side of the map."""
        if not len(self):
            return self
        places = np.stack([T[:3, 3] for T in self.poses])
        order = np.argsort(places[:, np.ptp(places, axis=0).argmax()], kind="stable")
        cameras, poses = [self.cameras[i] for i in order], [self.poses[i] for i in order]
        return RenderedViews(cameras, poses, self.in_view, self.segmented, self._rasterizer)

    def view(self, number: int, zoom: float = 1.0, only_depth: bool = False) -> PosedView:
        """What a keyframe sees of the map.

        Args:
            number: of the keyframe.
            zoom: how many times larger than the keyframe's images.
            only_depth: leave out colour and object ids.
        """
        camera, T = self.cameras[number].scale(zoom), self.poses[number]
        gaussians, rasterizer = self.in_view(self.cameras[number], inverse(T)), self._rasterizer
        low_pass = rasterizer.low_pass * zoom**2  # Gaussians are as wide as they were trained
        with_ids = self.segmented is not None and not only_depth
        drawn = rasterizer.forward(
            gaussians, camera, inverse(T), features=with_ids, median_depth=True, low_pass=low_pass
        )
        assert drawn.median_depth is not None
        alpha, mean, median = drawn.alpha.numpy(), drawn.expected_depth.numpy(), drawn.median_depth.numpy()
        covered, spread = alpha >= RenderedViewTuning.min_alpha, RenderedViewTuning.max_spread
        sure = covered & (np.abs(mean - median) <= spread * median)
        depth = np.where(sure, mean, 0).astype(np.float32)
        if only_depth:
            return PosedView(depth, camera, T)
        cover = np.maximum(alpha, RenderedViewTuning.min_alpha)
        color = color_to_uint8(drawn.image.numpy() / cover)  # rendered over black
        ids = None if self.segmented is None else object_ids(rasterizer, drawn, self.segmented(gaussians))
        return PosedView(depth, camera, T, color, ids)

    def usual_voxel(self) -> float:
        """Edge of voxels that suits the map, a whole number of centimetres: 1 in rooms, more where most of what is seen
        is farther away, in halls or where depth has a wrong unit."""
        return min(PointSamplingTuning.voxel_m * self._times(), RenderedViewTuning.max_voxel_m)

    def _times(self) -> int:
        """Size of the scene against a room's, see `geometry.scene_size.voxel_times`."""
        depths = [depth for depth, _ in self._usual_depths()]
        return voxel_times(scale_of_depth(float(np.median(depths)))) if depths else 1

    def zoom_for(self, voxel_size: float) -> float:
        """How many times larger than the keyframes' images views have to be for voxels of this size, metres."""
        spacings = [depth / focal for depth, focal in self._usual_depths()]
        wanted = float(np.median(spacings)) / (RenderedViewTuning.voxels_per_pixel * voxel_size) if spacings else 1.0
        return float(np.clip(wanted, 1, RenderedViewTuning.finest))

    def _usual_depths(self) -> list[tuple[float, float]]:
        """Median depth of some of the views, metres, and their focal length, pixels."""
        found = []
        for number in np.linspace(0, len(self) - 1, min(len(self), 8)).astype(int):
            depth = self.view(number, RenderedViewTuning.coarse, only_depth=True).depth
            if (depth > 0).any():
                found.append((float(np.median(depth[depth > 0])), self.cameras[number].fx))
        return found

    def points(self, voxel_size: float, most_blocks: int = SurfacePointTuning.max_blocks) -> Iterator[VoxelCloud]:
        """The surface that the keyframes see, one point for each voxel of a grid; see
        `volumes.surface_points.surface_points`.

        Raises:
            VoxelError: voxels too small for what a view shows.
            InputError: an impossible voxel size.
        """
        if not 1e-3 <= voxel_size <= RenderedViewTuning.max_voxel_m:
            most = RenderedViewTuning.max_voxel_m
            raise InputError(f"voxel size: expected 0.001 to {most:g} m, found {voxel_size:g}")
        views = self.in_order()
        zoom, times = views.zoom_for(voxel_size), views._times()

        def look(number: int, coarse: bool) -> PosedView:
            return views.view(number, RenderedViewTuning.coarse if coarse else zoom, only_depth=coarse)

        with_ids = self.segmented is not None
        yield from surface_points(look, len(views), voxel_size, with_ids, most_blocks, times=times)

