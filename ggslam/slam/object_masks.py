# SPDX-License-Identifier: Apache-2.0
"""Where the object masks of keyframes come from: the recording's masks, a model's or a geometric segmenter's segments,
cleaned and, unless their ids prove consistent over time, matched with the objects that the map already shows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import field, replace
from typing import Literal

import numpy as np

from ggslam.errors import SequenceError
from ggslam.mapping.keyframe import FROM_EARLIER_RUN, Keyframe
from ggslam.mapping.labelling import KeyframeLabels, MapLabels
from ggslam.objects.association import Associator, MapView
from ggslam.objects.geometric_segmenter import GeometricSegmenter
from ggslam.objects.model_files import open_segmenter
from ggslam.objects.onnx_segmenter import OnnxSegmenterSettings
from ggslam.objects.same_object import LabelledVoxels, find_counterparts
from ggslam.objects.segments import boundary_trust, clean_segments
from ggslam.objects.settings import AssociationSettings, CleaningSettings, GeometricSettings, SameObjectSettings
from ggslam.objects.table import Observation, Supervision
from ggslam.scene.frame import Frame
from ggslam.system.savable import savable
from ggslam.system.settings import Conflict, setting, settings_class, tuning_class
from ggslam.system.tuning import Tuning


class ObjectChanceTuning(Tuning):
    """When an object is kept that was found once."""

    min_gaussians = 160
    """Gaussians from which an object needs only one observation if it had no chance of more."""


Source = Literal["auto", "recording", "geometry", "model", "none"]


@tuning_class(frozen=True)
class MaskTuning:
    """Internal settings of object masks."""

    min_repeat: float = setting(0.35, 0, 1)
    """Objects found on a smaller share of the segmented keyframes that show their place are dropped as noise."""
    min_gaussians: int = setting(8, 0, 10**9)
    """Objects with fewer Gaussians are dropped as noise."""


@settings_class(frozen=True)
class MaskSettings(MaskTuning):
    """Where object masks come from."""

    source: Source = setting("auto", basic=True)
    """auto: the model if `masks.model` is given, else the recording's masks if it has any, else geometry. none: no
    objects."""
    model: str = setting("", basic=True)
    """ONNX file of a segmentation model (YOLO-seg or SAM family), or the folder of a SAM encoder and its decoder. Needs
    the extra [masks]."""
    every: int = setting(6, 1, 10**6)
    """Minimum gap, in frames, between two segmented frames."""
    min_views: int = setting(3, 1, 10**6)
    """Objects found on fewer keyframes are dropped as noise, except those of 160 Gaussians or more that were found
    wherever they could be. Runs of less than ten keyframes per view ask for less."""
    cleaning: CleaningSettings = field(default_factory=CleaningSettings)
    association: AssociationSettings = field(default_factory=AssociationSettings)
    geometry: GeometricSettings = field(default_factory=GeometricSettings)
    onnx: OnnxSegmenterSettings = field(default_factory=OnnxSegmenterSettings)
    uniting: SameObjectSettings = field(default_factory=SameObjectSettings)

    def __post_init__(self) -> None:
        if self.source == "model" and not self.model:
            raise Conflict("model", "expected an ONNX file, or a folder of two: masks.source is model, found none")


@savable(not_saved="settings _segment")
class ObjectMasks:
    """Gives each keyframe its object mask.

    Args:
        settings: see there.
        has_masks: whether the recording has masks; None: judged by the first keyframe.

    Raises:
        ConfigError: the model cannot be read.
        MissingDependency: onnxruntime is not installed.
    """

    _source: Source | None
    _segmented: dict[int, int]
    _associator: Associator

    def __init__(self, settings: MaskSettings, has_masks: bool | None = None) -> None:
        self.settings = settings
        self._source = _choose(settings, has_masks)
        self._segment: Callable[[Frame], np.ndarray] | None = None
        if self._source == "model":
            model = open_segmenter(settings.model, settings.onnx)
            self._segment = lambda frame: model.segment(frame.color)
        self._associator = self._make_associator()
        self._segmented = {}  # of each camera the last frame, or instant, that was

    def _make_associator(self) -> Associator:
        """A segmenter's ids mean nothing from one frame to the next; a recording's may."""
        settings = self.settings.association
        if self._source in ("geometry", "model"):
            settings = dataclasses.replace(settings, mode="always")
        return Associator(settings)

    @property
    def active(self) -> bool:
        """Whether any keyframe may get a mask."""
        return self._source != "none"

    @property
    def supervision(self) -> Supervision:
        """What the masks were."""
        if self._source == "geometry":
            return "geometry"
        if self._source == "model":
            return "model"
        return "masks" if self._associator.uses_own_ids is not False else "associated masks"

    def labels(
        self, frame: Frame, keyframe: Keyframe, show: Callable[[], MapLabels] | None
    ) -> KeyframeLabels:
        """Objects of a new keyframe.

        Args:
            frame: that it is made of.
            keyframe: with its pose.
            show: what the map shows from there; None when it is empty.

        Raises:
            SequenceError: the frame's mask is damaged or of another size than its images.
        """
        if self._rests(frame):
            return KeyframeLabels()
        segments = self._segments(frame)
        if segments is None or not segments.any():
            return KeyframeLabels(segments)
        if self._associator.uses_own_ids:
            return KeyframeLabels(segments)
        depth, view = keyframe.depth_m(), None
        if show is not None:
            shown = show()
            view = MapView(shown.ids, shown.confidence, shown.depth)
        # Ids that are consistent over time are taken as they are: only an association needs clean segments.
        cleaned = segments if self._source == "geometry" else clean_segments(segments, self.settings.cleaning)
        found = self._associator.associate(cleaned, view, depth, keyframe.camera, keyframe.T_world_camera)
        if self._source == "recording" and self._associator.uses_own_ids is not False:
            return KeyframeLabels(segments, found.merges)
        trusted = boundary_trust(found.ids, depth, self.settings.cleaning)
        mask = np.where(trusted, found.ids, 0).astype(np.uint16)
        return KeyframeLabels(mask, found.merges, found.splits, found.forgotten)

    def unite(self, older: LabelledVoxels, newer: LabelledVoxels) -> list[tuple[int, int]]:
        """Objects that both ends of a closed loop have mapped, (kept, dropped), the older end's being kept. An object
        that is at the older end itself is not dropped. Ids that are constant in time need none of this."""
        settings = self.settings.uniting
        if self._associator.uses_own_ids is not False:
            return []
        there = np.bincount(older.labels, minlength=1 << 16) >= settings.min_shared
        found = find_counterparts(older, newer, settings)
        pairs = [(pair.first, pair.second) for pair in found if not there[pair.second]]
        for kept, dropped in pairs:
            self._associator.unite(kept, dropped)
        return pairs

    def _rests(self, frame: Frame) -> bool:
        """Whether too few frames have passed since the last one that was segmented."""
        if self._source not in ("geometry", "model"):
            return False
        number, now = frame.camera_number, frame.index if frame.instant is None else frame.instant
        rests = number in self._segmented and 0 <= now - self._segmented[number] < self.settings.every
        if not rests:
            self._segmented[number] = now
        return rests

    def _segments(self, frame: Frame) -> np.ndarray | None:
        if self._source in (None, "recording"):
            mask = frame.load_mask()
            if self._source is None:
                self._source = "geometry" if mask is None else "recording"
                self._associator = self._make_associator()
            if self._source == "recording":
                return mask if mask is None else _check_mask(mask, frame)
        if self._segment is None:
            segmenter = GeometricSegmenter(self.settings.geometry)
            self._segment = lambda frame: segmenter.segment(frame.color, frame.depth, frame.camera)
        return self._segment(frame)

    def noise(
        self, object_ids: np.ndarray, seen: dict[int, Observation], keyframes: int, sizes: np.ndarray,
        chances: Mapping[int, int], known: Collection[int] = (),
    ) -> list[int]:  # fmt: skip
        """Of `object_ids`, those that are too small or were seen too rarely, in so many keyframes, to be believed.

        Args:
            sizes: number of Gaussians by id, [65536].
            chances: number of keyframes by id in which an object could have been seen; where it is not known, the
                object needs `MaskSettings.min_views` and is not doubted for more.
            known: objects of the map that the run began with: only their size counts.
        """
        if self.supervision == "masks":
            return []
        views = {i: seen[i].views if i in seen else 0 for i in object_ids.tolist()}
        enough, share = min(self.settings.min_views, 1 + keyframes // 10), self.settings.min_repeat
        least = self.settings.min_gaussians
        always = {
            i
            for i, count in views.items()
            if 1 <= chances.get(i, 0) <= count and sizes[i] >= ObjectChanceTuning.min_gaussians
        }
        seldom = {i for i, count in views.items() if count < max(enough, share * chances.get(i, 0))} - always
        seldom -= set(known)
        return [i for i in views if i in seldom or sizes[i] < least]


def _choose(settings: MaskSettings, has_masks: bool | None) -> Source | None:
    if settings.source == "auto":
        if settings.model:
            return "model"
        return None if has_masks is None else "recording" if has_masks else "geometry"
    if settings.source == "recording" and has_masks is False:
        raise SequenceError("masks.source=recording: the recording has no masks")
    return settings.source


def _check_mask(mask: np.ndarray, frame: Frame) -> np.ndarray:
    if mask.shape != frame.depth.shape or mask.dtype != np.uint16:
        raise SequenceError(
            f"frame {frame.source_index}: mask is {mask.dtype} {list(mask.shape)}, expected uint16 "
            f"{list(frame.depth.shape)}"
        )
    return mask


def observations(
    keyframes: list[Keyframe],
    current: Callable[[np.ndarray], np.ndarray],
    earlier: Mapping[int, Observation] | None = None,
) -> dict[int, Observation]:
    """First and last frame and number of keyframes in which each object was seen.

    Args:
        keyframes: with masks or without; those of another recording (frame -1) are passed over.
        current: object ids -> ids after merges.
        earlier: what was seen in the recordings that the map began with: views are added, frames stand for objects
            that are not seen again.
    """
    seen: dict[int, list[int]] = {}
    for keyframe in keyframes:
        if keyframe.mask is not None and keyframe.frame_index != FROM_EARLIER_RUN:
            for i in np.flatnonzero(np.bincount(current(keyframe.mask).reshape(-1))).tolist():
                seen.setdefault(i, []).append(keyframe.frame_index)
    found = {i: Observation(min(frames), max(frames), len(frames)) for i, frames in seen.items() if i}
    for i, old in (earlier or {}).items():
        found[i] = replace(found[i], views=found[i].views + old.views) if i in found else old
    return found
