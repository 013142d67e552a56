# SPDX-License-Identifier: Apache-2.0
"""What tests need and few of them change: made once for all processes that share the tests."""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from ggslam.synthetic import Scene

CHECKOUT = Path(__file__).parents[1]


@contextmanager
def one_at_a_time(place: Path) -> Iterator[None]:
    """While one process builds what belongs at a place, others that want it wait."""
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.with_name(place.name + ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def build_once(folder: Path, build: Callable[[Path], object]) -> Path:
    """The folder, built by whoever comes first; the others wait. A build that broke off is begun again."""
    done = folder.with_name(folder.name + ".done")
    with one_at_a_time(folder):
        if not done.exists():
            if folder.exists():
                folder.rename(folder.with_name(f"{folder.name}.broken-{os.getpid()}"))
            build(folder)
            done.touch()
    return folder


def session_folder(factory: pytest.TempPathFactory) -> Path:
    """A folder of this run of the tests, the same for all its processes."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def cached_folder(name: str, *sources: Path) -> Path:
    """A folder that outlives this run of the tests, until one of these sources changes."""
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    return CHECKOUT / "build" / "tests" / f"{name}-{digest.hexdigest()[:16]}"


@contextmanager
def points_in_voxels_of(size: float) -> Iterator[None]:
    """Runs that are saved, also after edits, sample their clouds in voxels of this size, metres, not of 0.01."""
    from ggslam.runs.map_points import map_points

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ggslam.runs.saving_parts.map_points", partial(map_points, voxel_size=size))
        yield


@contextmanager
def light_maps_kept() -> Iterator[None]:
    """Light maps of scenes with many things are computed once, until what computes them changes: most of what a small
    recording takes, and the same for all that show one scene."""
    from ggslam.synthetic import lighting, raycast

    def bake(scene: Scene) -> lighting.LightMaps:
        if len(scene.shapes) < 20:
            return lighting.bake(scene)
        bare = [dataclasses.replace(shape, material=None, faces={}) for shape in scene.shapes]  # type: ignore[arg-type]
        precision = (
            lighting.LightingTuning.patch_m,
            lighting.LightingTuning.max_patches,
            lighting.LightingTuning.ambient_rays,
        )
        words = pickle.dumps((dataclasses.replace(scene, shapes=bare), precision))
        name = f"lights-{hashlib.sha256(words).hexdigest()[:16]}"

        def build(folder: Path) -> None:
            folder.mkdir()
            np.savez(folder / "maps.npz", **vars(lighting.bake(scene)))

        return lighting.LightMaps(**np.load(build_once(cached_folder(name, *_synthetic_sources()), build) / "maps.npz"))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raycast, "bake", bake)
        yield


def _synthetic_sources() -> list[Path]:
    import ggslam

    package = Path(ggslam.__file__).parent
    return sorted([*package.glob("synthetic/*.py"), *package.glob("scene/*.py")])


def generated_recording(
    factory: pytest.TempPathFactory, name: str, write: Callable[..., Path] | None = None, **options: Any
) -> Path:
    """A recording as `write_synthetic_sequence` (or `write`) draws it with these options, not to be changed. Drawing
    takes longest of all that tests need; it is kept until what draws changes, and every run of the tests has a copy."""
    from ggslam.synthetic import write_synthetic_sequence

    words = "-".join([name, *(f"{key}={value}" for key, value in sorted(options.items()))])
    cached = build_once(
        cached_folder(words, *_synthetic_sources()),
        lambda folder: (write or write_synthetic_sequence)(folder, **options),
    )
    return build_once(session_folder(factory) / "recordings" / name, lambda to: shutil.copytree(cached, to))
