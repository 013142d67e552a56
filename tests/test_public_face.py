# SPDX-License-Identifier: Apache-2.0
"""What `import ggslam` gives: these names and no others, lazily, and what documentation and examples use is theirs."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ggslam

ROOT = Path(__file__).parents[1]
NAMES = """
    Camera CodecSettings Config ConfigError DistanceField DistortedCamera Edit FormatError Frame GaussianMap
    GaussianModel GgslamError InputError LiveSequence MissingDependency ObjectTable OccupancyMap OrthographicCamera
    RenderBuffers RenderError RunFolder RunFolderError RunOutcome SegmentationCounts Sequence SequenceError Slam
    SlamResult StepReport Trajectory TsdfMap collate_frames color_loss compare_maps decode_cloud depth_loss edit_run
    encode_cloud evaluate_run export_run find_changes fuse_volumes identity_loss load_config localize_recording
    merge_runs neighbour_loss objects_at open_sequence plan_path read_gaussian_ply read_point_cloud read_splats
    read_trajectory refine_run render render_film render_plan render_run run_recording sample_points save_run
    score_cloud score_image score_trajectory surface_points update_run write_gaussian_ply write_point_cloud
    write_synthetic_sequence write_tum
"""
PUBLIC = NAMES.split()


def test_the_list() -> None:
    assert sorted(ggslam.__all__) == sorted([*PUBLIC, "__version__"])
    assert dir(ggslam) == sorted(ggslam.__all__) and len(PUBLIC) < 72


@pytest.mark.parametrize("name", PUBLIC)
def test_every_name_is_there_and_documented(name: str) -> None:
    thing = getattr(ggslam, name)
    assert thing.__name__ == name
    assert inspect.getdoc(thing), f"{name} says nothing"
    own = inspect.getdoc(thing) != inspect.getdoc(thing.__mro__[1]) if inspect.isclass(thing) else True
    assert own, f"{name} has only the words of what it is derived from"
    if inspect.isfunction(thing):
        arguments = set(inspect.signature(thing).parameters) - {"gaussians"}
        text = inspect.getdoc(thing) or ""
        assert len(arguments) < 3 or "Args:" in text, f"{name} does not explain its arguments"


def test_editors_and_mypy_see_what_is_loaded() -> None:
    """The imports for type checkers are those that are made when a name is used."""
    tree = ast.parse((ROOT / "ggslam" / "__init__.py").read_text())
    block = next(node for node in tree.body if isinstance(node, ast.If))
    shown = {alias.name: str(n.module) for n in block.body if isinstance(n, ast.ImportFrom) for alias in n.names}
    assert shown == ggslam._HOME_OF


def test_unknown_names() -> None:
    with pytest.raises(AttributeError, match="no attribute 'GaussianModle'; did you mean GaussianModel"):
        ggslam.GaussianModle  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'CpuRasterizer'"):
        exec("from ggslam import CpuRasterizer")
    assert importlib.import_module("ggslam.rendering.cpu").CpuRasterizer  # there, but nobody promises anything


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, ggslam; "
        "print(sorted(n for n in sys.modules if n.split('.')[0] in ('torch','numpy','cv2','scipy','pydantic')))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert result.stdout.strip() == "[]"


def programs() -> list[tuple[str, str]]:
    """(place, Python) of everything that shows others how ggslam is used."""
    found = [(path.name, path.read_text()) for path in sorted((ROOT / "examples").glob("*.py"))]
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for number, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.S)):
            found.append((f"{page.name}, block {number}", block))
    return found


@pytest.mark.skipif(not (ROOT / "docs").is_dir(), reason="not in a checkout")
@pytest.mark.parametrize(("place", "text"), programs(), ids=[place for place, _ in programs()])
def test_what_is_shown_uses_the_public_face(place: str, text: str) -> None:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            private = [alias.name for alias in node.names if alias.name.startswith("ggslam.")]
            assert not private, f"{place}, line {node.lineno}: {private}"
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "ggslam":
            assert node.module == "ggslam", f"{place}, line {node.lineno}: {node.module}"
            assert all(alias.name in PUBLIC for alias in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "ggslam":
            assert node.attr in [*PUBLIC, "__version__"], f"{place}, line {node.lineno}: ggslam.{node.attr}"
