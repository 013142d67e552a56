# SPDX-License-Identifier: Apache-2.0
"""Files of OpenUSD name other files, which the library opens: only such that lie beside them, and are files."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from ggslam.errors import FormatError
from ggslam.formats.gaussian_usd import write_gaussian_usd
from ggslam.formats.gaussian_usd_reading import read_gaussian_usd
from ggslam.scene.gaussian_map import GaussianMap

pytest.importorskip("pxr.UsdVol")
NAMING = {
    "sublayer": "#usda 1.0\n(\n metersPerUnit = 1\n subLayers = [@{}@]\n)\n",
    "reference": '#usda 1.0\n(\n metersPerUnit = 1\n)\ndef "x" (references = @{}@)\n{{\n}}\n',
    "payload": '#usda 1.0\n(\n metersPerUnit = 1\n)\ndef "x" (payload = @{}@)\n{{\n}}\n',
    "variant": '#usda 1.0\n(\n metersPerUnit = 1\n)\ndef "x" (prepend variantSets = "v"\n'
    ' variants = {{ string v = "a" }})\n{{\n variantSet "v" = {{\n  "a" (references = @{}@) {{\n  }}\n }}\n}}\n',
}


@pytest.fixture(autouse=True)
def in_time() -> Iterator[None]:
    def stop(*_: object) -> None:
        os.write(2, b"a file of OpenUSD was waited for\n")
        os._exit(1)  # the library waits where no exception gets to

    former = signal.signal(signal.SIGALRM, stop)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, former)


@pytest.fixture
def gaussians() -> GaussianMap:
    out = GaussianMap(0, with_moments=False)
    means = torch.arange(30.0).reshape(10, 3)
    out.insert(means, torch.ones(10, 4), torch.full((10, 3), -4.0), 0.5, torch.rand((10, 3)))
    return out


@pytest.mark.parametrize("way", NAMING)
def test_layers_beside_a_file_are_read(way: str, gaussians: GaussianMap, tmp_path: Path) -> None:
    write_gaussian_usd(tmp_path / "map.usda", gaussians)
    (tmp_path / "all.usda").write_text(NAMING[way].format("./map.usda"))
    columns, _ = read_gaussian_usd(tmp_path / "all.usda")
    np.testing.assert_allclose(columns.means, gaussians.means.numpy(), atol=1e-6)


@pytest.mark.parametrize("way", NAMING)
@pytest.mark.parametrize("kind", ["pipe", "device", "outside", "missing", "through another layer"])
def test_what_is_no_file_beside_it_is_not_opened(way: str, kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    target = folder / "b.usda"
    if kind in ("pipe", "through another layer"):
        os.mkfifo(target)
    elif kind == "device":
        target.symlink_to("/dev/zero")
    elif kind == "outside":
        target = tmp_path / "b.usda"
        target.write_text("#usda 1.0\n")
    name = os.path.relpath(target, folder)
    if kind == "through another layer":
        (folder / "c.usda").write_text(NAMING["sublayer"].format(f"./{name}"))
        name = "c.usda"
    (folder / "a.usda").write_text(NAMING[way].format(f"./{name}"))
    reason = {"outside": "outside the folder", "missing": "missing", "device": "outside the folder"}
    with pytest.raises(FormatError, match=reason.get(kind, "not a regular file")):
        read_gaussian_usd(folder / "a.usda")


def test_clips_name_further_files(tmp_path: Path) -> None:
    text = '#usda 1.0\ndef "x" (clips = {{ dictionary default = {{ asset[] assetPaths = [@{}@] }} }})\n{{\n}}\n'
    os.mkfifo(tmp_path / "b.usda")
    (tmp_path / "a.usda").write_text(text.format("./b.usda"))
    with pytest.raises(FormatError, match="not read|not a regular file"):
        read_gaussian_usd(tmp_path / "a.usda")
