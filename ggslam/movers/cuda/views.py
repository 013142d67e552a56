# SPDX-License-Identifier: Apache-2.0
"""Coarse views that stay on the device until the host reads them."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch

from ggslam.cuda.transfers import download
from ggslam.scene.camera import Camera
from ggslam.scene.poses import inverse
from ggslam.sight.places import CoarseView

_IMAGES: Final = ("depth", "near", "far")
_FLAGS: Final = ("whole", "smooth")


class ViewRing:
    """Room on the device for the latest views.

    Args:
        camera: of the small images.
        slots: views that there is room for.
        device: where.
    """

    def __init__(self, camera: Camera, slots: int, device: torch.device) -> None:
        self.camera, self.slots = camera, slots
        h, w = camera.height, camera.width
        self.images = torch.empty((slots, 3, h, w), dtype=torch.float32, device=device)
        self.flags = torch.empty((slots, 2, h, w), dtype=torch.uint8, device=device)
        self.T_camera_world = np.zeros((slots, 12))
        """Rows of [R t] of the view in each slot."""

    def next_slot(self, views: list[CoarseView]) -> int:
        """The slot after that of the newest of these; those of `slots` - 1 views stay as they are."""
        return (views[-1].slot + 1) % self.slots if views and isinstance(views[-1], CudaView) else 0


class CudaView(CoarseView):
    """A `CoarseView` on the device. Its images come to the host when one of them is first read, which waits; that must
    be while the ring has them.

    Args:
        ring: where it is...
        slot: ...and its place there.
        T_world_camera: [4, 4].
    """

    ring: ViewRing
    slot: int

    def __init__(self, ring: ViewRing, slot: int, T_world_camera: np.ndarray) -> None:
        T = np.array(T_world_camera, float)
        ring.T_camera_world[slot] = inverse(T)[:3].ravel()
        self.__dict__.update(camera=ring.camera, T_world_camera=T, ring=ring, slot=slot)

    def __getattr__(self, name: str) -> Any:
        if name not in (*_IMAGES, *_FLAGS):
            raise AttributeError(name)
        self.take(*download(self.ring.images[self.slot], self.ring.flags[self.slot]))
        return self.__dict__[name]

    def take(self, images: np.ndarray, flags: np.ndarray) -> None:
        """What the device has of it: float32 [3, h, w] and uint8 [2, h, w]."""
        self.__dict__.update(zip(_IMAGES, images, strict=True))
        self.__dict__.update(zip(_FLAGS, flags.astype(bool), strict=True))

    def move(self, T_new_old: np.ndarray) -> CudaView:
        """The same after the world about it was moved by [4, 4]."""
        moved = CudaView(self.ring, self.slot, T_new_old @ self.T_world_camera)
        for name in (*_IMAGES, *_FLAGS):
            if name in self.__dict__:
                moved.__dict__[name] = self.__dict__[name]
        return moved
