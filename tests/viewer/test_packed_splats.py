# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
import zlib
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

from ggslam.cli.main import app
from ggslam.runs.folder import RunFolder
from ggslam.viewer.packed_splats import SCALES, STATIC, pack_splats

from .test_splats import some


def test_packed_splats_are_near_the_map() -> None:
    gaussians, rows, draw = some(50), np.arange(5, 45), np.random.default_rng(3)
    colors, identity = draw.integers(0, 256, (2, 40, 3), dtype=np.uint8)
    owners = draw.integers(0, 65536, 40).astype(np.uint16)
    packed, low, high = pack_splats(gaussians, rows, colors, owners, identity)
    data = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(-1, 40).astype(np.int64)
    assert len(data) == 22
    steps = np.stack([data[2 * axis] + 256 * data[2 * axis + 1] for axis in range(3)], axis=1)
    means = gaussians.means.numpy()[rows]
    assert np.abs(low + steps / 65535 * (high - low) - means).max() <= (high - low).max() / 65535
    scales = SCALES[0] + data[6:9].T / 255 * (SCALES[1] - SCALES[0])
    expected = np.clip(gaussians.log_scales.numpy()[rows], *SCALES)
    assert np.abs(scales - expected).max() <= (SCALES[1] - SCALES[0]) / 255
    turns = data[9:13].T - 128.0
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    real = gaussians.quaternions.numpy()[rows]
    assert (np.abs((turns * real).sum(axis=1)) / np.linalg.norm(real, axis=1) > 0.9998).all()
    assert np.array_equal(data[13:16].T, colors) and np.array_equal(data[19:22].T, identity)
    assert np.array_equal(data[17] + 256 * data[18], owners)


def test_the_program_of_the_page_names_no_address() -> None:
    for path in STATIC.iterdir():
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")  # a name, which nothing is fetched from
        assert not re.search(r"https?://|wss?://|\bimport\b|@import|innerHTML|outerHTML|insertAdjacentHTML", text), path


def test_the_command_writes_a_page(run: RunFolder, tmp_path: Path) -> None:
    path = tmp_path / "new" / "room.html"
    result = CliRunner().invoke(app, ["view", str(run.path), "--html", str(path), "--max-splats", "2000"])
    assert result.exit_code == 0 and "MB" in result.output, result.output
    text = path.read_text()
    assert "@SPLATS@" not in text and not re.search(r"https?://(?!www.w3.org/2000/svg)", text)
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', text, re.S).group(1))  # type: ignore[union-attr]
    assert scene["splats"]["count"] == 2000 and len(scene["objects"]) == len(run.object_table())
    assert len(scene["frames"]) == min(24, len(run.keyframes().poses())) and set(scene["views"]) == {"Start", "Top"}
