# SPDX-License-Identifier: Apache-2.0
"""Damaged archives, videos and bags: one line that names the file and the reason."""

from __future__ import annotations

import json
import re
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from format_makers import MORE_MAKERS, make_record3d, make_stray, write_bag

from ggslam.errors import MissingDependency, SequenceError
from ggslam.sequences import open_sequence


def truncate(path: Path, share: float = 0.6) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def message_of(place: Path) -> str:
    """What opening and reading a recording says."""
    with pytest.raises(SequenceError) as caught:
        for _ in open_sequence(place).stream():
            pass
    assert "\n" not in str(caught.value)
    return str(caught.value)


def rewrite(path: Path, change: Callable[[str, bytes], bytes | None]) -> None:
    """Changes members of an archive; None leaves one out."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            changed = change(name, content)
            if changed is not None:
                archive.writestr(name, changed)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda name, content: None if name == "metadata" else content, "walk.r3d: holds no metadata"),
        (lambda name, content: b"{" if name == "metadata" else content, "walk.r3d, metadata: not JSON"),
        (lambda name, content: None if name.endswith("3.depth") else content, "frame 3: .*rgbd/3.depth is missing"),
        (lambda name, content: None if name.endswith(".depth") else content, "a recording without depth"),
        (lambda name, content: content[:-9] if name.endswith("3.depth") else content, "3.depth: .*LZFSE"),
        (lambda name, content: content[:-200] if name.endswith("3.jpg") else content, "3.jpg: JPEG is truncated"),
        (lambda name, content: b"" if name.endswith("2.jpg") else content, "2.jpg: file is empty"),
    ],
)
def test_record3d(tmp_path: Path, change: Callable[[str, bytes], bytes | None], message: str) -> None:
    path = make_record3d(tmp_path)
    rewrite(path, change)
    assert re.search(message, message_of(path))


def test_record3d_other_damage(tmp_path: Path) -> None:
    path = make_record3d(tmp_path)
    content = json.loads(zipfile.ZipFile(path).read("metadata"))
    wrong = json.dumps({**content, "dw": 33}).encode()
    rewrite(path, lambda name, data: wrong if name == "metadata" else data)
    assert "0.depth: expected 3168 bytes for 33x24 pixels, found 3072" in message_of(path)
    truncate(path)
    assert "walk.r3d: not a whole zip archive (truncated?)" in message_of(path)


def test_an_archive_of_a_later_version(tmp_path: Path) -> None:
    path = make_record3d(tmp_path)
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + 6] = 127  # version that is needed to extract
    path.write_bytes(bytes(content))
    assert "walk.r3d: not a whole zip archive" in message_of(path) and "version 12.7" in message_of(path)


def test_flipped_bits_inside_an_archive(tmp_path: Path) -> None:
    path = make_record3d(tmp_path)
    content = bytearray(path.read_bytes())
    at = content.index(b"rgbd/2.depth") + 60
    content[at] ^= 64
    path.write_bytes(bytes(content))
    assert "rgbd/2.depth: cannot be read: Bad CRC-32" in message_of(path)


def test_video(tmp_path: Path) -> None:
    make_stray(tmp_path)
    lines = (tmp_path / "odometry.csv").read_text().splitlines()
    (tmp_path / "odometry.csv").write_text("\n".join([*lines, lines[-1].replace("000004", "000009")]))
    (tmp_path / "depth" / "000009.png").write_bytes((tmp_path / "depth" / "000004.png").read_bytes())
    assert "rgb.mp4 ends before it, after 5 frames" in message_of(tmp_path)
    assert len(list(open_sequence(tmp_path, on_bad_frame="skip").stream())) == 5
    (tmp_path / "odometry.csv").write_text("\n".join([*lines[:-1], lines[-1][:40]]))
    assert "odometry.csv, line 6: expected 9 numbers, found" in message_of(tmp_path)
    (tmp_path / "odometry.csv").write_text("\n".join(lines))
    truncate(tmp_path / "rgb.mp4")
    assert "rgb.mp4: cannot be opened as a video (truncated" in message_of(tmp_path)


@pytest.mark.parametrize("ros2", [False, True])
def test_bags(tmp_path: Path, ros2: bool) -> None:
    path = write_bag(tmp_path / ("walk" if ros2 else "walk.bag"), ros2)
    truncate(next(path.glob("*.db3")) if ros2 else path)
    message = message_of(path)
    assert str(path) in message and ("not a whole bag" in message or "bag is damaged" in message)


def test_bag_without_depth(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "walk.bag", False, count=0)
    assert "walk.bag: no topic of color images; it holds" in message_of(path)


@pytest.mark.parametrize(
    ("name", "file", "message"),
    [
        ("polycam", "keyframes/cameras/1002.json", "1002.json: file is missing"),
        ("polycam", "keyframes/depth/1002.png", "depth file .*1002.png is missing"),
        ("vmap", "imap/00/depth/depth_2.png", "depth file .*depth_2.png is missing"),
        ("icl-nuim", "depth/2.png", "depth file .*2.png is missing"),
        ("nerfstudio", "depth/2.png", "depth file .*2.png is missing"),
        ("scannet++", "dslr/undistorted_depths/DSC02.png", "depth file .*DSC02.png is missing"),
        ("strayscanner", "camera_matrix.csv", "camera_matrix.csv: file is missing"),
    ],
)
def test_missing_files(tmp_path: Path, name: str, file: str, message: str) -> None:
    folder = MORE_MAKERS[name](tmp_path)
    (folder / file).unlink()
    assert re.search(message, message_of(folder))


@pytest.mark.parametrize(
    ("module", "extra", "make"),
    [
        ("liblzfse", "phone", make_record3d), ("rosbags.highlevel", "ros", lambda p: write_bag(p / "a.bag", False)),
        ("rosbags.highlevel", "ros", lambda p: write_bag(p / "a", True)),
    ],
)  # fmt: skip
def test_missing_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, extra: str, make: Callable[[Path], Path]
) -> None:
    path = make(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependency, match=rf"pip install 'ggslam\[{extra}\]'"):
        open_sequence(path)
