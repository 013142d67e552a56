# SPDX-License-Identifier: Apache-2.0
"""Reads what reports show from a run folder. Runs of older versions and edited runs have less."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np

from ggslam.errors import GgslamError, RunFolderError
from ggslam.evaluation.trajectory import FEWEST_POSES, align_points
from ggslam.formats.trajectory import read_tum, write_tum
from ggslam.jobs.report.mover_pictures import mover_views
from ggslam.jobs.report.run_data import FrameView, LevelAxes, Path3D, RunData
from ggslam.runs.folder import RunFolder
from ggslam.runs.recordings import open_recording_of
from ggslam.runs.records.keyframes import KeyframesRecord
from ggslam.runs.records.loops import LoopsRecord
from ggslam.runs.records.metrics import MetricsRecord
from ggslam.runs.records.run_json import RunRecord
from ggslam.runs.records.sequence import RigRecord, SequenceRecord
from ggslam.runs.records.timing import TimingRecord
from ggslam.runs.writing import REPORT_FILE, TRUTH_FILE
from ggslam.sequences import Sequence
from ggslam.sequences.association import pair_times
from ggslam.slam.config import Config, config_to_dict
from ggslam.slam.step_log import STEPS_FILE, read_table
from ggslam.system.plain_yaml import PlainYamlError, parse_yaml
from ggslam.system.untrusted_files import read_untrusted_text
from ggslam.volumes.map_upright import upright_of
from ggslam.volumes.upright import estimate_up


def load_run(folder: RunFolder, sequence: Sequence | None = None, views: list[FrameView] | None = None) -> RunData:
    """What is known of a run.

    Args:
        folder: of the run.
        sequence: its recording, for true poses that the folder does not hold yet.
        views: pictures to show.

    Raises:
        RunFolderError, FormatError: a file is damaged, or there are no keyframes.json and run.json.
    """
    try:
        return _load(folder, sequence, views or [])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RunFolderError(f"{folder.path}: not as ggslam writes it: {error!r}") from error


def _load(folder: RunFolder, sequence: Sequence | None, views: list[FrameView]) -> RunData:
    record, mark, metrics, loops = folder.keyframes(), folder.mark(), folder.metrics(), folder.loops()
    lacking = [name for name in mark.missing if name != REPORT_FILE]  # which is about to be written
    mark = mark.model_copy(update={"missing": lacking}) if mark.missing else mark
    timing, recording = TimingRecord.read_if_there(folder.path), SequenceRecord.read_if_there(folder.path)
    path, movers = folder.path.absolute(), folder.movers().movers
    return RunData(
        name=path.name, path=str(path), camera_path=path_of_run(folder, record, sequence), tracked=_columns(record),
        keyframes=np.array([k.frame for k in record.keyframes], int),
        steps=_table(folder, STEPS_FILE), scores=_table(folder, "frames.csv"), metrics=metrics, timing=timing,
        settings=_settings(folder), defaults=flat(config_to_dict(Config())), recording=recording, mark=mark,
        verdict=folder.verdict(),
        warnings=run_warnings(mark, recording, timing, loops, record, metrics), views=views,
        movers=movers, mover_views=mover_views(sequence, movers, record.poses()),
    )  # fmt: skip


def _table(folder: RunFolder, name: str) -> dict[str, np.ndarray]:
    path = folder.path / name
    return read_table(path) if path.is_file() else {}


def _settings(folder: RunFolder) -> dict[str, Any]:
    path = folder.path / "config.yaml"
    try:
        values = parse_yaml(read_untrusted_text(path, RunFolderError)) if path.is_file() else {}
    except PlainYamlError as error:
        raise RunFolderError(f"{path}: cannot be read: {error}") from None
    if not isinstance(values or {}, dict):
        raise RunFolderError(f"{path}: expected settings, found {type(values).__name__}")
    return flat(values or {})


def flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            out |= flat(value, f"{prefix}{name}.")
        else:
            out[f"{prefix}{name}"] = list(value) if isinstance(value, tuple) else value
    return out


def _columns(record: KeyframesRecord) -> dict[str, np.ndarray]:
    """How each frame was tracked."""
    frame = np.array([f.frame for f in record.frames], float)
    overlap = np.array([f.overlap for f in record.frames], float)  # None becomes NaN
    rmse_m = np.array([f.rmse_m for f in record.frames], float)
    status = np.array([f.status for f in record.frames], str)
    unmatched = np.isin(status, ("lost", "first"))  # matched with nothing, or not well
    overlap[unmatched] = rmse_m[unmatched] = np.nan
    return {"frame": frame, "overlap": overlap, "rmse_m": rmse_m, "status": status}


# --- where the camera was --------------------------------------------------------------------------------------------


def has_limit(folder: RunFolder) -> bool:
    """Whether the run had a limit of memory: its map may be larger than should be read as a whole."""
    return (folder.path / "config.yaml").is_file() and folder.config().memory_limit_mb > 0


def level_axes(folder: RunFolder, record: KeyframesRecord) -> LevelAxes:
    """Level directions: up from the surfaces of the map, or, if it is too large to be read as a whole or has no level
    surfaces, from how the cameras were held; right and forward those of the first camera."""
    poses = np.array([T for _, T in sorted(record.poses().items())]).reshape(-1, 4, 4)
    if not len(poses):
        return LevelAxes()
    none = np.zeros((0, 3))
    found = estimate_up(poses, none, none) if has_limit(folder) else upright_of(folder.gaussians(), poses)
    start = poses[0, :3, 2] if abs(poses[0, :3, 2] @ found.up) < 0.95 else -poses[0, :3, 1]  # it looked down, or up
    forward = start - (start @ found.up) * found.up
    forward /= np.linalg.norm(forward)
    source = "the map's floor, tops and ceilings" if found.support else "the cameras on average"
    return LevelAxes(np.stack([np.cross(forward, found.up), forward, found.up]), source, found.floor)


def path_of_run(folder: RunFolder, record: KeyframesRecord, sequence: Sequence | None = None) -> Path3D:
    """The camera's path from keyframes.json, of a rig its first camera's, with the truth laid upon it if it is known.

    Args:
        folder: of the run.
        record: its keyframes and frames.
        sequence: the recording, if it is at hand.
    """
    poses = record.poses()
    frames = _frames_of_path(folder, sorted(poses))
    positions = _of_path(folder, frames, np.array([poses[f] for f in frames.tolist()]).reshape(-1, 4, 4))[:, :3, 3]
    times = {f.frame: f.timestamp for f in record.frames}
    seconds = np.array([times[f] for f in frames], float)
    start = seconds[0] if len(seconds) else 0.0
    truth, reason = _truth(folder, frames, seconds, sequence)
    known, level, walks = np.isfinite(truth).all(1), level_axes(folder, record), _walks(folder, frames)
    if not reason and known.sum() < FEWEST_POSES:
        reason = f"fewer than {FEWEST_POSES} frames have both poses"
    if reason:
        return Path3D(frames, seconds - start, positions, reason=reason, level=level, walks=walks)
    T, _ = align_points(truth[known], positions[known])
    moved = truth @ T[:3, :3].T + T[:3, 3]
    error = np.linalg.norm(moved - positions, axis=1)
    return Path3D(frames, seconds - start, positions, moved, error, level=level, walks=walks)


def _truth(
    folder: RunFolder, frames: np.ndarray, seconds: np.ndarray, sequence: Sequence | None
) -> tuple[np.ndarray, str]:
    """True positions [N, 3] of the frames, NaN where unknown, or why there are none."""
    found = np.full((len(frames), 3), np.nan)
    path = folder.path / TRUTH_FILE
    if path.is_file():
        truth = read_tum(path)
        pairs = pair_times(seconds, truth.timestamps, 1e-6)
        found[pairs[:, 0]] = truth.T_world_camera[pairs[:, 1], :3, 3]
        return found, ""
    if sequence is None:
        try:
            sequence = open_recording_of(folder)
        except GgslamError:
            return found, "the recording is not where it was, and the run did not keep its true poses"
    if sequence.ground_truth is None:
        return found, "the recording has no ground-truth poses"
    inside = frames < len(sequence.ground_truth)
    found[inside] = _of_path(folder, frames[inside], sequence.ground_truth[frames[inside]])[:, :3, 3]
    return found, ""


def _rig_of(folder: RunFolder) -> RigRecord | None:
    recording = SequenceRecord.read_if_there(folder.path)
    return None if recording is None else recording.rig


def _walks(folder: RunFolder, frames: np.ndarray) -> list[np.ndarray]:
    """Rows of the frames of each recording and camera of a merged run; none of another run."""
    recording = SequenceRecord.read_if_there(folder.path)
    if recording is None or recording.parts is None:
        return []
    of_frames = np.array([recording.walk_of(frame) for frame in frames.tolist()]).reshape(-1, 2)
    return [np.flatnonzero((of_frames == walk).all(1)) for walk in np.unique(of_frames, axis=0)]


def _frames_of_path(folder: RunFolder, frames: ListOf[int]) -> np.ndarray:
    """Those of the frames that trajectory.txt has a pose of, int64 [n]: all, of a rig the first ones of each instant.
    """
    rig, chosen = _rig_of(folder), np.array(frames, int)
    return chosen if rig is None else chosen[rig.first_of_instants(frames)]


def _of_path(folder: RunFolder, frames: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """Poses [n, 4, 4] of frames as trajectory.txt has them: of a rig as its first camera's."""
    rig = _rig_of(folder)
    if rig is None or not len(frames):
        return T_world_camera
    return np.stack([rig.pose_of_first(T, f) for T, f in zip(T_world_camera, frames.tolist(), strict=True)])


def save_truth(folder: RunFolder, sequence: Sequence) -> None:
    """Writes the true poses of the run's frames, if the recording knows any, with the times of trajectory.txt."""
    if sequence.ground_truth is None:
        return
    times = {f.frame: f.timestamp for f in folder.keyframes().frames if f.frame < len(sequence.ground_truth)}
    frames = _frames_of_path(folder, list(times))
    poses = _of_path(folder, frames, sequence.ground_truth[frames])
    if np.isfinite(poses).all((1, 2)).any():
        write_tum(folder.path / TRUTH_FILE, np.array([times[f] for f in frames.tolist()], float), poses)


# --- what a user should know -----------------------------------------------------------------------------------------


def run_warnings(
    mark: RunRecord, recording: SequenceRecord | None, timing: TimingRecord | None, loops: LoopsRecord | None,
    record: KeyframesRecord, metrics: MetricsRecord | None,
) -> list[str]:  # fmt: skip
    """Everything unusual of a run, a sentence each."""
    before = [*mark.notes(), *(loops.notes() if loops else []), *record.notes(), *(timing.notes() if timing else [])]
    after = [*(recording.notes() if recording else []), *(metrics.notes if metrics else [])]
    return [*map(_sentence, before), *(recording.warnings if recording else []), *map(_sentence, after)]


def _sentence(note: str) -> str:
    return note[:1].upper() + note[1:] + "."
