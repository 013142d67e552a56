# SPDX-License-Identifier: Apache-2.0
"""Whatever is given where something else was asked for is recognised, and the command that takes it is named."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from command_line import ggslam, refuse, succeed

from ggslam.formats.point_cloud import write_point_cloud

SAMPLE = Path(__file__).parents[2] / "assets" / "sample"


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one of each."""
    place = tmp_path_factory.mktemp("places")
    for scene in ("room0", "office3"):
        shutil.copytree(SAMPLE, place / "scenes" / scene)
    shutil.copytree(SAMPLE, place / "others" / "kitchen")
    (place / "empty").mkdir()
    (place / "film.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(100))
    (place / "notes.txt").write_text("hello\n")
    with zipfile.ZipFile(place / "data.zip", "w") as archive:
        archive.writestr("a.txt", "a")
    write_point_cloud(place / "cloud.ply", np.array([[0.0, 0.0, 1.0]]), {})
    succeed("run", SAMPLE, "--stop", 3, "--out", place / "run", "--no-eval")
    return place


RUN = ("eval", "render", "view", "report", "refine", "verify", "edit --rename 1 a", "export --format spz --out x.spz")
RECORDING = ("run", "inspect", "volumes")


@pytest.mark.parametrize("words", RUN)
def test_a_recording_given_as_a_run_is_to_be_run(words: str, places: Path) -> None:
    command, *more = words.split()
    refuse(ggslam(command, SAMPLE, *more), "is a recording (", "`ggslam run ")


@pytest.mark.parametrize("command", RECORDING)
def test_a_run_given_as_a_recording_is_to_be_viewed(command: str, places: Path) -> None:
    if command != "volumes":  # which takes runs
        refuse(ggslam(command, places / "run"), "is a run of ggslam: `ggslam view ")


@pytest.mark.parametrize("command", (*RECORDING, "eval", "view"))
def test_a_folder_of_scenes_is_for_batch(command: str, places: Path) -> None:
    scenes = places / "scenes"
    told = f"holds 2 recordings (office3, room0): `ggslam batch --replica {scenes}`"
    refuse(ggslam(command, scenes), told)
    refuse(ggslam(command, places / "others"), f"holds 1 recording (kitchen): `ggslam batch {places / 'others'}`")


@pytest.mark.parametrize("command", ("run", "view", "compare"))
@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("film.mp4", "is a video, and ggslam needs a depth image"), ("data.zip", "is an archive: unpack it"),
        ("empty", "is an empty folder"), ("notes.txt", "is a file that ggslam does not know"),
    ],
)  # fmt: skip
def test_other_things_are_named(command: str, name: str, told: str, places: Path) -> None:
    path = places / name
    refuse(ggslam(command, path, *([path] if command == "compare" else [])), f"{path}: {told}")


def test_a_cloud_is_for_compare_and_encode(places: Path) -> None:
    refuse(ggslam("view", places / "cloud.ply"), "is a point cloud or a mesh: compare, encode and submaps take it")


@pytest.mark.parametrize("command", ("run", "view", "inspect", "verify", "batch"))
def test_an_address_is_to_be_downloaded(command: str) -> None:
    refuse(ggslam(command, "https://example.org/room0.zip"), "is an address", "download it")


@pytest.mark.parametrize("command", ("run", "view", "inspect", "batch"))
def test_the_nearest_name_is_proposed(command: str, places: Path) -> None:
    refuse(ggslam(command, places / "scense"), f"did you mean {places / 'scenes'}?")


def test_a_batch_of_one_recording_is_a_run(places: Path) -> None:
    refuse(ggslam("batch", SAMPLE), "is a recording (", "`ggslam run ")
    refuse(ggslam("batch", places / "run"), "is a run of ggslam")


def test_a_manifest_keeps_its_own_message(places: Path) -> None:
    path = places / "wrong.yaml"
    path.write_text("recording: [a]\n")
    refuse(ggslam("batch", path), "expected recordings and no other keys")
