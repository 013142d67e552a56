# SPDX-License-Identifier: Apache-2.0
"""Whatever is given in place of a path or a map gets words, not the error of something inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ggslam

PATHS: dict[str, tuple[Any, ...]] = {
    "open_sequence": (), "run_recording": (), "fuse_volumes": (), "localize_recording": ("x",), "compare_maps": ("x",),
    "merge_runs": (), "find_changes": ("x",), "update_run": ("x", "out"), "refine_run": (), "export_run": ("x.ply",),
    "edit_run": ([ggslam.Edit("remove", "x")],), "render_run": ("out",), "render_film": ("x.mp4",),
    "render_plan": ("x.png",), "evaluate_run": (), "read_gaussian_ply": (), "read_splats": (), "read_point_cloud": (),
    "read_trajectory": (), "surface_points": (),
}  # fmt: skip
"""Functions that begin with a path or a run, and what follows."""
MAPS: dict[str, tuple[Any, ...]] = {"sample_points": (), "objects_at": (np.zeros(3),), "render": (None,)}
"""Functions that begin with Gaussians."""


@pytest.mark.parametrize("wrong", [None, 3, 1.5, [1], {}, object()], ids=lambda wrong: type(wrong).__name__)
@pytest.mark.parametrize("name", [*PATHS, *MAPS, "write_gaussian_ply"])
def test_other_types_get_words(name: str, wrong: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    more = {**PATHS, **MAPS}.get(name, ())
    arguments = ("x.ply", wrong) if name == "write_gaussian_ply" else (wrong, *more)
    if name == "merge_runs":
        arguments = ([wrong, wrong], "out")
    with pytest.raises((ggslam.GgslamError, TypeError)) as caught:  # of paths Python's own words are good
        getattr(ggslam, name)(*arguments)
    assert "expected" in str(caught.value) and type(wrong).__name__ in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_model_is_taken_where_maps_are(tmp_path: Path) -> None:
    ggslam.write_synthetic_sequence(tmp_path / "room", frames=2, width=64, height=48, seed=0)
    sequence = ggslam.open_sequence(tmp_path / "room")
    slam = ggslam.Slam(sequence.camera, ggslam.Config(mapping={"iterations_per_frame": 1}))
    slam.step(sequence[0])
    gaussians = slam.finish().gaussians
    model = ggslam.GaussianModel(gaussians)
    ggslam.write_gaussian_ply(tmp_path / "map.ply", gaussians)
    ggslam.write_gaussian_ply(tmp_path / "model.ply", model)
    one, other = (ggslam.read_gaussian_ply(tmp_path / f"{name}.ply") for name in ("map", "model"))
    assert np.allclose(one.means.numpy(), other.means.numpy()) and len(one) == len(other) > 100
    assert len(ggslam.sample_points(model, 0.02)) == len(ggslam.sample_points(gaussians, 0.02))
    places = gaussians.means.numpy()[:5]
    assert np.array_equal(ggslam.objects_at(model, places), ggslam.objects_at(gaussians, places))
