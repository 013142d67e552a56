# SPDX-License-Identifier: Apache-2.0
"""Frames as tensors, for training loops and `torch.utils.data.DataLoader`."""

from __future__ import annotations

from collections.abc import Sequence as ListOf
from typing import TYPE_CHECKING

import numpy as np

from ggslam.errors import SequenceError
from ggslam.scene.frame import Frame

if TYPE_CHECKING:
    import torch


def collate_frames(frames: ListOf[Frame]) -> dict[str, torch.Tensor]:
    """Frames of one camera as a batch: what `DataLoader(sequence, collate_fn=collate_frames)` needs.

    Args:
        frames: B frames, one or more.

    Returns:
        color: float32 [B, 3, H, W] in [0, 1], RGB.
        depth: float32 [B, H, W] metres, 0 = unknown.
        T_world_camera: float64 [B, 4, 4], the recording's pose; NaN where it tells none.
        timestamp: float64 [B], seconds.
        index: int64 [B], `Frame.index`: the position in the sequence that the frame was read from, which in a slice
            counts from 0 again.
        source_index: int64 [B], `Frame.source_index`: the position in the whole recording.
        mask: int64 [B, H, W] instance ids, 0 = unlabelled; only there if every frame has one.

    Raises:
        SequenceError: no frames, or images of different sizes.
    """
    import torch  # not needed to read recordings

    sizes = sorted({frame.color.shape[:2] for frame in frames})
    if len(sizes) != 1:
        found = ", ".join(f"{width}x{height}" for height, width in sizes) or "none"
        raise SequenceError(f"collate_frames: expected frames of one size, found {found}")
    unknown = np.full((4, 4), np.nan)
    poses = [unknown if frame.T_world_camera is None else frame.T_world_camera for frame in frames]
    color = torch.from_numpy(np.stack([frame.color for frame in frames]))
    batch = {
        "color": color.permute(0, 3, 1, 2).float() / 255,
        "depth": torch.from_numpy(np.stack([frame.depth for frame in frames])),
        "T_world_camera": torch.from_numpy(np.stack(poses)),
        "timestamp": torch.tensor([frame.timestamp for frame in frames], dtype=torch.float64),
        "index": torch.tensor([frame.index for frame in frames]),
        "source_index": torch.tensor([frame.source_index for frame in frames]),
    }
    masks = [mask for frame in frames if (mask := frame.load_mask()) is not None]
    if len(masks) == len(frames):
        batch["mask"] = torch.from_numpy(np.stack(masks).astype(np.int64))
    return batch
