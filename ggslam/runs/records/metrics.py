# SPDX-License-Identifier: Apache-2.0
"""metrics.json: the scores of a run."""

from __future__ import annotations

from typing import ClassVar

from ggslam.runs.records.record import NumberOrNone, Record, RecordFile

SETS = ("keyframes", "held_out", "all")
"""Frames that scores are about: trained on, never trained on, every one."""


class TrajectoryScoresRecord(Record):
    """See `evaluation.trajectory.TrajectoryScores`."""

    ate_rmse_m: NumberOrNone = None
    ate_mean_m: NumberOrNone = None
    ate_median_m: NumberOrNone = None
    ate_max_m: NumberOrNone = None
    ate_raw_rmse_m: NumberOrNone = None
    rpe_trans_m: NumberOrNone = None
    rpe_rot_deg: NumberOrNone = None
    rpe_delta: int | None = None
    frames_compared: int | None = None


class ImageScoresRecord(Record):
    """Means over a set of frames, see `evaluation.images.ImageScores`; `frames` were scored."""

    psnr: NumberOrNone = None
    psnr_3dgs: NumberOrNone = None
    psnr_unmasked: NumberOrNone = None
    psnr_exposed: NumberOrNone = None
    psnr_affine: NumberOrNone = None
    ssim: NumberOrNone = None
    ssim_unmasked: NumberOrNone = None
    lpips: NumberOrNone = None
    lpips_unmasked: NumberOrNone = None
    depth_l1_m: NumberOrNone = None
    depth_l1_median_m: NumberOrNone = None
    depth_coverage: NumberOrNone = None
    frames: int = 0
    frames_without_pose: int = 0


class ImagesRecord(Record):
    """Image scores of each set of frames."""

    keyframes: ImageScoresRecord | None = None
    held_out: ImageScoresRecord | None = None
    all: ImageScoresRecord | None = None

    def sets(self) -> dict[str, ImageScoresRecord]:
        """The sets that were scored, by name."""
        return {name: scores for name in SETS if (scores := getattr(self, name)) is not None}


class ObjectsScoresRecord(Record):
    """Of a set of frames, see `evaluation.segmentation.SegmentationScores`; `votes_miou` of labels by votes."""

    frames: int = 0
    objects: int = 0
    predicted_objects: int = 0
    miou: NumberOrNone = None
    boundary_miou: NumberOrNone = None
    accuracy: NumberOrNone = None
    precision: NumberOrNone = None
    recall: NumberOrNone = None
    f1: NumberOrNone = None
    panoptic_quality: NumberOrNone = None
    votes_miou: NumberOrNone = None


class ObjectScoreRecord(Record):
    """Of one object, see `evaluation.segmentation.ObjectScore`."""

    name: str | None = None
    iou: NumberOrNone = None
    boundary_iou: NumberOrNone = None
    matched: int | None = None
    pixels: int | None = None


class GaussiansScoresRecord(Record):
    """Labels of the Gaussians, see `evaluation.gaussian_labels.GaussianLabelScores`."""

    accuracy: NumberOrNone = None
    accuracy_by_opacity: NumberOrNone = None
    labelled: int = 0
    gaussians: int = 0
    votes_accuracy: NumberOrNone = None


class SegmentationRecord(Record):
    """Scores of the objects: of each set of frames, how ids were matched, what supervised them, and one by one."""

    keyframes: ObjectsScoresRecord | None = None
    held_out: ObjectsScoresRecord | None = None
    all: ObjectsScoresRecord | None = None
    matching: str | None = None
    supervision: str | None = None
    per_object: dict[str, ObjectScoreRecord] = {}
    gaussians: GaussiansScoresRecord | None = None

    def sets(self) -> dict[str, ObjectsScoresRecord]:
        """The sets that were scored, by name."""
        return {name: scores for name in SETS if (scores := getattr(self, name)) is not None}


class SurfaceScoresRecord(Record):
    """Of points.ply against the depth of the recording, fused at the run's poses; see `evaluation.surface`.

    Attributes:
        points: that were scored...
        measured: ...and their share of all: the depth of the others was measured by no frame.
        median_m, p95_m: how far half and 95 % of the points lie from the surface at most.
        precision_1cm, ...: share of the points so near to the surface; recall: of the surface, so near to a point.
    """

    points: int = 0
    measured: NumberOrNone = None
    median_m: NumberOrNone = None
    p95_m: NumberOrNone = None
    precision_1cm: NumberOrNone = None
    recall_1cm: NumberOrNone = None
    f1_1cm: NumberOrNone = None
    precision_2cm: NumberOrNone = None
    recall_2cm: NumberOrNone = None
    f1_2cm: NumberOrNone = None


class SpeedRecord(Record):
    """How fast the run was; see `records.timing`."""

    frames_per_s: NumberOrNone = None
    tracking_ms: NumberOrNone = None
    mapping_iteration_ms: NumberOrNone = None
    iterations_per_frame: NumberOrNone = None
    dropped_frames: int = 0
    refinement_s: NumberOrNone = None


class MapRecord(Record):
    """How large the map is."""

    gaussians: int | None = None
    keyframes: int | None = None


class MemoryRecord(Record):
    """Largest resident memory of the run, MB (10^6 bytes)."""

    peak_rss_mb: NumberOrNone = None


class CameraScoresRecord(Record):
    """Of the frames of one camera of a rig."""

    trajectory: TrajectoryScoresRecord | None = None
    images: ImagesRecord = ImagesRecord()


class MetricsRecord(RecordFile):
    """All scores of a run.

    Attributes:
        trajectory: None without ground truth.
        images: plain names count pixels with measured depth, `_unmasked` all pixels.
        segmentation: None without objects or without masks.
        surface: of the points; None if they were not scored.
        tracking: number of frames of each status.
        speed, map, memory: of the run.
        scored_every: the images of every n-th frame were scored.
        notes: what could not be scored, and why.
        cameras: of a rig, by the names of its cameras: the same of the frames of each. `trajectory` is of the rig then:
            of the first frame of each instant.
    """

    FILE: ClassVar[str] = "metrics.json"
    trajectory: TrajectoryScoresRecord | None = None
    images: ImagesRecord = ImagesRecord()
    segmentation: SegmentationRecord | None = None
    surface: SurfaceScoresRecord | None = None
    tracking: dict[str, int] = {}
    speed: SpeedRecord = SpeedRecord()
    map: MapRecord = MapRecord()
    memory: MemoryRecord = MemoryRecord()
    scored_every: int = 1
    notes: list[str] = []
    cameras: dict[str, CameraScoresRecord] | None = None
