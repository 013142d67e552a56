# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import hashlib
import lzma
import zipfile
from pathlib import Path

import pytest

from ggslam.errors import FormatError
from ggslam.runs.map_container import open_container
from ggslam.runs.records.container import CONTAINER_FORMAT, CONTAINER_VERSION, ContainerRecord
from ggslam.runs.records.run_json import FileRecord


def test_members_expand_to_a_budget_together(tmp_path: Path) -> None:
    """Four of 30 MB each, in 20 kB: each may be as large, all of them not."""
    packed = lzma.compress(bytes(30 << 20))
    names = [f"{name}.xz" for name in ("keyframes.json", "trajectory.txt", "config.yaml", "sequence.json")]
    told = FileRecord(bytes=len(packed), sha256=hashlib.sha256(packed).hexdigest())
    head = ContainerRecord(
        format=CONTAINER_FORMAT, version=CONTAINER_VERSION, ggslam="1", gaussians=1, rate="r01",
        files=dict.fromkeys(names, told),
    )  # fmt: skip
    path = tmp_path / "bomb.ggz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("container.json", head.model_dump_json())
        for name in names:
            archive.writestr(name, packed)
    assert path.stat().st_size < 30_000
    with pytest.raises(FormatError, match=r"bomb\.ggz: config\.yaml\.xz: damaged"):
        open_container(path)
