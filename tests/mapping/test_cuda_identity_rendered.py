# SPDX-License-Identifier: Apache-2.0
"""Identity learning on a GPU, or emulated, with a rasterizer: objects are learned, and nothing waits for the device."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from device_watch import DeviceWatch
from identity_picture import HEIGHT, WIDTH, MaskedKeyframe, picture

from ggslam.cuda.library import CudaLibrary
from ggslam.mapping.cuda.identity import CudaIdentityLearner
from ggslam.mapping.identity_settings import IdentitySettings, NeighbourSettings
from ggslam.rendering.cuda.rasterizer import CudaRasterizer
from ggslam.scene.camera import Camera
from ggslam.scene.gaussian_map import GaussianMap

CAMERA = Camera(WIDTH, HEIGHT, 20.0, 20.0, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5)


def wall(device: torch.device | str) -> GaussianMap:
    """A Gaussian at every second pixel and row, 2 m away."""
    u, v = np.meshgrid(np.arange(0.5, WIDTH, 2), np.arange(0.5, HEIGHT, 2))
    z = np.full(u.size, 2.0)
    means = np.stack([(u.reshape(-1) - CAMERA.cx) / 10, (v.reshape(-1) - CAMERA.cy) / 10, z], 1).astype(np.float32)
    gaussians, count = GaussianMap(0, 16, torch.device(device)), len(means)
    quaternions = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4)
    parameters = [torch.from_numpy(means), quaternions, torch.full((count, 3), -2.3), torch.full((count,), 3.0)]
    gaussians.insert(*(parameter.to(device) for parameter in parameters), torch.zeros(count, 3, device=device))
    return gaussians


@contextlib.contextmanager
def refusing_waits(library: CudaLibrary) -> Iterator[None]:
    """On a GPU, torch raises an error where it would wait."""
    if library.device_type != "cuda":
        yield
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_objects_are_learned(cuda_library: CudaLibrary) -> None:
    device = cuda_library.whole_device(None)
    settings = IdentitySettings(every=1, pixels=128, neighbours=NeighbourSettings(samples=40))
    learner = CudaIdentityLearner(settings, 0, device, cuda_library)
    gaussians, rasterizer = wall(device), CudaRasterizer(device, library=cuda_library)
    keyframe = MaskedKeyframe(0, picture(), device)
    learner.observe(picture())
    unknown = torch.zeros(len(gaussians), dtype=torch.int32, device=device)
    learner.begin(gaussians, slice(0, len(gaussians)), unknown)
    view = rasterizer.forward(gaussians, CAMERA, np.eye(4), features=False)
    with refusing_waits(cuda_library):
        for _ in range(25):
            assert learner.due(keyframe)
            learner.step(gaussians, rasterizer, keyframe, view)
    learner.label(gaussians)
    expected = picture()[::2, ::2].reshape(-1)
    assert (gaussians.object_id.cpu().numpy() == expected).mean() > 0.8  # some stand at a boundary
    shown = rasterizer.forward(gaussians, CAMERA, np.eye(4)).features
    assert shown is not None
    ids, _ = learner.classifier.labels(shown.cpu().numpy().transpose(1, 2, 0))
    assert (ids == picture())[picture() > 0].mean() > 0.9
    assert learner.last_loss < 0.7


@pytest.mark.parametrize("schedule", ["sampled", "dense", "votes"])
def test_a_step_waits_for_nothing(schedule: str) -> None:
    with DeviceWatch() as watch:
        pull = NeighbourSettings(samples=20, every=2)
        settings = IdentitySettings(schedule=schedule, every=1, pixels=64, neighbours=pull)  # type: ignore[arg-type]
        learner = CudaIdentityLearner(settings, library=watch.library)
        gaussians, rasterizer = wall("cuda"), CudaRasterizer(library=watch.library)
        keyframe = MaskedKeyframe(0, picture(), learner.device)
        learner.observe(picture())
        learner.begin(gaussians, slice(0, len(gaussians)), torch.ones(len(gaussians), dtype=torch.int32, device="cuda"))
        view = rasterizer.forward(gaussians, CAMERA, np.eye(4), features=schedule == "dense")
        learner.split(gaussians, rasterizer, picture(), [(1, 300)])
        watch.forget()
        for _ in range(4):
            assert learner.due(keyframe)
            learner.step(gaussians, rasterizer, keyframe, view)
        assert watch.waits == [] and watch.uploads == [] and watch.downloads == []
        names = {call.operation for call in watch.calls}
        of_call = {"learn", "vote_labels"}  # labels of the map, as an object has parts
        assert names >= {"draw_pixels", "cross_entropy"} if schedule == "dense" else names == of_call
        assert np.isfinite(learner.last_loss) == (schedule != "votes") and bool(watch.waits) == (schedule != "votes")
        learner.merge(gaussians, [(1, 2)])
        learner.forget(gaussians, [300])
        learner.label(gaussians)
        assert set(watch.read(gaussians.object_id).tolist()) == {1}
