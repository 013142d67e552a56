#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Times the fused image loss (value and all gradients) against the same loss in torch with autograd.

    python scripts/benchmarks/bench_loss.py [--size 320x240] [--repeats 200] [--prototype LIBRARY]

--prototype adds a library that exports gg_create and gg_l1ssim (SSIM and L1 of float images with precomputed target
statistics; no exposure, mask or depth terms). Medians; the ratio is to torch.
"""

from __future__ import annotations

import argparse
import ctypes
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "mapping"))

import numpy as np
import torch
from losses_reference import reference_loss
from timing import seconds
from torch.nn.functional import avg_pool2d

from ggslam.mapping.cpu.losses import CpuImageLoss
from ggslam.mapping.losses import LossTarget
from ggslam.mapping.settings import LossSettings
from ggslam.native.loader import NativeContext, available_instruction_sets, available_processors


@dataclass
class View:
    image: torch.Tensor
    depth: torch.Tensor
    alpha: torch.Tensor


def make_view(width: int, height: int) -> tuple[View, LossTarget]:
    """A smooth random image with a fifth of its depth missing, and a noisy rendering of it."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(1, 3, height + 8, width + 8, generator=generator)
    smooth = avg_pool2d(noise, 9, stride=1)[0]
    smooth = (smooth - smooth.amin()) / (smooth.amax() - smooth.amin())
    units = torch.randint(5000, 20000, (height, width), generator=generator)
    units[torch.rand(height, width, generator=generator) < 0.2] = 0
    image = (smooth + 0.03 * torch.randn(smooth.shape, generator=generator)).contiguous()
    color = (255 * smooth).to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    view = View(image, units.float() / 5000 + 0.01, torch.full((height, width), 0.97))
    return view, LossTarget(color, units.numpy().astype(np.uint16), 1 / 5000)


def median_ms(call: Callable[[], object], repeats: int) -> float:
    call()
    return 1e3 * statistics.median(seconds(call, repeats))


def torch_call(view: View, target: LossTarget, settings: LossSettings) -> Callable[[], object]:
    leaves = [value.clone().requires_grad_() for value in (view.image, view.depth, view.alpha)]
    exposure = torch.tensor([[1.0, 0.0]] * 3, requires_grad=True)

    def call() -> None:
        reference_loss(*leaves, exposure, target, settings)["total"].backward()

    return call


def prototype_call(path: str, threads: int, view: View, target: LossTarget) -> Callable[[], object]:
    library = ctypes.CDLL(path)
    library.gg_create.restype = ctypes.c_void_p
    library.gg_l1ssim.restype = ctypes.c_double
    context = ctypes.c_void_p(library.gg_create(threads))
    channels, height, width = view.image.shape
    truth = (torch.from_numpy(target.color).permute(2, 0, 1).float() / 255).contiguous()
    mean, square, gradient = torch.empty_like(truth), torch.empty_like(truth), torch.empty_like(truth)
    scratch = torch.empty(9 * height * width)
    pointers = [ctypes.c_void_p(t.data_ptr()) for t in (view.image, truth, mean, square)]
    size = [ctypes.c_int(n) for n in (channels, height, width)]
    library.gg_gt_stats(pointers[1], *size, *pointers[2:])
    outputs = [ctypes.c_void_p(t.data_ptr()) for t in (gradient, scratch)]
    keep = (truth, mean, square, gradient, scratch)  # alive as long as the call is
    return lambda: (library.gg_l1ssim(context, *pointers, *size, ctypes.c_float(0.2), *outputs), keep)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="320x240", help="width x height")
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--prototype", help="library to compare with")
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    view, target = make_view(width, height)
    settings = {"L1 + SSIM + depth": LossSettings(), "L1 + depth": LossSettings(dssim_weight=0.0)}
    torch.set_num_threads(available_processors())
    reference = median_ms(torch_call(view, target, settings["L1 + SSIM + depth"]), max(3, arguments.repeats // 40))
    print(f"{width}x{height}, median of {arguments.repeats}\n{'':34}threads        ms times faster")
    row = "{:34}{:7d}{:10.3f}{:13.1f}"
    print(row.format("torch reference, float32, autograd", torch.get_num_threads(), reference, 1.0))
    for threads in sorted({1, available_processors()}):
        if arguments.prototype:
            ms = median_ms(prototype_call(arguments.prototype, threads, view, target), arguments.repeats)
            print(row.format("prototype, L1 + SSIM only", threads, ms, reference / ms))
        for instruction_set in available_instruction_sets():
            loss = CpuImageLoss(NativeContext(threads, instruction_set))
            for name, setting in settings.items():
                ms = median_ms(lambda loss=loss, s=setting: loss.evaluate(view, target, s), arguments.repeats)  # type: ignore[misc]
                print(row.format(f"{instruction_set}: {name}", threads, ms, reference / ms))


if __name__ == "__main__":
    main()
