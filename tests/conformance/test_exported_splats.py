# SPDX-License-Identifier: Apache-2.0
"""Every splat format of `ggslam export`, at every degree of spherical harmonics, with and without objects: positions,
shapes, colours and object ids as readers of others find them, and pictures by the rules of 3D Gaussian Splatting."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from command_line import succeed
from foreign_readers import FOREIGN_READERS
from scipy.spatial import cKDTree
from splat_formats import OTHER_FORMATS, SPLAT_FORMATS, with_colors
from splat_maps import C0, Splats
from splat_rendering import Pinhole, decibels, look_at, render
from standard_pictures import standard_picture

from ggslam.errors import RunFolderError
from ggslam.formats.table import writers
from ggslam.jobs.export.export_run import export_run
from ggslam.runs.folder import RunFolder
from ggslam.scene.poses import inverse

DEGREES = [0, 1, 2, 3]
CAMERA = Pinhole.centred()
POSES = [look_at((0.5, -1.0, -5.0)), look_at((0.2, 0.1, 0.3), (2.0, 0.5, 1.0))]
FOREIGN = [(reader, kind) for reader, known in FOREIGN_READERS.items() for kind in known.formats]


@pytest.fixture(scope="session")
def original(run_of: Callable[[int, bool], RunFolder]) -> Callable[[str, int, bool], Splats]:
    """What an export shall show."""

    def of(kind: str, degree: int, with_objects: bool) -> Splats:
        run, known = run_of(degree, with_objects), SPLAT_FORMATS[kind]
        found = Splats.of(run.gaussians())
        if known.recolored:
            return with_colors(found, run.object_table().palette()[found.object_ids] / 255)
        return with_colors(found, (0.5 + C0 * found.sh[:, 0]).clip(0, 1)) if known.base_colors else found

    return of


@pytest.fixture(scope="session")
def pictures(original: Callable[[str, int, bool], Splats]) -> Callable[[str, int], list[np.ndarray]]:
    """The same, seen from outside and from within."""

    @cache
    def of(kind: str, degree: int) -> list[np.ndarray]:
        return [render(original(kind, degree, True), CAMERA, pose) for pose in POSES]

    def like(kind: str, degree: int) -> list[np.ndarray]:
        changed = SPLAT_FORMATS[kind].recolored or SPLAT_FORMATS[kind].base_colors
        return of(kind if changed else "ply", degree)

    return like


def seen(kind: str, splats: Splats) -> list[np.ndarray]:
    return [render(splats, CAMERA, SPLAT_FORMATS[kind].pose(pose)) for pose in POSES]


def test_every_format_is_read_by_somebody() -> None:
    assert set(SPLAT_FORMATS) | OTHER_FORMATS == {known.name for known in writers()}


@pytest.mark.parametrize("with_objects", [True, False], ids=["objects", "plain"])
@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_as_the_formats_are_described(
    kind: str, degree: int, with_objects: bool, exported: Callable[[str, int, bool], Path],
    original: Callable[[str, int, bool], Splats], pictures: Callable[[str, int], list[np.ndarray]],
    run_of: Callable[[int, bool], RunFolder], tmp_path: Path,
) -> None:  # fmt: skip
    known = SPLAT_FORMATS[kind]
    if known.recolored and not with_objects:
        with pytest.raises(RunFolderError, match="objects"):
            export_run(run_of(degree, False), tmp_path / f"map{known.suffix}", kind)
        return
    found = known.read(exported(kind, degree, with_objects))
    known.check(found, original(kind, degree, with_objects), degree)
    assert (found.object_ids is not None) == (with_objects and known.keeps_ids)
    if with_objects:  # or all that is shown is the same
        assert decibels(seen(kind, found), pictures(kind, degree)) >= known.decibels[degree]


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize(("reader", "kind"), FOREIGN, ids=[f"{reader}-{kind}" for reader, kind in FOREIGN])
def test_as_others_read_them(
    reader: str, kind: str, degree: int, exported: Callable[[str, int, bool], Path],
    original: Callable[[str, int, bool], Splats], pictures: Callable[[str, int], list[np.ndarray]],
    tmp_path: Path,
) -> None:  # fmt: skip
    known = SPLAT_FORMATS[kind]
    found = FOREIGN_READERS[reader].read(exported(kind, degree, True), tmp_path)
    known.check(found, original(kind, degree, True), degree)
    assert decibels(seen(kind, found), pictures(kind, degree)) >= known.decibels[degree]


@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_a_run_by_the_command_line(kind: str, room_run: RunFolder, tmp_path: Path) -> None:
    """A map that was trained, from where the recording's camera was."""
    known, written = SPLAT_FORMATS[kind], Splats.of(room_run.gaussians())
    known.require()
    path = tmp_path / f"map{known.suffix}"
    said = succeed("export", room_run.path, "--format", kind, "--out", path)
    found, count = known.read(path), len(written.means)
    assert len(found.means) == count and str(count) in said
    rows = cKDTree(found.means @ known.turn).query(written.means)[1]
    if known.keeps_ids:
        assert found.object_ids is not None and (found.object_ids[rows] == written.object_ids).mean() > 0.999
    if known.recolored:
        written = with_colors(written, room_run.object_table().palette()[written.object_ids] / 255)
    camera, poses = room_run.sequence().camera, [inverse(k.T_world_camera) for k in room_run.keyframes().keyframes]
    expected = [standard_picture(written, camera, pose) for pose in poses]
    images = [
        but_at_the_cut_off(standard_picture(found, camera, known.pose(pose)), picture)
        for pose, picture in zip(poses, expected, strict=True)
    ]
    assert decibels(images, expected) >= known.trained


def but_at_the_cut_off(image: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """A picture, the one pixel of it as expected that differs most, if that is by less than 1/255: what has just that
    opacity there is drawn or not, as the last bit of it is rounded."""
    apart = np.abs(image - expected).max(2)
    worst = np.unravel_index(int(apart.argmax()), apart.shape)
    mended = image.copy()
    if apart[worst] < 1 / 255:
        mended[worst] = expected[worst]
    return mended
