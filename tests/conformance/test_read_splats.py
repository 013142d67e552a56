# SPDX-License-Identifier: Apache-2.0
"""ggslam's readers of splats against the tests' own and others' readers, on ggslam's files and on others'."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foreign_readers import FOREIGN_READERS
from splat_formats import SPLAT_FORMATS, SplatFormat, rows_of, with_colors
from splat_maps import C0, DIRECTIONS, Splats, convert, from_ply, small_map

from ggslam.formats.gaussian_ply import write_gaussian_ply
from ggslam.formats.splat_formats import open_splats, read_splats
from ggslam.runs.folder import RunFolder

DEGREES = [0, 1, 2, 3]
FOREIGN = [(reader, kind) for reader, known in FOREIGN_READERS.items() for kind in known.formats
           if kind not in ("segmented", "streamed-sog") and (reader, kind) != ("splat-transform", "splat")]

"""splat-transform takes quaternions of `.splat` for steps of 1/127.5, 2 % off."""


def place_of(path: Path, kind: str) -> Path:
    return path / "lod-meta.json" if kind == "streamed-sog" else path


def same(ours: Splats, theirs: Splats, known: SplatFormat) -> None:
    """The numbers of a file as two readers have them; theirs in the file's axes, ours in the map's."""
    order = rows_of(theirs.means @ known.turn, ours.means)
    theirs = theirs.take(order)
    assert np.abs(ours.means - theirs.means @ known.turn).max() < 2e-6 * max(1, float(np.abs(ours.means).max()))
    np.testing.assert_allclose(ours.opacities, theirs.opacities.clip(1e-6, 1 - 1e-6), atol=2e-6)
    expected = known.turn @ theirs.covariances() @ known.turn.T
    error = np.linalg.norm(ours.covariances() - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert error.max() < 2e-5
    for direction in DIRECTIONS:
        assert np.abs(ours.colors(direction) - theirs.colors(known.turn @ direction)).max() < 2e-5


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("kind", SPLAT_FORMATS)
def test_as_the_descriptions_say(
    kind: str, degree: int, exported: Callable[[str, int, bool], Path], run_of: Callable[[int, bool], RunFolder]
) -> None:
    known, path = SPLAT_FORMATS[kind], exported(kind, degree, True)
    found = open_splats(place_of(path, kind))
    ours = Splats.of(read_splats(place_of(path, kind)))
    same(ours, known.read(path), known)
    assert found.notes == [] and (found.names is not None) == known.keeps_ids
    if known.recolored:
        return
    written = Splats.of(run_of(degree, True).gaussians())
    if known.base_colors:
        written = with_colors(written, (0.5 + C0 * written.sh[:, 0]).clip(0, 1))
    if known.keeps_ids:
        rows = rows_of(ours.means, written.means)
        assert ours.object_ids is not None and np.array_equal(ours.object_ids[rows], written.object_ids)
        if kind in ("sog", "gltf", "usd"):
            assert found.names == {1: "mug", 2: "", 3: "chair \u00e4", 4: ""}


@pytest.mark.parametrize(("reader", "kind"), FOREIGN, ids=[f"{reader}-{kind}" for reader, kind in FOREIGN])
def test_as_programs_of_others_read_them(
    reader: str, kind: str, exported: Callable[[str, int, bool], Path], tmp_path: Path
) -> None:
    path = exported(kind, 3, True)
    same(Splats.of(read_splats(place_of(path, kind))), FOREIGN_READERS[reader].read(path, tmp_path),
         SPLAT_FORMATS[kind])  # fmt: skip


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("name", ["map.sog", "map.compressed.ply", "map.spz", "map.glb", "folder/meta.json"])
def test_files_that_splat_transform_wrote(name: str, degree: int, splat_transform: list[str], tmp_path: Path) -> None:
    """Of our PLY: read by us, and by their own program back into a PLY. glTF, which it does not read, it turns about z,
    not x, and keeps every digit."""
    write_gaussian_ply(tmp_path / "map.ply", small_map(degree))
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    about_y = ["-r", "0,180,0"] if name.endswith(".glb") else []
    convert([*splat_transform, "-g", "cpu"], tmp_path / "map.ply", *about_y, path)
    if not about_y:
        convert(splat_transform, path, tmp_path / "back.ply")
    theirs = from_ply(tmp_path / ("map.ply" if about_y else "back.ply"))
    same(Splats.of(read_splats(path)), theirs, SPLAT_FORMATS["ply"])


def test_spz_that_gaussforge_wrote(tmp_path: Path) -> None:
    """It copies axes as they are, so that what it reads of its file is turned against what we read."""
    gaussforge = pytest.importorskip("gaussforge", reason="gaussforge is not installed (extra [splats])")
    write_gaussian_ply(tmp_path / "map.ply", small_map(2))
    answer = gaussforge.GaussForge().convert((tmp_path / "map.ply").read_bytes(), "ply", "spz")
    (tmp_path / "map.spz").write_bytes(answer["data"])
    back = gaussforge.GaussForge().convert(answer["data"], "spz", "ply")
    (tmp_path / "back.ply").write_bytes(back["data"])
    same(Splats.of(read_splats(tmp_path / "map.spz")), from_ply(tmp_path / "back.ply"), SPLAT_FORMATS["spz"])
