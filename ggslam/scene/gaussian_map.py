# SPDX-License-Identifier: Apache-2.0
"""The map: a structure of arrays of 3D Gaussians with spare capacity."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch

from ggslam.errors import FormatError, InputError
from ggslam.scene.harmonics import harmonic_rotations
from ggslam.system.savable import savable

SH_C0: Final = 0.28209479177387814
"""Zeroth spherical-harmonic constant: colour = 0.5 + SH_C0 * sh[0] for degree 0."""

_PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "features")
_BOOKKEEPING = ("birth_keyframe", "object_id", "updates", "feature_updates", "vote_ids", "vote_weights")
MOST_UPDATES: Final = 2**30
"""Most optimizer steps that a Gaussian may have seen: counters of 32 bits continue from there."""
_ZERO_AT_BIRTH = ("updates", "feature_updates", "vote_ids", "vote_weights")
_MOMENTS = ("first", "second")
VOTE_SLOTS: Final = 4
"""Object ids that a Gaussian keeps votes for. The compiled core and saved maps have as many."""


def rgb_to_sh(rgb: torch.Tensor) -> torch.Tensor:
    """Degree-0 spherical-harmonic coefficient of a colour in [0, 1]."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(sh: torch.Tensor) -> torch.Tensor:
    """Colour of a degree-0 spherical-harmonic coefficient."""
    return 0.5 + SH_C0 * sh


@savable(save="state", take="set_state")
@dataclass(eq=False)
class GaussianMap:
    """3D Gaussians as arrays whose first `count` rows are in use. Float32 unless said otherwise.

    Properties give views of the used rows, the same tensor until rows are added or removed, so that one keeps the
    gradient that `requires_grad_` asks for:
        means: [N, 3] metres, world frame.
        quaternions: [N, 4] wxyz, not necessarily of unit length.
        log_scales: [N, 3], natural logarithm of the standard deviations in metres.
        opacity_logits: [N].
        sh: [N, K, 3] spherical-harmonic colour coefficients, K = (degree + 1)^2.
        features: [N, F], feature channels splatted like colour (identity vectors); F may be 0.
        birth_keyframe: int32 [N], index of the keyframe that inserted the Gaussian (-1 unknown).
        object_id: int32 [N], 0 = unlabelled.
        updates: int32 [N], optimizer steps seen so far.
        feature_updates: int32 [N], steps that an optimizer of the features alone made.
        vote_ids, vote_weights: int32 and float32 [N, VOTE_SLOTS], mask ids that a Gaussian was seen under and the
            rendering weight it had there; id 0 is a free slot. Without feature channels there are no slots.
    Adam's two moments of each parameter are kept beside it (`moments[name]` = (first, second)) and grow along. With
    `compact_features` those of the features take 36 bytes instead of 128: the first in the 16 bits of bfloat16 (int16
    [N, F]), the second as one mean over the channels (float32 [N]); the compiled core alone knows these.
    """

    sh_degree: int = 0
    feature_channels: int = 0
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    with_moments: bool = True
    count: int = 0
    version: int = 0
    """Increases with every change of the set of Gaussians (insert, keep), so that indices can be seen to be stale."""
    order: int = 0
    """Increases when rows change their places or go: indices from before name other Gaussians now."""
    growth: float = 0.5
    """Share by which the room grows at least when it is used up, so that inserting is amortised; 0: not more than is
    needed."""
    compact_features: bool = False
    allocations: int = 0
    """Increases when the arrays move in memory, so that addresses can be seen to be stale."""

    def __post_init__(self) -> None:
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree must be 0 to 3, found {self.sh_degree}")
        self._storage: dict[str, torch.Tensor] = {}
        self._views: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
        self._moments: tuple[tuple[int, int], dict[str, tuple[torch.Tensor, torch.Tensor]]] = ((-1, -1), {})
        self._allocate(0)

    def check(self, keyframes: int) -> None:
        """Raises FormatError if numbers of objects, keyframes or steps cannot be, or a Gaussian is nowhere: it may
        come from a file.

        Args:
            keyframes: how many there are.
        """
        ranges = {
            "birth_keyframe": (-1, keyframes - 1), "object_id": (0, 65535), "vote_ids": (0, 65535),
            "updates": (0, MOST_UPDATES), "feature_updates": (0, MOST_UPDATES),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            rows = self._storage[name][: self.count]
            if rows.numel() and not (low <= int(rows.min()) and int(rows.max()) <= high):
                raise FormatError(f"{name} of Gaussians: expected {low} to {high}")
        if not bool(torch.isfinite(self._storage["means"][: self.count]).all()):
            raise FormatError("means of Gaussians: expected finite numbers")

    # --- saved state ---------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What is saved of the map: counters and the used rows of all arrays."""
        counters = (
            "sh_degree", "feature_channels", "with_moments", "compact_features", "count", "version", "order", "growth",
        )  # fmt: skip
        rows = {name: array[: self.count] for name, array in self._storage.items()}
        return {**{name: getattr(self, name) for name in counters}, "capacity": self.capacity, "rows": rows}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Fills the map from what `state` gave. Raises ValueError or InputError if rows and counters do not fit."""
        rows, capacity, count = saved.pop("rows"), saved.pop("capacity"), saved["count"]
        expected = GaussianMap(
            saved["sh_degree"], saved["feature_channels"], with_moments=saved["with_moments"],
            compact_features=saved["compact_features"],
        )  # fmt: skip
        vars(self).update(vars(expected))
        self.append(rows)  # checks them
        if self.count != count or not count <= capacity <= 4 * count + 65536:
            raise ValueError(f"{self.count} Gaussians instead of {count}")
        self.shrink(0)
        self.growth = 0.0
        self.reserve(capacity)
        vars(self).update(saved)

    # --- storage -------------------------------------------------------------------------------------------------

    @property
    def _names(self) -> list[str]:
        """Names of all arrays: parameters, bookkeeping, moments (`means.first`, `means.second`)."""
        moments = [f"{name}.{which}" for name in _PARAMETERS for which in _MOMENTS] if self.with_moments else []
        return [*_PARAMETERS, *_BOOKKEEPING, *moments]

    def _shape(self, name: str) -> tuple[int, ...]:
        slots = VOTE_SLOTS if self.feature_channels else 0
        if self.compact_features and name == "features.second":
            return ()
        shapes: dict[str, tuple[int, ...]] = {
            "means": (3,), "quaternions": (4,), "log_scales": (3,), "opacity_logits": (),
            "sh": ((self.sh_degree + 1) ** 2, 3), "features": (self.feature_channels,),
            "vote_ids": (slots,), "vote_weights": (slots,),
        }  # fmt: skip
        return shapes.get(name.partition(".")[0], ())

    def _dtype(self, name: str) -> torch.dtype:
        if self.compact_features and name == "features.first":
            return torch.int16
        return torch.int32 if name in _BOOKKEEPING and name != "vote_weights" else torch.float32

    def _allocate(self, capacity: int) -> None:
        self.allocations += 1
        self._moments = ((-1, -1), {})  # views of them would keep the old arrays in memory, too
        for name in self._names:  # one after the other, so that no more than one of them is there twice
            new = torch.zeros((capacity, *self._shape(name)), dtype=self._dtype(name), device=self.device)
            if name in self._storage:
                new[: self.count] = self._storage[name][: self.count]
            self._storage[name] = new
            self._views.pop(name, None)  # it would keep the old array in memory

    @property
    def capacity(self) -> int:
        """Rows allocated."""
        return self._storage["means"].shape[0]

    def reserve(self, rows: int) -> None:
        """Makes room for `rows` Gaussians in all; grows by the share `growth` at least."""
        if rows > self.capacity:
            self._allocate(max(rows, self.capacity + int(self.capacity * self.growth), 16384 if self.growth else 0))

    def shrink(self, rows: int) -> None:
        """Gives back room beyond `rows` Gaussians, if there is more; those there are stay."""
        if self.capacity > max(rows, self.count):
            self._allocate(max(rows, self.count))

    @property
    def bytes_per_gaussian(self) -> int:
        """Bytes that all arrays together take for one row."""
        return sum(array.element_size() * math.prod(array.shape[1:]) for array in self._arrays(0).values())

    def __len__(self) -> int:
        return self.count

    def __getattr__(self, name: str) -> torch.Tensor:
        if name not in _PARAMETERS and name not in _BOOKKEEPING:
            raise AttributeError(name)
        storage, count = self._storage[name], self.count
        found = self._views.get(name)
        if found is None or found[0] is not storage or found[1].shape[0] != count:
            found = self._views[name] = (storage, storage[:count])
        return found[1]

    @property
    def moments(self) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Adam's first and second moment of each parameter, views of the used rows."""
        if not self.with_moments:
            return {}
        key, rows, arrays = (self.allocations, self.count), self.count, self._storage
        if self._moments[0] != key:  # every optimisation step asks for them
            views = {n: (arrays[f"{n}.first"][:rows], arrays[f"{n}.second"][:rows]) for n in _PARAMETERS}
            self._moments = (key, views)
        return self._moments[1]

    # --- derived quantities ----------------------------------------------------------------------------------------

    @property
    def opacities(self) -> torch.Tensor:
        """[N] in (0, 1)."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def scales(self) -> torch.Tensor:
        """[N, 3] standard deviations in metres."""
        return torch.exp(self.log_scales)

    @property
    def rgb(self) -> torch.Tensor:
        """[N, 3] view-independent part of the colour, unclamped."""
        return sh_to_rgb(self.sh[:, 0])

    def bound_colors(self) -> None:
        """Brings colours of degree 0 between black and white."""
        _clamp(self.sh[:, 0], -0.5 / SH_C0, 0.5 / SH_C0)

    def bound_scales(self, largest: float) -> None:
        """Brings standard deviations to `largest`, metres, at most."""
        _clamp(self.log_scales, None, math.log(largest))

    # --- whole rows --------------------------------------------------------------------------------------------------

    @property
    def storage(self) -> Mapping[str, torch.Tensor]:
        """All arrays by name, `means.first` and `means.second` being the moments of `means`, with the rows that are
        not in use. The same tensors as long as `allocations` stays."""
        return self._storage

    def extend(self, added: int) -> slice:
        """Appends M Gaussians without any values: the caller writes their rows of all arrays; returns which."""
        rows = slice(self.count, self.count + added)
        first = not self.capacity  # others will follow: rows without use take no memory on the host
        self.reserve(self.count + added + (int(added * self.growth) if first else 0))
        self.count += added
        self.version += 1
        return rows

    def _arrays(self, count: int) -> dict[str, torch.Tensor]:
        """The first `count` rows of every array, by name."""
        return {name: array[:count] for name, array in self._storage.items()}

    def to(self, device: torch.device | str) -> GaussianMap:
        """The map on a device: itself if it is there, else a copy."""
        return self if torch.device(device) == self.device else self.copy(device)

    def copy(self, device: torch.device | str) -> GaussianMap:
        """A copy on a device, with room for the used rows only: all arrays bit for bit, moments, counters, settings."""
        out = GaussianMap(
            self.sh_degree, self.feature_channels, torch.device(device), self.with_moments, growth=self.growth,
            compact_features=self.compact_features,
        )  # fmt: skip
        out._allocate(self.count)
        for name, array in self._arrays(self.count).items():
            out._storage[name].copy_(array)
        out.count, out.version, out.order = self.count, self.version, self.order
        return out

    def take(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Copies of whole rows, index int64 [M]: everything about these Gaussians, for `append`."""
        return {name: array[index] for name, array in self._arrays(self.count).items()}

    def append(self, rows: Mapping[str, torch.Tensor]) -> slice:
        """Adds rows that `take` of a map with the same channels gave, bit for bit; returns where they are now.

        Raises:
            InputError: an array is missing or has another shape or type.
        """
        added = len(rows["means"]) if "means" in rows else 0
        for name, array in self._arrays(0).items():
            found = rows.get(name)
            if found is None or found.dtype != array.dtype or found.shape != (added, *array.shape[1:]):
                shape = "nothing" if found is None else f"{found.dtype} {list(found.shape)}"
                raise InputError(f"rows of Gaussians: {name}: expected {array.dtype} of {added} rows, found {shape}")
        self.reserve(self.count + added)
        place = slice(self.count, self.count + added)
        for name, array in self._arrays(place.stop).items():
            array[place] = rows[name]
        self.count += added
        self.version += 1
        return place

    def raise_degree(self, degree: int) -> None:
        """Makes colours of at least `degree`, 0 to 3: the new coefficients and all moments of colours are 0."""
        if degree <= self.sh_degree:
            return
        old, self.sh_degree = self.sh, degree
        names = [name for name in self._names if name.partition(".")[0] == "sh"]
        for name in names:  # moments are not copied, for numpy's zeros take up memory only where something is written
            zeros = np.zeros((self.capacity, *self._shape(name)), np.float32)
            self._storage[name] = torch.from_numpy(zeros).to(self.device)
        self._storage["sh"][: self.count, : old.shape[1]] = old
        self._views.pop("sh", None)
        self.allocations += 1

    # --- changes -----------------------------------------------------------------------------------------------------

    def insert(
        self,
        means: torch.Tensor,
        quaternions: torch.Tensor,
        log_scales: torch.Tensor,
        opacity_logits: torch.Tensor | float,
        rgb: torch.Tensor,
        features: torch.Tensor | None = None,
        birth_keyframe: int = -1,
        object_id: torch.Tensor | None = None,
    ) -> slice:
        """Appends M Gaussians (shapes as in the class; `rgb` [M, 3] in [0, 1]) with zero moments.

        On a GPU nothing waits for it, given that the tensors are there.

        Args:
            opacity_logits: [M], or one number for all.

        Returns:
            The rows they occupy.
        """
        rows = self.extend(means.shape[0])
        given = {"means": means, "quaternions": quaternions, "log_scales": log_scales, "opacity_logits": opacity_logits}
        for name, value in given.items():
            self._storage[name][rows] = value
        self._storage["sh"][rows].zero_()
        self._storage["sh"][rows, 0] = rgb_to_sh(rgb)
        self._storage["features"][rows] = 0 if features is None else features
        self._storage["birth_keyframe"][rows].fill_(birth_keyframe)
        self._storage["object_id"][rows] = 0 if object_id is None else object_id.to(torch.int32)
        for name in self._names:
            if name in _ZERO_AT_BIRTH or "." in name:  # the moments
                self._storage[name][rows].zero_()
        return rows

    def keep(self, selected: torch.Tensor) -> int:
        """Keeps the Gaussians where `selected` (bool [N]) is true, in their order; returns how many were removed."""
        index = torch.nonzero(selected, as_tuple=True)[0]
        removed = self.count - index.shape[0]
        if removed == 0:
            return 0
        self.reorder(index)
        return removed

    def shorten(self, kept: int) -> None:
        """The first rows stay, so many: the caller has moved there what stays, rows of all arrays in their order."""
        self.count = kept
        self.version += 1
        self.order += 1

    def reorder(self, index: torch.Tensor) -> None:
        """Makes row i the former row index[i] (int64 [M]); rows not named are dropped. Moments move along."""
        kept, index = index.shape[0], index.to(self.device)  # once, not for each array
        for array in self._storage.values():
            array[:kept] = torch.index_select(array[: self.count], 0, index)  # a third of what array[index] takes
        self.shorten(kept)

    def move(self, rows: torch.Tensor, T_new_old: torch.Tensor) -> None:
        """Moves Gaussians of `rows` (bool [N] or int64 [M]) rigidly by `T_new_old` [4, 4]: means and rotations.

        Colours that depend on the viewing direction turn along.
        """
        T = T_new_old.to(self.means)
        self.means[rows] = self.means[rows] @ T[:3, :3].T + T[:3, 3]
        self.quaternions[rows] = _multiply(_quaternion(T[:3, :3]), self.quaternions[rows])
        if self.sh_degree > 0:
            turn = harmonic_rotations(T_new_old[:3, :3].double().cpu().numpy(), self.sh.shape[1])
            self.sh[rows] = torch.einsum("kl,nlc->nkc", torch.from_numpy(turn).to(self.sh), self.sh[rows])
        self.version += 1


def _clamp(values: torch.Tensor, least: float | None, most: float) -> None:
    """Bounds values in place."""
    values = values.detach()
    if values.is_cpu:  # torch's threads take longer to wake than this takes
        np.clip(values.numpy(), least, most, out=values.numpy())
    else:
        values.clamp_(least, most)


def _quaternion(R: torch.Tensor) -> torch.Tensor:
    from ggslam.scene.poses import matrix_to_quaternion

    return torch.as_tensor(matrix_to_quaternion(R.double().cpu().numpy())).to(R)


def _multiply(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Hamilton product of one quaternion wxyz [4] with many [M, 4]."""
    w, x, y, z = p
    a, b, c, d = q.unbind(-1)
    return torch.stack(
        [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c,
         w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a], -1
    )  # fmt: skip
