# SPDX-License-Identifier: Apache-2.0
"""All filters of a camera's frames, one after the other."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable
from importlib import import_module
from typing import TypeVar

import numpy as np

import ggslam.slam.filters as room
from ggslam.native.loader import NativeContext
from ggslam.scene.frame import Frame
from ggslam.slam.filters.frame_filter import FilterContext, FrameFilter, InRigs
from ggslam.slam.map_removal import MapRemoval
from ggslam.system.savable import savable
from ggslam.tracking.settings import DepthNoise
from ggslam.tracking.tracker import TrackingResult

F = TypeVar("F", bound=FrameFilter)


def filter_classes() -> list[type[FrameFilter]]:
    """All filters that the modules of `slam.filters` define, in the order in which they see a frame."""
    found = []
    for module in pkgutil.iter_modules(room.__path__):
        content = vars(import_module(f"{room.__name__}.{module.name}"))
        found += [
            kind for kind in content.values()
            if isinstance(kind, type) and issubclass(kind, FrameFilter) and kind.__module__ == content["__name__"]
            and kind is not FrameFilter
        ]  # fmt: skip
    return sorted(found, key=lambda kind: kind.order)


@savable()
class FilterChain(FrameFilter):
    """Applies filters in a row. Each receives the frame as the previous one returned it. Hooks that every frame or
    keyframe goes through are not called where they do nothing.

    Args:
        filters: in their order.
    """

    filters: list[FrameFilter]

    def __init__(self, filters: list[FrameFilter]) -> None:
        self.filters = filters

    @classmethod
    def make_all(cls, made_of: FilterContext) -> FilterChain:
        """All filters, for the frames of one camera."""
        return cls([kind.make(made_of) for kind in filter_classes()])

    @classmethod
    def make_for_rig(cls, made_of: FilterContext, cameras: int) -> list[FilterChain]:
        """The filters that go with a rig, for each of so many cameras."""
        kinds = [kind for kind in filter_classes() if kind.in_rigs is not InRigs.LEFT_OUT]
        shared = {kind: kind.make(made_of) for kind in kinds if kind.in_rigs is InRigs.SHARED}
        return [cls([shared[k] if k in shared else k.make(made_of) for k in kinds]) for _ in range(cameras)]

    @classmethod
    def join(cls, chains: Iterable[FilterChain]) -> FilterChain:
        """The filters of all of these, each once."""
        return cls(list({id(one): one for chain in chains for one in chain.filters}.values()))

    def get(self, kind: type[F]) -> F:
        """The filter of a kind.

        Raises:
            LookupError: there is none.
        """
        for one in self.filters:
            if isinstance(one, kind):
                return one
        raise LookupError(f"no filter is a {kind.__name__}")

    def use_context(self, context: NativeContext) -> None:
        for one in self.filters:
            one.use_context(context)

    def clean(self, frame: Frame) -> Frame:
        for one in self.filters:
            if type(one).clean is not FrameFilter.clean:
                frame = one.clean(frame)
        return frame

    def expect(self, frame: Frame) -> Frame:
        for one in self.filters:
            if type(one).expect is not FrameFilter.expect:
                frame = one.expect(frame)
        return frame

    def judge(
        self, frame: Frame, result: TrackingResult, noise: DepthNoise | None
    ) -> tuple[Frame, TrackingResult]:  # fmt: skip
        for one in self.filters:
            if type(one).judge is not FrameFilter.judge:
                frame, result = one.judge(frame, result, noise)
        return frame, result

    def expects_motion(self) -> bool:
        for one in self.filters:
            if type(one).expects_motion is not FrameFilter.expects_motion and one.expects_motion():
                return True
        return False

    def before_insertion(self, removal: MapRemoval, newest: Frame, tracking: TrackingResult) -> None:
        for one in self.filters:
            if type(one).before_insertion is not FrameFilter.before_insertion:
                one.before_insertion(removal, newest, tracking)

    def after_insertion(self, removal: MapRemoval, newest: Frame) -> None:
        for one in self.filters:
            if type(one).after_insertion is not FrameFilter.after_insertion:
                one.after_insertion(removal, newest)

    def loop_closed(self) -> None:
        for one in self.filters:
            one.loop_closed()

    def move(self, T_new_old: np.ndarray) -> None:
        for one in self.filters:
            one.move(T_new_old)

    def notes(self, frames: int) -> list[str]:
        return [note for one in self.filters for note in one.notes(frames)]
