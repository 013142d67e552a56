# SPDX-License-Identifier: Apache-2.0
"""Binary glTF, splats and meshes, in the Khronos Group's own validator, where there is one: GGSLAM_GLTF_VALIDATOR names
the folder of the package (npm install gltf-validator; node_modules/gltf-validator)."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import succeed

from ggslam.runs.folder import RunFolder

SCRIPT = """
const [folder, file] = process.argv.slice(1);
require(folder).validateBytes(new Uint8Array(require("fs").readFileSync(file)))
  .then(report => console.log(JSON.stringify(report)));
"""


@pytest.fixture(scope="module")
def validated() -> Callable[[Path], dict[str, Any]]:
    """Gives the validator's report on a file."""
    folder = os.environ.get("GGSLAM_GLTF_VALIDATOR")
    if not folder:
        pytest.skip("no glTF validator (GGSLAM_GLTF_VALIDATOR)")

    def report(path: Path) -> dict[str, Any]:
        words = ["node", "-e", SCRIPT, str(Path(folder).resolve()), str(path)]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return report


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("with_objects", [True, False], ids=["objects", "plain"])
def test_splats(
    degree: int, with_objects: bool, exported: Callable[[str, int, bool], Path],
    validated: Callable[[Path], dict[str, Any]],
) -> None:  # fmt: skip
    """It knows neither extension yet, so it minds the names of their attributes; nothing else."""
    found = validated(exported("gltf", degree, with_objects))["issues"]["messages"]
    minded = {(issue["code"], issue["pointer"].rpartition("/")[2].partition(":")[0]) for issue in found}
    names = {("UNSUPPORTED_EXTENSION", str(number)) for number in range(1 + with_objects)}
    assert minded <= names | {("MESH_PRIMITIVE_INVALID_ATTRIBUTE", "KHR_gaussian_splatting")}


def test_mesh(room_run: RunFolder, tmp_path: Path, validated: Callable[[Path], dict[str, Any]]) -> None:
    pytest.importorskip("trimesh", reason="trimesh is not installed (extra [mesh]; it writes GLB)")
    succeed("export", room_run.path, "--format", "mesh", "--voxel", 0.08, "--out", tmp_path / "room.glb")
    report = validated(tmp_path / "room.glb")
    assert report["info"]["totalTriangleCount"] > 1000
    assert not [issue for issue in report["issues"]["messages"] if issue["severity"] < 2], report["issues"]
