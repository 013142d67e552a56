# SPDX-License-Identifier: Apache-2.0
"""A loss of one's own in the mapper."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from ggslam.cuda.library import CudaLibrary
from ggslam.errors import RenderError
from ggslam.mapping.extra_loss import ExtraLoss
from ggslam.mapping.keyframe import Keyframe
from ggslam.rendering import render
from ggslam.rendering.types import PARAMETERS, RenderBuffers
from ggslam.sequences import open_sequence
from ggslam.slam.config import load_config
from ggslam.slam.slam import Slam

SETTINGS = ["threads=1", "mapping.first_frame_iterations=6", "mapping.iterations_per_frame=2"]


def trained(room: Path, loss: ExtraLoss | None, *settings: str, masks: bool = False) -> Slam:
    sequence = open_sequence(room, stop=3, scale=0.5)
    slam = Slam(sequence.camera, load_config(None, [*SETTINGS, *settings]), has_masks=masks, extra_loss=loss)
    for frame in sequence.stream(masks=masks):
        slam.step(frame)
    return slam


def same(one: Slam, other: Slam) -> bool:
    """Whether colours and shapes are; identity vectors have compact moments where no loss of one's own may use them."""
    names = [name for name in PARAMETERS if name != "features"]
    return all(torch.equal(getattr(one.map, name), getattr(other.map, name)) for name in names)


def test_a_loss_of_nothing_changes_no_bit(room: Path) -> None:
    plain = trained(room, None)
    assert same(plain, trained(room, lambda view, keyframe: torch.zeros(())))
    assert same(plain, trained(room, lambda view, keyframe: 0 * view.image.sum() + 0 * view.alpha.sum()))


def test_colours_follow_it(room: Path) -> None:
    seen: list[tuple[int, int]] = []

    def redder(view: RenderBuffers, keyframe: Keyframe) -> torch.Tensor:
        assert view.image.requires_grad and view.features is None
        seen.append((keyframe.index, view.image.shape[2]))
        return -5 * view.image[0].mean()

    plain, red = trained(room, None), trained(room, redder)
    assert red.map.rgb[:, 0].mean() > plain.map.rgb[:, 0].mean() + 0.02
    assert len(seen) == red.mapper.times.iterations == 10 and seen[0] == (0, 80)


def first_view(slam: Slam) -> RenderBuffers:
    keyframe = slam.mapper.keyframes[0]
    return render(slam.map, keyframe.camera, keyframe.T_camera_world)


def test_depth_and_alpha_follow_it(room: Path) -> None:
    plain = first_view(trained(room, None))
    nearer = first_view(trained(room, lambda view, keyframe: 5 * view.depth.mean()))
    thinner = first_view(trained(room, lambda view, keyframe: 5 * view.alpha.mean()))
    assert nearer.depth.mean() < plain.depth.mean() - 0.05
    assert thinner.alpha.mean() < plain.alpha.mean() - 0.05


def test_features_only_on_request(room: Path) -> None:
    class Larger:
        uses_features = True

        def __call__(self, view: RenderBuffers, keyframe: Keyframe) -> torch.Tensor:
            assert view.features is not None and view.features.shape[0] == 16
            return -view.features.mean()

    plain, larger = (trained(room, loss, masks=True) for loss in (None, Larger()))
    assert larger.map.features.mean() > plain.map.features.mean() + 0.01


@pytest.mark.parametrize(
    ("loss", "message"),
    [(lambda view, keyframe: view.image, r"\[3, 60, 80\]"),
     (lambda view, keyframe: 1.0, "float"),
     (lambda view, keyframe: (view.depth - view.depth).sqrt().sum(), "depth")],
)  # fmt: skip
def test_what_is_no_loss_is_refused(room: Path, loss: ExtraLoss, message: str) -> None:
    with pytest.raises(RenderError, match=message):
        trained(room, loss)


@pytest.mark.long("the kernels run in an emulation of CUDA")
def test_a_device_follows_it_as_the_cpu_does(room: Path) -> None:
    """Kernels and torch share the gradients: colours, depth and alpha move by as much on either."""
    from cuda_emulation import emulated_library

    def pull(view: RenderBuffers, keyframe: Keyframe) -> torch.Tensor:
        return 0.3 * view.depth.mean() - 2 * view.image[0].mean() + 2 * view.alpha.mean()

    def mapped(loss: ExtraLoss | None, library: CudaLibrary | None) -> RenderBuffers:
        sequence = open_sequence(room, stop=2, scale=0.25)
        slam = Slam(sequence.camera, load_config(None, SETTINGS), False, library=library, extra_loss=loss)
        for frame in sequence.stream(masks=False):
            slam.step(frame)
        camera = slam.mapper.keyframes[0].camera
        return render(slam.map.to("cpu"), camera, torch.from_numpy(slam.mapper.keyframes[0].T_camera_world))

    library = emulated_library()
    moved = {}
    for name, kernels in (("cpu", None), ("device", library)):
        plain, pulled = mapped(None, kernels), mapped(pull, kernels)
        moved[name] = [float((getattr(pulled, part) - getattr(plain, part)).mean()) for part in ("depth", "alpha")]
        moved[name].append(float((pulled.image[0] - plain.image[0]).mean()))
    depth, alpha, red = moved["cpu"]
    assert depth < -0.1 and alpha < -0.05 and red > 0.1
    assert moved["device"] == pytest.approx(moved["cpu"], rel=0.05)
