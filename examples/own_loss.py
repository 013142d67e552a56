# SPDX-License-Identifier: Apache-2.0
"""A loss of one's own in a run: surfaces are either there or not, and colours are not paler than what was seen.

    ggslam run recordings/kitchen --loss examples/own_loss.py:no_fog
    python examples/own_loss.py recordings/kitchen          # the same from Python, compared with a run without it
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch

import ggslam
from ggslam import RenderBuffers


class Seen(Protocol):
    """What these losses read of a keyframe."""

    color: np.ndarray
    """uint8 [H, W, 3]."""


Loss = Callable[[RenderBuffers, Seen], torch.Tensor]


def no_fog(view: RenderBuffers, keyframe: Seen) -> torch.Tensor:
    """Pixels are covered wholly or not at all."""
    return 0.05 * (view.alpha * (1 - view.alpha)).mean()


def same_saturation(view: RenderBuffers, keyframe: Seen) -> torch.Tensor:
    """Colours are as far from grey as in the keyframe's image. What a keyframe holds is on the host: it goes to the
    device of what was rendered."""
    seen = torch.from_numpy(keyframe.color).to(view.image.device).permute(2, 0, 1) / 255
    return 0.1 * (view.image.std(dim=0) - seen.std(dim=0)).abs().mean()


def fog(recording: str, loss: Loss | None, frames: int) -> float:
    """Mean of alpha (1 - alpha) in the last keyframe's view, after a run."""
    sequence = ggslam.open_sequence(recording, stop=frames, scale=0.5)
    slam = ggslam.Slam(sequence.camera, has_masks=False, extra_loss=loss)
    for frame in sequence.stream(masks=False):
        slam.step(frame)
    result = slam.finish()
    keyframe = result.keyframes[-1]
    view = ggslam.render(result.gaussians, keyframe.camera, T_world_camera=keyframe.T_world_camera)
    return float((view.alpha * (1 - view.alpha)).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording")
    parser.add_argument("--frames", type=int, default=10)
    arguments = parser.parse_args()
    plain, sharp = (fog(arguments.recording, loss, arguments.frames) for loss in (None, no_fog))
    print(f"alpha (1 - alpha): {plain:.5f} without the loss, {sharp:.5f} with it")


if __name__ == "__main__":
    main()
