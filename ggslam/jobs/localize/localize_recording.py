# SPDX-License-Identifier: Apache-2.0
"""Finding a recording in a map, in one call."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ggslam.jobs.localize.locate import LocalizeRequest, localize
from ggslam.jobs.localize.report import LocalizationReport
from ggslam.jobs.progress import Observer, SilentObserver
from ggslam.runs.recordings import SequenceRequest


def localize_recording(
    map: str | Path,
    recording: str | Path,
    out: str | Path | None = None,
    *,
    start_pose: str | None = None,
    near: str | None = None,
    full: bool = False,
    radius: float | str | None = None,
    voxel: float | None = None,
    threads: int | None = None,
    overrides: Iterable[str] = (),
    observer: Observer | None = None,
    **selection: Any,
) -> LocalizationReport:
    """Locates each frame or scan of a recording in a map, as `ggslam localize` does.

    Args:
        map: folder of a run or a store, or a point cloud.
        recording: folder or file of the recording, or of laser scans.
        out: folder for the results; None: localized/ and the recording's name.
        start_pose: of the first frame, "x y z qx qy qz qw" in metres; None: it is looked up among the map's places.
        near: roughly where the recording was made, "x y sigma" or "x y z sigma" in metres; None: anywhere.
        full: use all of the map at once, not only what is around the camera.
        radius: of the part that is used, in metres; None: the store's; "auto": as far as each scan or frame sees.
        voxel: edge of the target's voxels in metres; None: 0.03 for images, 0.15 for scans, or what the map allows.
        threads: None: all processors.
        overrides: settings as "name.of.setting=value".
        observer: receives progress updates.
        selection: start, stop, stride, scale and the other arguments of `open_sequence`.

    Returns:
        Poses and states of the frames; `summary()` has the figures.

    Raises:
        GgslamError: map or recording cannot be read, or nothing says where to begin.
    """
    request = LocalizeRequest(
        Path(map), SequenceRequest.of(recording, selection, "localize_recording"), start_pose, near=near, full=full,
        out=None if out is None else Path(out), radius=radius, voxel=voxel, threads=threads, overrides=list(overrides),
    )  # fmt: skip
    return localize(request, observer or SilentObserver())
