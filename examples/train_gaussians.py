# SPDX-License-Identifier: Apache-2.0
"""Gaussians trained by a loop of one's own in PyTorch: from the points of one frame to a map of several views.

ggslam synth demo/room
python examples/train_gaussians.py demo/room demo/trained.ply
"""

from __future__ import annotations

import sys
from typing import cast

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

import ggslam
from ggslam import GaussianModel


def locate(sequence: ggslam.Sequence) -> np.ndarray:
    """T_world_camera of every frame, float64 [n, 4, 4]: tracked only, the map is not trained."""
    config = ["mapping.iterations_per_frame=0", "mapping.first_frame_iterations=0", "evaluation.held_out_every=0"]
    slam = ggslam.Slam(sequence.camera, ggslam.load_config(None, config), has_masks=False)
    for frame in sequence.stream(masks=False):
        slam.step(frame)
    return slam.finish().trajectory()


def begin(frame: ggslam.Frame, T_world_camera: np.ndarray, stride: int = 2) -> GaussianModel:
    """A Gaussian for every second pixel and row that has depth."""
    depth = frame.depth[::stride, ::stride]
    known = depth > 0
    points = frame.camera.back_project(frame.depth)[::stride, ::stride][known]
    world = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    colors = frame.color[::stride, ::stride][known]
    return GaussianModel.from_points(world, colors, scales=0.5 * stride * depth[known] / frame.camera.fx)


@torch.no_grad()
def mean_psnr(model: GaussianModel, sequence: ggslam.Sequence, poses: np.ndarray) -> float:
    """Over all pixels of all frames, dB."""
    scores = []
    for frame in sequence.stream(masks=False):
        view = ggslam.render(model, frame.camera, T_world_camera=poses[frame.index])
        error = view.image.clamp(0, 1) - torch.from_numpy(frame.color).permute(2, 0, 1) / 255
        scores.append(-10 * (error**2).mean().log10().item())
    return float(np.mean(scores))


def main(recording: str, out: str, frames: str = "6", epochs: str = "20") -> None:
    """Trains on the first `frames` frames and writes the Gaussians as PLY."""
    sequence = ggslam.open_sequence(recording, stop=int(frames))
    poses = locate(sequence)
    model = begin(sequence[0], poses[0])
    before = mean_psnr(model, sequence, poses)

    frames_of_it = cast("Dataset[ggslam.Frame]", sequence)  # it has what torch asks for, without loading torch
    loader = DataLoader(frames_of_it, batch_size=1, shuffle=True, collate_fn=ggslam.collate_frames)
    optimizer = torch.optim.Adam(model.parameter_groups(means=3e-4), eps=1e-15)
    for epoch in range(int(epochs)):
        for batch in loader:
            view = ggslam.render(model, sequence.camera, T_world_camera=poses[int(batch["index"])])
            loss = ggslam.color_loss(view.image, batch["color"][0])
            loss = loss + 0.5 * ggslam.depth_loss(view.depth, batch["depth"][0])
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]  # torch does not say its types
            optimizer.step()
        print(f"epoch {epoch}: loss {loss.item():.4f}")

    print(f"PSNR {before:.2f} dB before, {mean_psnr(model, sequence, poses):.2f} dB after, {len(model)} Gaussians")
    ggslam.write_gaussian_ply(out, model.to_map())


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) in (3, 4, 5) else sys.exit(__doc__)
