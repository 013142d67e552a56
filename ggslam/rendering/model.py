# SPDX-License-Identifier: Apache-2.0
"""Gaussians as a torch module for custom training loops."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from ggslam.errors import RenderError
from ggslam.rendering.types import PARAMETERS, Gaussians, GaussianTensors, check_gaussians
from ggslam.scene.gaussian_map import GaussianMap, rgb_to_sh
from ggslam.system.tuning import Tuning

_LABELS = ("birth_keyframe", "object_id")


class ModelTuning(Tuning):
    """Checks of a model's values."""

    color_slack = 1e-3
    """Distance from [0, 1] that rounding may give a colour."""


_SH_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
DEFAULT_RATES: Mapping[str, float] = {
    "means": 6e-4, "quaternions": 4e-3, "log_scales": 1e-2, "opacity_logits": 5e-2, "sh": 1.8e-2, "features": 1e-2,
}  # fmt: skip
"""Learning rates of Adam that suit a map in metres; means are in metres a step."""


class GaussianModel(torch.nn.Module):
    """3D Gaussians whose parameters any torch optimizer can train; `ggslam.render` renders them.

    `state_dict`, `load_state_dict`, `to`, `parameters` are those of every `torch.nn.Module`; `load_state_dict` also
    takes a state with another number of Gaussians.

    Args:
        gaussians: a `GaussianMap` (of a run: `RunFolder.open(path).gaussians()`; of a file: `read_gaussian_ply(path)`)
            or anything else with its six arrays. They are copied.

    Attributes:
        means: [N, 3] metres, world frame.
        quaternions: [N, 4] wxyz, of any length but zero.
        log_scales: [N, 3], natural logarithm of the standard deviations in metres.
        opacity_logits: [N].
        sh: [N, K, 3] spherical-harmonic colour coefficients, K = 1, 4, 9 or 16.
        features: [N, F], rendered like colour; F may be 0.
        birth_keyframe, object_id: int32 [N], buffers that `to_map` gives back.

    Raises:
        RenderError: arrays whose shapes do not fit together.
    """

    means: torch.nn.Parameter
    quaternions: torch.nn.Parameter
    log_scales: torch.nn.Parameter
    opacity_logits: torch.nn.Parameter
    sh: torch.nn.Parameter
    features: torch.nn.Parameter
    birth_keyframe: torch.Tensor
    object_id: torch.Tensor

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        check_gaussians(gaussians)
        for name in PARAMETERS:
            self.register_parameter(name, torch.nn.Parameter(getattr(gaussians, name).detach().clone().contiguous()))
        for name, value in (("birth_keyframe", -1), ("object_id", 0)):
            given = getattr(gaussians, name, None)
            rows = torch.full((len(self),), value, dtype=torch.int32, device=self.means.device)
            self.register_buffer(name, rows if given is None else given.detach().clone())

    @staticmethod
    def from_points(
        points: np.ndarray | torch.Tensor,
        colors: np.ndarray | torch.Tensor,
        *,
        scales: np.ndarray | torch.Tensor | float | None = None,
        opacity: float = 0.5,
        sh_degree: int = 0,
        feature_channels: int = 0,
    ) -> GaussianModel:
        """A round Gaussian at each point.

        Args:
            points: [N, 3] metres.
            colors: [N, 3] RGB: uint8, or floats in [0, 1].
            scales: standard deviation in metres, one for all or [N]; None: half the mean distance of the three nearest
                points (of points that others lie on: of the nearest elsewhere).
            opacity: of every Gaussian, in (0, 1).
            sh_degree: of the colours, 0 to 3.
            feature_channels: F, all zero at first.

        Raises:
            RenderError: shapes that do not fit, no points, or values that are not finite or out of range.
        """
        means = torch.as_tensor(np.asarray(points, np.float32)).clone()
        rgb = torch.as_tensor(np.asarray(colors))
        rgb = rgb.float() / 255 if rgb.dtype == torch.uint8 else rgb.float()
        count = len(means)
        if means.ndim != 2 or means.shape[1] != 3 or rgb.shape != means.shape or not count:
            raise RenderError(f"from_points: expected points and colors [N, 3], found {means.shape} and {rgb.shape}")
        if not np.isfinite(means.numpy()).all():
            raise RenderError(f"from_points: point {int((~torch.isfinite(means)).any(1).int().argmax())} is not finite")
        if not (rgb >= -ModelTuning.color_slack).all() or not (rgb <= 1 + ModelTuning.color_slack).all():
            low, high = float(rgb.min()), float(rgb.max())
            raise RenderError(
                f"from_points: colors reach from {low:g} to {high:g}, expected uint8, or floating-point numbers 0 to 1"
            )
        if not 0 < opacity < 1 or not 0 <= sh_degree <= 3 or feature_channels < 0:
            raise RenderError("from_points: expected opacity in (0, 1), sh_degree 0 to 3, feature_channels from 0")
        if scales is None:
            spread = _neighbour_distance(means.numpy())
        else:
            spread = np.broadcast_to(np.asarray(scales, np.float32), count)
        if not (spread > 0).all():
            raise RenderError("from_points: expected scales above 0")
        sh = torch.zeros(count, (sh_degree + 1) ** 2, 3)
        sh[:, 0] = rgb_to_sh(rgb)
        logit = float(np.log(opacity / (1 - opacity)))
        return GaussianModel(
            GaussianTensors(
                means, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
                torch.log(torch.tensor(spread, dtype=torch.float32))[:, None].repeat(1, 3),
                torch.full((count,), logit), sh, torch.zeros(count, feature_channels),
            )
        )  # fmt: skip

    def __len__(self) -> int:
        return self.means.shape[0]

    def extra_repr(self) -> str:
        """Shown by `print`."""
        return f"{len(self)} Gaussians, {self.sh.shape[1]} colour coefficients, {self.features.shape[1]} features"

    def parameter_groups(self, **rates: float) -> list[dict[str, Any]]:
        """Groups for `torch.optim.Adam`: one for each parameter, with `params`, `lr` and `name`.

        Args:
            rates: learning rates by the parameter's name; the others are those of `DEFAULT_RATES`. 0 leaves it out.

        Raises:
            RenderError: no such parameter.
        """
        unknown = set(rates) - set(PARAMETERS)
        if unknown:
            raise RenderError(f"parameter_groups: unknown {sorted(unknown)}; known: {', '.join(PARAMETERS)}")
        chosen = {**DEFAULT_RATES, **rates}
        return [
            {"params": [getattr(self, name)], "lr": chosen[name], "name": name}
            for name in PARAMETERS
            if chosen[name] and getattr(self, name).numel()
        ]

    def select(self, rows: torch.Tensor) -> GaussianModel:
        """A new model of some rows, bool [N] or int64 [M]: for pruning. An optimizer needs the new parameters."""
        parts = {name: getattr(self, name).detach()[rows] for name in (*PARAMETERS, *_LABELS)}
        out = GaussianModel(GaussianTensors(**{name: parts[name] for name in PARAMETERS}))
        out.birth_keyframe, out.object_id = parts["birth_keyframe"], parts["object_id"]
        return out

    @torch.no_grad()
    def to_map(self) -> GaussianMap:
        """A `GaussianMap` with these values, on the CPU, for `write_gaussian_ply` and everything else that takes maps.
        Optimizer state and votes begin anew."""
        values = {name: getattr(self, name).detach().cpu() for name in (*PARAMETERS, *_LABELS)}
        out = GaussianMap(_SH_DEGREES[self.sh.shape[1]], self.features.shape[1])
        out.insert(
            values["means"], values["quaternions"], values["log_scales"], values["opacity_logits"],
            torch.zeros(len(self), 3), values["features"], object_id=values["object_id"],
        )  # fmt: skip
        out.sh.copy_(values["sh"])
        out.birth_keyframe.copy_(values["birth_keyframe"])
        return out

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *args: Any) -> None:
        """Makes room for as many Gaussians as the state has; the rest is torch's. A state that does not fit is told of
        and changes nothing: torch itself would have loaded the arrays before the first wrong one."""
        strict, problems = args[1], args[4]
        found = self._state_problem(state_dict, prefix, strict)
        if found is not None:
            problems.append(f"{found}; nothing was loaded")
            return
        for name, own in self._rows():
            given = state_dict.get(prefix + name)
            if given is not None and given.shape != own.shape:
                own.data = own.data.new_empty(given.shape)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _state_problem(self, state_dict: Mapping[str, Any], prefix: str, strict: bool) -> str | None:
        """Why a state cannot be loaded; None: it can."""
        counts: dict[int, str] = {}
        for name, own in self._rows():
            given = state_dict.get(prefix + name)
            if given is None:
                if strict:
                    return f"{prefix}{name} is missing"
                counts.setdefault(len(own), f"{name} of this model")
                continue
            if not isinstance(given, torch.Tensor) or given.ndim != own.ndim or given.shape[1:] != own.shape[1:]:
                shape = list(given.shape) if isinstance(given, torch.Tensor) else type(given).__name__
                return f"{prefix}{name}: expected shape {['N', *own.shape[1:]]}, found {shape}".replace("'N'", "N")
            counts.setdefault(len(given), name)
        if len(counts) > 1:
            told = ", ".join(f"{count} by {name}" for count, name in counts.items())
            return f"{prefix.rstrip('.') or 'state'}: arrays of different numbers of Gaussians: {told}"
        return None

    def _rows(self) -> Iterable[tuple[str, torch.Tensor]]:
        return [(name, getattr(self, name)) for name in (*PARAMETERS, *_LABELS)]


def _neighbour_distance(points: np.ndarray) -> np.ndarray:
    """Half the mean distance of each point [N, 3] to the three nearest others, as in 3D Gaussian Splatting; where all
    of these are at the same place, to the three nearest places elsewhere."""
    neighbours = min(3, len(points) - 1)
    if not neighbours:
        return np.full(len(points), 0.01, np.float32)
    distances, _ = cKDTree(points).query(points, neighbours + 1)
    spread = (0.5 * distances[:, 1:].mean(1)).astype(np.float32)
    if (spread > 0).all():
        return spread
    places, place = np.unique(points, axis=0, return_inverse=True)
    elsewhere = _neighbour_distance(places)[place.reshape(-1)]
    return np.where(spread > 0, spread, elsewhere)
