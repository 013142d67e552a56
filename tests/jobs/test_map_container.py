# SPDX-License-Identifier: Apache-2.0
"""A run in one file (`map.ggz`): what comes back, what merging makes of it, and what is refused."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from kept import build_once, session_folder
from typer.testing import CliRunner, Result

from ggslam.cli.main import app
from ggslam.coding.listing import list_units
from ggslam.errors import FormatError, GgslamError, RunFolderError
from ggslam.jobs.encode.contents import contents_of_run
from ggslam.jobs.run.pipeline import RunRequest, execute
from ggslam.runs.folder import RunFolder
from ggslam.runs.map_container import read_container
from ggslam.runs.recordings import SequenceRequest
from ggslam.scene.arrays import arrays_to_bytes, read_all_arrays
from ggslam.scene.packed_arrays import pack_bytes, unpack_arrays, unpack_bytes

FEW = ["mapping.iterations_per_frame=1", "mapping.first_frame_iterations=4", "refine_iterations=0"]


def ggslam(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "120"})


@pytest.fixture(scope="module")
def run(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    def build(folder: Path) -> None:
        request = SequenceRequest(room, stop=8)
        execute(RunRequest(request, out=folder, overrides=FEW, evaluate=False))

    return RunFolder.open(build_once(session_folder(tmp_path_factory) / "contained" / "run", build))


@pytest.fixture(scope="module")
def container(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("container") / "run.ggz"
    result = ggslam("encode", run.path, out, "--slices", 2, "--rate", "r04")
    assert result.exit_code == 0 and "places.bin" in result.output and "times as many" in result.output, result.output
    assert "rate r04 costs 0.05 to 0.4 dB" in " ".join(result.output.split())
    return out


@pytest.fixture(scope="module")
def again(container: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp("decoded") / "again"
    assert ggslam("decode", container, out).exit_code == 0
    return RunFolder.open(out)


def in_order(folder: RunFolder) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, births and object ids of a map, sorted by place to a centimetre."""
    gaussians = folder.gaussians()
    births = read_all_arrays(folder.path / "places.npz", "places")["birth"]
    means = gaussians.means.numpy()
    order = np.lexsort((births, *np.rint(20 * means).T))
    return means[order], births[order], gaussians.object_id.numpy()[order]


@pytest.mark.long("a run of a generated room is made")
def test_a_run_comes_back(run: RunFolder, container: Path, again: RunFolder) -> None:
    assert container.stat().st_size < 0.5 * sum(f.stat().st_size for f in run.path.glob("[mp]*.[pn][lp][yz]"))
    for name in ("keyframes.json", "trajectory.txt", "config.yaml", "sequence.json", "objects.json", "classifier.npz"):
        assert (again.path / name).read_bytes() == (run.path / name).read_bytes()
    before, after = run.gaussians(), again.gaussians()
    assert len(before) == len(after)
    for k in (0, 2):  # births, and ids: of the same number of Gaussians each, wherever they went
        counts = [np.unique(np.round(in_order(folder)[1 + k // 2], 3), return_counts=True) for folder in (run, again)]
        np.testing.assert_array_equal(counts[0], counts[1])
    low, high = before.means.min(0).values, before.means.max(0).values
    step = max(float((high - low).max()) / 2**18, float(before.log_scales.median(1).values.median().exp()) / 64)
    means = [np.sort(m.means.numpy(), axis=0) for m in (before, after)]
    np.testing.assert_allclose(means[1], means[0], atol=0.51 * step)
    mark = again.mark()
    assert mark.complete and "decoded" in mark.edits[-1] and mark.files is not None and "map.ply" in mark.files


def test_places_come_back_bit_for_bit_in_fewer_bytes(run: RunFolder, container: Path, again: RunFolder) -> None:
    before, after = (read_all_arrays(f.path / "places.npz", "places") for f in (run, again))
    assert list(before) == list(after)
    for name in set(before) - {"birth"}:
        assert before[name].dtype == after[name].dtype and before[name].tobytes() == after[name].tobytes(), name
    plain = sum(values.nbytes for name, values in before.items() if name != "birth")
    with zipfile.ZipFile(container) as archive:
        assert archive.getinfo("places.bin").file_size < 0.8 * plain
        texts = [info for info in archive.infolist() if info.filename.endswith(".json.xz")]
        assert sum(i.file_size for i in texts) < 0.5 * sum((run.path / i.filename[:-3]).stat().st_size for i in texts)


def test_files_of_version_1_are_read(run: RunFolder, container: Path, again: RunFolder, tmp_path: Path) -> None:
    """Whose members were the run's own files."""
    with zipfile.ZipFile(container) as archive:
        head = json.loads(archive.read("container.json"))
        members = {}
        for name in archive.namelist():
            content = archive.read(name)
            members[name.removesuffix(".xz")] = unpack_bytes(content) if name.endswith(".xz") else content
    members["places.npz"] = arrays_to_bytes(**unpack_arrays(members.pop("places.bin")))
    del members["container.json"]
    files = {name: {"bytes": len(b), "sha256": hashlib.sha256(b).hexdigest()} for name, b in members.items()}
    with zipfile.ZipFile(tmp_path / "old.ggz", "w") as archive:
        for name, content in {
            "container.json": json.dumps({**head, "version": 1, "files": files}).encode(), **members,
        }.items():  # fmt: skip
            archive.writestr(name, content)
    old = read_container(tmp_path / "old.ggz", tmp_path / "old")
    for name in ("map.ply", "places.npz", "objects.json", "keyframes.json"):
        assert (old.path / name).read_bytes() == (again.path / name).read_bytes(), name


def test_identity_vectors_say_the_object(run: RunFolder, again: RunFolder) -> None:
    scene = again.segmented_map()
    labels, _ = scene.classifier.labels(scene.gaussians.features.numpy())
    ids = scene.gaussians.object_id.numpy()
    known = np.isin(ids, scene.classifier.class_ids)
    assert known.mean() > 0.5 and (labels[known] == ids[known]).mean() > 0.99
    assert again.object_table().ids() == run.object_table().ids()


@pytest.mark.long("two runs are merged")
def test_containers_are_merged(container: Path, room: Path, tmp_path: Path) -> None:
    pytest.importorskip("gtsam")
    other = tmp_path / "other"
    execute(RunRequest(SequenceRequest(room, start=4, stop=12), out=other, overrides=FEW, evaluate=False))
    result = ggslam("merge", container, other, "--out", tmp_path / "both", "--steps", 0)
    assert result.exit_code == 0, (result.output, result.exception)
    merged = RunFolder.open(tmp_path / "both").mark().merged
    assert merged is not None and [part.run for part in merged] == [str(container), str(other)]
    assert "run.ggz" in result.output


def test_inspect_says_what_is_inside(run: RunFolder, container: Path, tmp_path: Path) -> None:
    found = contents_of_run(container)
    facts = dict(found.facts)
    assert found.gaussians == len(run.gaussians()) == int(facts["Gaussians"]) and not found.problems
    assert facts["keyframes"] == f"{len(run.keyframes().keyframes)} of 8 frames"
    assert facts["objects"].startswith(f"{len(run.object_table())}: ") and "rate r04" in facts["map of a run"]
    assert sum(found.parts.values()) == container.stat().st_size
    with zipfile.ZipFile(container) as archive:
        stream = archive.read("map.bin")
        assert found.parts["places.bin"] == archive.getinfo("places.bin").file_size
    parts = list_units(stream).parts
    assert found.parts["positions"] == parts["geometry"] and found.parts["colours"] == parts["sh_0"]
    said = ggslam("inspect", container)
    assert said.exit_code == 0
    for words in ("Gaussians", "keyframes", "places.bin", str(container.stat().st_size), str(parts["scale"])):
        assert words in said.output, words
    (tmp_path / "cut.ggz").write_bytes(container.read_bytes()[:-1000])
    for path in (tmp_path / "cut.ggz", tmp_path / "none.ggz"):
        assert isinstance(ggslam("inspect", path).exception, GgslamError)


def _rewritten(container: Path, out: Path, **changes: bytes | None) -> Path:
    """The container with other members; the head tells their checksums unless it is given."""
    with zipfile.ZipFile(container) as archive:
        members: dict[str, bytes | None] = {name: archive.read(name) for name in archive.namelist()}
    members |= {name.replace("_json", ".json").replace("_bin", ".bin"): value for name, value in changes.items()}
    there = {name: value for name, value in members.items() if value is not None}
    if "container_json" not in changes:
        head = json.loads(there["container.json"])
        head["files"] = {
            name: {"bytes": len(b), "sha256": hashlib.sha256(b).hexdigest()} for name, b in there.items()
        }
        there["container.json"] = json.dumps(head).encode()
    with zipfile.ZipFile(out, "w") as archive:
        for name, value in there.items():
            archive.writestr(name, value)
    return out


def test_what_is_damaged_is_refused(container: Path, tmp_path: Path) -> None:
    content, bad = bytearray(container.read_bytes()), tmp_path / "bad.ggz"
    with zipfile.ZipFile(container) as archive:
        head = json.loads(archive.read("container.json"))
    cases: list[tuple[Path, str]] = [
        (_rewritten(container, tmp_path / "later.ggz", container_json=json.dumps({**head, "version": 3}).encode()),
         r"\b3\b.*\b2\b"),
        (_rewritten(container, tmp_path / "other.ggz", container_json=b"{}"), "container.json"),
        (_rewritten(container, tmp_path / "wrong.ggz", container_json=json.dumps({**head, "files": {}}).encode()),
         "run.json.xz.*container.json"),
        (_rewritten(container, tmp_path / "less.ggz", map_bin=None), "map.bin"),
        (_rewritten(container, tmp_path / "more.ggz", **{"../../outside": b"x"}), r"\.\./\.\./outside"),
        (_rewritten(container, tmp_path / "stream.ggz", map_bin=b"no stream"), "map.bin"),
        (_rewritten(container, tmp_path / "record.ggz", **{"run.json.xz": pack_bytes(b"[]")}), "run.json"),
        (_rewritten(container, tmp_path / "packed.ggz", **{"run.json.xz": b"[]"}), "run.json.xz"),
        (_rewritten(container, tmp_path / "twice.ggz", **{"run.json": b"[]"}), r"run\.json$"),
        (_rewritten(container, tmp_path / "places.ggz", **{"places.bin": b"[]"}), "places.bin"),
        (_rewritten(container, tmp_path / "nowhere.ggz", **{"places.bin": None}), "places.bin"),
    ]  # fmt: skip
    bad.write_bytes(content[: len(content) // 2])
    cases.append((bad, "bad.ggz"))
    content[len(content) // 2] ^= 255
    (tmp_path / "flipped.ggz").write_bytes(content)
    cases.append((tmp_path / "flipped.ggz", "flipped.ggz"))
    for path, reason in cases:
        with pytest.raises(GgslamError, match=reason) as caught:
            read_container(path, tmp_path / "out")
        assert path.name in str(caught.value) and caught.value.exit_code == 2
        assert not (tmp_path / "out").exists() and not (tmp_path.parent / "outside").exists()


def test_what_cannot_be_sent(run: RunFolder, container: Path, tmp_path: Path) -> None:
    for words, reason in (
        (["encode", run.path / "map.ply", tmp_path / "a.ggz"], "map.ply"),
        (["encode", run.path, tmp_path / "a.ggz", "--qp", 30], "--rate"),
        (["decode", container, tmp_path / "b", "--slice", 0], "as a whole"),
    ):
        result = ggslam(*words)
        assert isinstance(result.exception, GgslamError) and reason in str(result.exception)
    assert not list(tmp_path.iterdir())
    with pytest.raises(FormatError, match=r"none\.ggz"):
        read_container(tmp_path / "none.ggz", tmp_path / "out")
    with pytest.raises(RunFolderError, match="`overwrite`.*`out`"):
        read_container(container, run.path)
