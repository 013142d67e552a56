# SPDX-License-Identifier: Apache-2.0
"""Chooses the keyframes that the tracker aligns to.

A frame that is aligned to all that was ever mapped hides the drift at the end of a loop: the alignment slides from the
surface mapped a moment ago onto the one mapped at the beginning, and the step between them is taken for motion.
Keyframes that were not seen for a while are therefore put aside (inactive) until a closure says how they lie to the
present ones; ElasticFusion (Whelan et al., RSS 2015) parts its model in active and inactive in the same way, by time.
Here the measure is the path travelled, in units of the scene's depth, so that a camera that stays in one room keeps
all of it.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ggslam.scene.keyframe_poses import KeyframePoses
from ggslam.system.array_forms import Form, Points64, check_indices
from ggslam.system.savable import savable
from ggslam.system.settings import setting, tuning_class
from ggslam.system.tuning import Tuning


class ActivityTuning(Tuning):
    """Set of keyframes that the tracker uses."""

    set_aside_part = 8
    """At least one in this many active keyframes is set aside at a time: rebuilding the rest costs as much for one."""


@tuning_class(frozen=True)
class ActivitySettings:
    """The set of active keyframes, whose points are tracked against."""

    forget_after: float = setting(5.0, 0, 1e6)
    """A keyframe is deactivated after the camera has travelled this many times the median depth since it last saw its
    surface."""
    near: float = setting(1.0, 0, 1e3)
    """A keyframe's surface is seen if the centres of both views lie within this many times the mean of their median
    depths."""
    batch: int = setting(8, 1, 10**6)
    """Keyframes deactivated together, or an eighth of the active ones if that is more."""
    spread: int = setting(3, 0, 10**6)
    """A keyframe near the camera is reactivated if one of this many before or after it is active."""
    most: int = setting(400, 8, 10**6)
    """Maximum number of active keyframes; an eighth more until some are deactivated together."""


@savable(not_saved="settings", check="check")
class ActiveKeyframes:
    """Keeps the set of active keyframes up to date as the camera moves.

    Args:
        settings: limits.
    """

    active: set[int]
    spare: set[int]
    _depths: Annotated[np.ndarray, Form("f8", "n", finite=True)]
    _cameras: Points64
    _middles: Points64
    _seen: Annotated[np.ndarray, Form("f8", "n")]

    def __init__(self, settings: ActivitySettings | None = None, poses: KeyframePoses | None = None) -> None:
        self.settings = settings or ActivitySettings()
        self.poses = KeyframePoses() if poses is None else poses
        self._version = self.poses.version
        """That `_cameras` and `_middles` are of."""
        self.active = set()
        self.spare = set()
        """Put aside only because there are enough: they lie right to the active ones, and no loop leads to them."""
        self._depths = np.empty(0)
        self._cameras = np.empty((0, 3))
        self._middles = np.empty((0, 3))
        self._seen = np.empty(0)
        self._path = 0.0
        self._waiting = 0
        """Keyframes made since there are some to take back."""

    def check(self) -> None:
        """Raises FormatError if keyframes are active that are not there: it may come from a file."""
        check_indices("active keyframes", self.active | self.spare, len(self))

    def __len__(self) -> int:
        return len(self._depths)

    def add(self, T_world_camera: np.ndarray, median_depth_m: float, before: int | None = -1) -> None:
        """A keyframe is made at `T_world_camera` [4, 4]. It is active, and the camera is there now. Its pose joins
        `poses`, unless whoever shares them has put it there already.

        Args:
            before: number of the keyframe that the camera came from; None: it was there already (in a rig).
        """
        self._follow()
        if len(self.poses) == len(self):
            self.poses.append(T_world_camera)
        if len(self) and before is not None:
            self._path += float(np.linalg.norm(T_world_camera[:3, 3] - self._cameras[before]))
        self.active.add(len(self))
        self._depths = np.append(self._depths, median_depth_m)
        self._cameras = np.vstack([self._cameras, T_world_camera[:3, 3]])
        self._middles = np.vstack([self._middles, T_world_camera[:3, 3] + median_depth_m * T_world_camera[:3, 2]])
        self._seen = np.append(self._seen, self._path)
        known = np.zeros(len(self), bool)
        for numbers in (self.active, self.spare):
            known[np.fromiter(numbers, int, len(numbers))] = True
        self._seen[known & self._near(-1)] = self._path

    def _follow(self) -> None:
        """Cameras and what they look at are where `poses` have them."""
        if self._version != self.poses.version:
            T_world_camera = self.poses.array()[: len(self)]
            self._cameras = T_world_camera[:, :3, 3].copy()
            self._middles = self._cameras + self._depths[:, None] * T_world_camera[:, :3, 2]
            self._version = self.poses.version

    def update(self) -> bool:
        """Puts aside and takes back what is due; whether the set changed."""
        self._follow()
        s, before = self.settings, set(self.active)
        limit = s.forget_after * float(np.median(self._depths[-20:]))
        stale = {k for k in self.active if self._path - self._seen[k] > limit}
        if len(stale) >= max(s.batch, len(self.active) // ActivityTuning.set_aside_part):
            self.active -= stale
        if self.spare:
            spare = np.fromiter(self.spare, int, len(self.spare))
            self.spare = set(spare[self._path - self._seen[spare] <= limit].tolist())
        around = set(np.flatnonzero(self._near(-1)).tolist())
        near = around - self.active
        if len(self.active) < s.most or len(around) - len(near) < s.most // 4:
            found = self._reachable(near)
            self._waiting = self._waiting + 1 if found else 0
            # One by one they would have the surface gathered at every keyframe.
            if len(found) + self._waiting > s.batch // 2 or self.active != before:
                self._take_back(found)
                near, self._waiting = near - found, 0
        self._put_aside_spare(near)
        return self.active != before

    def _reachable(self, near: set[int]) -> set[int]:
        """Those of some numbers that lie right to the active ones, by way of others of them, too."""
        numbers = np.array(sorted(near), int)
        if not len(numbers):
            return set()
        chain = np.cumsum(np.diff(numbers, prepend=numbers[0]) > self.settings.spread)
        tied = np.bincount(chain, self._beside_known()[numbers]) > 0
        return set(numbers[tied[chain]].tolist())

    def _beside_known(self) -> np.ndarray:
        """Which keyframes are active or spare or have neighbours in time that are, bool [K]."""
        reach, known = self.settings.spread, np.zeros(len(self) + 2 * self.settings.spread + 1, int)
        for numbers in (self.active, self.spare):
            known[np.fromiter(numbers, int, len(numbers)) + reach + 1] = 1
        gathered = np.cumsum(known)
        return gathered[2 * reach + 1 :] > gathered[: len(self)]

    def _put_aside_spare(self, near: set[int]) -> None:
        """Where more than enough are active, those go that were seen longest ago, and among equals the newer ones,
        which map again what older ones did; but not the newest of all. Those `near` that were not taken back for the
        same reason lie right as well."""
        most = self.settings.most
        if len(self.active) >= most:
            beside = self._beside_known()
            self.spare |= {k for k in near if beside[k]}
        if len(self.active) > most + most // ActivityTuning.set_aside_part:
            newest = len(self) - most // 4
            order = sorted(self.active, key=lambda k: (k >= newest, self._seen[k], -k))
            aside = set(order[: len(self.active) - most])
            self.active -= aside
            self.spare |= aside

    def leave(self) -> None:
        """Puts everything aside: the camera is elsewhere, nobody knows where."""
        self.active, self.spare = set(), set()

    def restart(self, number: int) -> None:
        """After a jump to where keyframe `number` looks: what lies there is active, everything else put aside."""
        self.leave()
        self.activate_around(number)

    def activate_around(self, number: int) -> None:
        """Takes back keyframe `number` and its neighbours in time that look at the same surface: how they lie to the
        camera is known now."""
        self._take_back(self.around(number))

    def around(self, number: int) -> set[int]:
        """Keyframe `number` and its neighbours in time that look at the same surface."""
        near, found = self._near(number), {number}
        for step in (-1, 1):
            k = number
            while 0 <= k < len(self) and (near[k] or abs(k - number) <= self.settings.spread):
                found.add(k)
                k += step
        return found

    @property
    def median_depths(self) -> np.ndarray:
        """Median depth of every keyframe, float64 [K], metres."""
        return self._depths.copy()

    def inactive(self) -> set[int]:
        """Numbers of the keyframes put aside for being out of sight."""
        return set(range(len(self))) - self.active - self.spare

    def alike(self, share: float, degrees: float) -> set[int]:
        """Numbers of the keyframes that saw about what the newest sees: cameras and the middles of what they saw are
        nearer than this share of the mean of both median depths, and directions differ by fewer degrees."""
        self._follow()
        directions = self._middles - self._cameras
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
        apart = np.maximum(*(np.linalg.norm(at - at[-1], axis=1) for at in (self._middles, self._cameras)))
        near = apart < share * 0.5 * (self._depths + self._depths[-1])
        return set(np.flatnonzero(near & (directions @ directions[-1] > np.cos(np.radians(degrees)))).tolist())

    def visits(self, old: int) -> tuple[set[int], set[int]]:
        """Those that look where the newest or keyframe `old` looks: of the first visit and of the one now, which are
        parted halfway between the two."""
        there = set(np.flatnonzero(self._near(-1) | self._near(old)).tolist())
        first = {k for k in there if k <= (old + len(self) - 1) // 2}
        return first, there - first

    def _take_back(self, numbers: set[int]) -> None:
        self.active |= numbers
        self.spare -= numbers
        self._seen[sorted(numbers)] = self._path

    def _near(self, number: int) -> np.ndarray:
        """Which keyframes look where keyframe `number` looks, bool [K]."""
        self._follow()
        reach = self.settings.near * 0.5 * (self._depths + self._depths[number])
        return np.linalg.norm(self._middles - self._middles[number], axis=1) < reach
