# SPDX-License-Identifier: Apache-2.0
"""The loop for a rig of cameras: the frames of an instant are located as one body and mapped one by one."""

from __future__ import annotations

from dataclasses import replace

from ggslam.errors import FormatError
from ggslam.mapping.extra_loss import ExtraLoss
from ggslam.scene.camera import Camera
from ggslam.scene.rig import Rig
from ggslam.slam.config import Config
from ggslam.slam.filter_chain import FilterChain
from ggslam.slam.filters.frame_filter import FilterContext
from ggslam.slam.loop_settings import LoopSettings
from ggslam.slam.modes import Mode, refuse
from ggslam.slam.parts import RunParts
from ggslam.slam.rig_locator import RigLocator
from ggslam.slam.slam import Slam
from ggslam.system.savable import savable


@savable(
    not_saved="camera rig config context pager start_notes end_notes schedule joining", after="use_scale_again",
    check="check",
)  # fmt: skip
class RigSlam(Slam):
    """See `Slam`; `step_together` takes the frames of all cameras at one instant. Every frame has a pose and may be a
    keyframe; the keyframes of an instant keep to one another as the rig has them.

    Args:
        rig: the cameras.
        config: all settings.
        has_masks, extra_loss: as of `Slam`.

    Raises:
        ConfigError: settings that a rig does not go with.
    """

    is_rig = True

    def __init__(
        self, rig: Rig, config: Config | None = None, has_masks: bool | None = None, extra_loss: ExtraLoss | None = None
    ) -> None:
        self.rig = rig
        super().__init__(rig.cameras[0], _settings_for(rig, config or Config()), has_masks, extra_loss=extra_loss)
        self.config = config or Config()

    def _make_filters(self, made_of: FilterContext) -> list[FilterChain]:
        return FilterChain.make_for_rig(made_of, len(self.rig.names))

    def _make_locator(self, parts: RunParts) -> RigLocator:
        return RigLocator(self.rig, self.config, parts, self.policy, self.poses, self.chains)

    def check(self) -> None:
        """Raises FormatError if it has not what it must have of each camera: its state may come from a file."""
        if len(self.chains) != len(self.rig.names):
            raise FormatError(f"cameras: expected {len(self.rig.names)}, found the state of {len(self.chains)}")

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """See `Slam`."""
        return self.rig.cameras


def _settings_for(rig: Rig, config: Config) -> Config:
    """The settings as the parts of a rig's run use them: what counts keyframes counts those of all cameras.

    Raises:
        ConfigError: settings that a rig does not go with.
    """
    refuse(Mode.RIG, config)
    movers = replace(config.movers, enabled=False)  # frames of different cameras follow one another
    return replace(config, device="cpu", loops=_loops_for(len(rig), config.loops), movers=movers)


def _loops_for(cameras: int, loops: LoopSettings) -> LoopSettings:
    n, activity, revisits = cameras, loops.activity, loops.revisits
    return replace(
        loops, confirmation_gap=n * loops.confirmation_gap, neighbourhood=min(1000, n * loops.neighbourhood),
        activity=replace(activity, batch=n * activity.batch, spread=n * activity.spread, most=n * activity.most),
        revisits=replace(revisits, gap=n * revisits.gap),
    )  # fmt: skip
