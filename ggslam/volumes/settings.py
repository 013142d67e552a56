# SPDX-License-Identifier: Apache-2.0
"""Settings of the truncated signed distance field."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Literal

from ggslam.geometry.scene_size import voxel_times
from ggslam.system.settings import Conflict, setting, settings_class, tuning_class
from ggslam.system.tuning import Tuning


class TsdfLimits(Tuning):
    """Limits of the settings of a TSDF."""

    max_voxel = 1.0
    """Largest voxel, in metres."""
    max_depth = 1000.0
    """Largest depth, in metres."""
    min_max_weight = 1.0
    """Smallest `max_weight`."""
    min_max_free_weight = 0.1
    """Smallest `max_free_weight`."""


Integrator = Literal["projection", "rays", "hybrid"]
INTEGRATORS: tuple[Integrator, ...] = ("projection", "rays", "hybrid")
"""In the compiled core's order."""
MOST_RAYS = 10**6
"""Largest `least_rays`."""


@tuning_class(frozen=True)
class TsdfTuning:
    """Numbers of fusing depth."""

    max_weight: float = setting(16.0, TsdfLimits.min_max_weight, 1000)
    """Largest weight of a voxel, in measurements from 1 m."""
    max_free_weight: float = setting(1.0, TsdfLimits.min_max_free_weight, 1000)
    """Largest weight of a voxel in free space, small so that new things appear soon."""
    free_share: float = setting(0.9, 0.1, 1)
    """An empty block is free if all depth lies behind it and this share of its pixels has depth."""
    edge_voxels: float = setting(2.0, 0.1, 100, "voxels")
    """Depth is not interpolated over an edge of more than this many voxels and 2 % of the depth."""
    clearing: float = setting(0.5, 0, 0.99)
    """Share of its weight that a voxel loses each time depth clearly looks through it: removed things vanish within a
    few frames; 0: they are averaged away."""
    decay: float = setting(0.95, 0.01, 1)
    """Factor on all weights per decay, see `decay_every`."""
    integrator: Integrator = "projection"
    """Where voxels near a surface have their depth from. projection: the image, at the voxel's projection; rays: the
    mean of all pixels whose rays pass the voxel; hybrid: that mean of `least_rays` or more, else the projection. Rays
    take several times as long and are nearer to the truth where voxels are larger than pixels and depth is noisy."""
    least_rays: int = setting(2, 1, MOST_RAYS)
    """Fewest rays of which `hybrid` takes the mean."""


@settings_class(frozen=True)
class TsdfSettings(TsdfTuning):
    """How depth is fused."""

    voxel: float = setting(0.02, 1e-3, TsdfLimits.max_voxel, "m", basic=True)
    """Edge of a voxel; half of it makes four times as many near surfaces. The default grows in scenes larger than rooms
    (median depth above 6 m)."""
    truncation_voxels: float = setting(4.0, 2, 32, "voxels")
    """Distances are stored up to this many voxels on both sides of a surface."""
    min_depth: float = setting(0.1, 0, 100, "m")
    """Nearer depth is ignored."""
    max_depth: float = setting(7.0, 0.1, TsdfLimits.max_depth, "m", basic=True)
    """Farther depth makes no surface but frees the space up to this range. The default grows in scenes larger than
    rooms."""

    def __post_init__(self) -> None:
        if self.min_depth >= self.max_depth:
            raise Conflict("max_depth", f"expected more than min_depth, {self.min_depth:g}, found {self.max_depth:g}")

    def in_scene(self, scale: float, voxel: bool = True) -> TsdfSettings:
        """The settings for a scene of another size than a room's: what is at its default follows the scene.

        Args:
            scale: of the scene, see `geometry.scene_size.scene_scale`.
            voxel: whether the voxel follows, too.
        """
        usual, scaled = TsdfSettings(), self.of_size(voxel_times(scale))
        return scaled if voxel and self.voxel == usual.voxel else replace(scaled, voxel=self.voxel)

    def of_size(self, times: float) -> TsdfSettings:
        """The settings with voxels and range that are at their defaults so many times as large, and with weights that
        are as much as a measurement from so many metres: in a large scene nothing is seen from near."""
        usual, names = TsdfSettings(), ("voxel", "max_depth", "max_weight", "max_free_weight")
        new = (
            min(usual.voxel * times, TsdfLimits.max_voxel),
            min(usual.max_depth * times, TsdfLimits.max_depth),
            max(usual.max_weight / times**2, TsdfLimits.min_max_weight),
            max(usual.max_free_weight / times**2, TsdfLimits.min_max_free_weight),
        )
        left: dict[str, Any] = {
            n: v for n, v in zip(names, new, strict=True) if getattr(self, n) == getattr(usual, n)
        }
        return replace(self, **left)

    def numbers(self) -> dict[str, float]:
        """The settings as numbers by their sorted names, for files; those of the integrator where it is not the usual
        one."""
        values = {field.name: getattr(self, field.name) for field in sorted(fields(self), key=lambda f: f.name)}
        if self.integrator == TsdfSettings.integrator:
            del values["integrator"], values["least_rays"]
        else:
            values["integrator"] = INTEGRATORS.index(self.integrator)
        return {name: float(value) for name, value in values.items()}

    @classmethod
    def of_numbers(cls, numbers: dict[str, float]) -> TsdfSettings:
        """The settings that `numbers` told.

        Raises:
            ValueError: there is no integrator of that number, or a count is no whole number.
            ConfigError: others are impossible.
        """
        values: dict[str, Any] = dict(numbers)
        for name in {"integrator", "least_rays"} & values.keys():
            if values[name] not in range(MOST_RAYS + 1 if name == "least_rays" else len(INTEGRATORS)):
                raise ValueError(f"{name} {values[name]:g}")
            values[name] = int(values[name])
        if "integrator" in values:
            values["integrator"] = INTEGRATORS[values["integrator"]]
        return cls(**values)

    @property
    def least_weight(self) -> float:
        """Weight from which a voxel has a surface, in measurements from 1 m: half of a measurement from the farthest
        depth in range, so that all that was seen once has one but for rims behind a surface, which drop off."""
        return 0.5 / self.max_depth**2

    @property
    def most_depth(self) -> float:
        """Metres, a truncation beyond the range: what is measured farther away tells no more than at this depth. A view
        changes voxels up to a truncation behind its depth."""
        return self.max_depth + self.truncation

    @property
    def truncation(self) -> float:
        """In metres."""
        return self.truncation_voxels * self.voxel
