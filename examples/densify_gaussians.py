# SPDX-License-Identifier: Apache-2.0
"""A densification strategy of one's own: Gaussians are added where the training pulls hard, and faint ones go, as in
3D Gaussian Splatting (Kerbl et al. 2023). It begins with few Gaussians and trains on batches of views.

ggslam synth demo/room
python examples/densify_gaussians.py demo/room demo/dense.ply
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import cast

import torch
from torch.utils.data import DataLoader, Dataset
from train_gaussians import begin, locate, mean_psnr

import ggslam
from ggslam import GaussianModel

PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features")


class Densification:
    """Clones small Gaussians and splits large ones whose gradients are large; removes those that are hardly seen.

    Args:
        quantile: Gaussians whose gradient is above this quantile are cloned or split.
        large: scale in metres from which a Gaussian is split.
        faint: opacity below which a Gaussian goes.
        most: number of Gaussians that is not exceeded.
    """

    def __init__(self, quantile: float = 0.5, large: float = 0.03, faint: float = 0.02, most: int = 40_000) -> None:
        self.quantile, self.large, self.faint, self.most = quantile, large, faint, most
        self.pull, self.count = torch.zeros(0), torch.zeros(0)

    def observe(self, model: GaussianModel, T_world_camera: torch.Tensor) -> None:
        """Adds up the gradients of the last backward pass, as they move Gaussians in the image."""
        if len(self.pull) != len(model):
            self.pull, self.count = torch.zeros(len(model)), torch.zeros(len(model))
        gradient = model.means.grad
        if gradient is None:
            return
        nearest = torch.cdist(model.means.detach(), T_world_camera[:, :3, 3].float()).amin(1)
        self.pull += gradient.norm(dim=1) * nearest  # a metre far away moves fewer pixels
        self.count += gradient.abs().sum(1) > 0

    @torch.no_grad()
    def apply(self, model: GaussianModel, optimizer: torch.optim.Adam) -> GaussianModel:
        """The densified model; the optimizer trains its parameters, new ones from rest."""
        kept = torch.sigmoid(model.opacity_logits) > self.faint
        pull = self.pull / self.count.clamp_min(1)
        chosen = kept & (self.count > 0) & (pull > torch.quantile(pull[self.count > 0], self.quantile))
        chosen &= chosen.cumsum(0) <= max(0, self.most - int(kept.sum()))
        large = chosen & (model.log_scales.amax(1).exp() > self.large)

        def rows(name: str) -> torch.Tensor:
            own = getattr(model, name).detach()
            twin = own[chosen].clone()
            if name == "means":  # beside the first one, within its size
                twin += 0.7 * model.log_scales[chosen].exp() * torch.randn(len(twin), 3)
            if name == "log_scales":
                own = torch.where(large[:, None], own - 0.47, own)  # 1 / 1.6
                twin = own[chosen].clone()
            return torch.cat([own[kept], twin])

        added = int(chosen.sum())
        dense = model.select(torch.cat([torch.nonzero(kept)[:, 0], torch.nonzero(chosen)[:, 0]]))
        for name in PARAMETERS:
            getattr(dense, name).copy_(rows(name))
        hand_over(optimizer, model, dense, lambda state: torch.cat([state[kept], torch.zeros_like(state[:added])]))
        self.pull = torch.zeros(0)
        return dense


def hand_over(
    optimizer: torch.optim.Adam, old: GaussianModel, new: GaussianModel, rows: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    """Gives the optimizer the new parameters, and the rows of their moments that go on."""
    for group in optimizer.param_groups:
        was, now = getattr(old, group["name"]), getattr(new, group["name"])
        state = optimizer.state.pop(was, {})
        group["params"] = [now]
        optimizer.state[now] = {
            key: rows(value) if value.shape == was.shape else value for key, value in state.items()
        }  # fmt: skip


def main(recording: str, out: str, frames: str = "6", epochs: str = "40") -> None:
    """Trains on the first `frames` frames, with and without densification, and writes the dense Gaussians as PLY."""
    torch.manual_seed(0)
    sequence = ggslam.open_sequence(recording, stop=int(frames))
    poses = torch.from_numpy(locate(sequence))
    frames_of_it = cast("Dataset[ggslam.Frame]", sequence)  # it has what torch asks for, without loading torch
    for strategy in (None, Densification()):
        model = begin(sequence[0], poses[0].numpy(), stride=12)
        sparse = len(model)
        optimizer = torch.optim.Adam(model.parameter_groups(means=3e-4), eps=1e-15)
        loader = DataLoader(frames_of_it, batch_size=2, shuffle=True, collate_fn=ggslam.collate_frames)
        for epoch in range(int(epochs)):
            for batch in loader:
                T_world_camera = poses[batch["index"]]
                view = ggslam.render(model, sequence.camera, T_world_camera=T_world_camera)  # both views at once
                loss = sum(
                    (ggslam.color_loss(image, color) for image, color in zip(view.image, batch["color"], strict=True)),
                    torch.zeros(()),
                )  # fmt: skip
                optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]  # torch does not say its types
                if strategy is not None:
                    strategy.observe(model, T_world_camera)
                optimizer.step()
            if strategy is not None and epoch % 5 == 4 and epoch < 0.6 * int(epochs):  # the rest settles
                model = strategy.apply(model, optimizer)
        way = "without" if strategy is None else "with"
        psnr = mean_psnr(model, sequence, poses.numpy())
        print(f"{way} densification: {sparse} to {len(model)} Gaussians, {psnr:.2f} dB")
    ggslam.write_gaussian_ply(out, model.to_map())


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) in (3, 4, 5) else sys.exit(__doc__)
