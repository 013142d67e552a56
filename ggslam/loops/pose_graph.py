# SPDX-License-Identifier: Apache-2.0
"""The graph of keyframe poses: odometry, closures, and the selection of closures that agree.

Two tests decide. Each closure alone must be reachable by drift: the correction it asks for is compared with the summed
covariance of the odometry between its ends (a chi-square test; closures that err in unison do not pass either). Taken
from where the closures believed so far have put them, ends are nearer than by dead reckoning; either way will do.
Those left must agree with each other: graduated non-convexity with truncated least squares, odometry being known
inliers (H. Yang et al., "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020, as in GTSAM).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from ggslam.errors import FormatError, MissingDependency
from ggslam.loops.condensed import CondensedGraph, Link, chi_squared_limit
from ggslam.loops.odometry import OdometryTree
from ggslam.loops.settings import GraphSettings
from ggslam.loops.uncertainty import covariance_in_frame, covariance_of
from ggslam.scene.keyframe_poses import KeyframePoses
from ggslam.scene.poses import inverse, se3_log, so3_log
from ggslam.system.array_forms import check_indices
from ggslam.system.savable import savable
from ggslam.system.tuning import Tuning


class PoseGraphTuning(Tuning):
    """Uncertainties of the pose graph."""

    min_path_m = 0.01
    """Shortest path between keyframes, in metres, that an uncertainty is computed from. No motion counts as exact."""
    rig_sigma_m = 1e-4
    """Standard deviation of the position of a rig's cameras to one another, in metres."""
    rig_sigma_deg = 1e-3
    """Standard deviation of the orientation of a rig's cameras to one another, in degrees."""
    unknown_lengths = 100.0
    """Standard deviation of an unknown motion, in lengths of that motion. Its pull is then below 0.01 mm."""
    unknown_deg = 3600.0
    """Standard deviation of an unknown rotation, in degrees."""


SURE_INFORMATION = 1e6 * np.eye(6)
"""Of a motion that is sure to a millimetre and a milliradian: then drift is all that is unsure of it."""


def odometry_covariance(T_i_j: np.ndarray, information: np.ndarray, settings: GraphSettings) -> np.ndarray:
    """Covariance [6, 6] of a motion by odometry, left twist in frame i: its own and what the path drifts."""
    turn = float(np.linalg.norm(so3_log(T_i_j[:3, :3])))
    path = max(float(np.linalg.norm(T_i_j[:3, 3])) + settings.turn_length * turn, PoseGraphTuning.min_path_m)
    drift = _isotropic(settings.translation_drift * path**0.5, settings.rotation_drift_deg * path**0.5)
    return covariance_of(information, covariance_in_frame(drift, T_i_j))


def closure_covariance(T_i_j: np.ndarray, information: np.ndarray, settings: GraphSettings) -> np.ndarray:
    """Covariance [6, 6] of a motion by a closure, left twist in frame i."""
    added = _isotropic(settings.loop_translation, settings.loop_rotation_deg)
    return covariance_of(information, covariance_in_frame(added, T_i_j))


@dataclass(frozen=True)
class GraphResult:
    """Poses that satisfy odometry and the accepted closures.

    Attributes:
        poses: float64 [n, 4, 4], T_world_camera of all nodes; the first stays where it was.
        accepted: numbers of the closures believed.
        rejected: reason by number of the closures that were not; they are judged anew next time.
        error_before, error_after: half the squared Mahalanobis length of all residuals of odometry and the believed
            closures, before and after.
        seconds: time taken.
    """

    poses: np.ndarray
    accepted: tuple[int, ...]
    rejected: dict[int, str]
    error_before: float
    error_after: float
    seconds: float


@savable(not_saved="settings", growing="loops", check="check")
class PoseGraph:
    """Keyframe poses, linked by odometry and closures.

    All information matrices are inverse covariances [6, 6] of the left twist (v, w) of a motion T_i_j, translation
    first: T_true = exp((v, w)) T_i_j, in the axes of frame i about its origin (see `uncertainty`). They are made less
    sure by what `GraphSettings` says of drift.

    Args:
        settings: see `GraphSettings`.
        poses: of the nodes as last known, which others may share; None: its own. `optimise` starts from them.
    """

    loops: list[Link]

    def __init__(self, settings: GraphSettings | None = None, poses: KeyframePoses | None = None) -> None:
        self.settings = settings or GraphSettings()
        self.poses = KeyframePoses() if poses is None else poses
        self.loops = []
        self._tree = OdometryTree()
        self._nodes = 0

    def check(self) -> None:
        """Raises FormatError if links lead to nodes that are not there: it may come from a file."""
        if not len(self._tree) == len(self) == len(self.poses):
            raise FormatError(f"pose graph: {len(self)} nodes, {len(self.poses)} poses, odometry of {len(self._tree)}")
        for link in self.loops:
            check_indices("pose graph", (link.i, link.j), len(self.poses))
            if link.i == link.j:
                raise FormatError(f"pose graph: node {link.i} is linked to itself")

    def add_node(self, T_world_camera: np.ndarray) -> int:
        """A keyframe; returns its number. Every node but the first then needs an `add_odometry` of its own. Its pose
        joins `poses`, unless whoever shares them has put it there already."""
        self._check_odometry()
        if len(self.poses) == len(self):
            self.poses.append(T_world_camera)
        self._nodes += 1
        if len(self) == 1:
            self._tree = OdometryTree.root()
        return len(self) - 1

    def __len__(self) -> int:
        """How many nodes there are."""
        return self._nodes

    def _check_odometry(self) -> None:
        if len(self._tree) != len(self):
            raise ValueError(f"node {len(self) - 1} has no odometry yet")

    def add_odometry(
        self, i: int, j: int, T_i_j: np.ndarray, information: np.ndarray, found: bool = False, rigid: bool = False,
        unknown: bool = False,
    ) -> None:  # fmt: skip
        """The motion from an earlier node i to the newest node j. It is never doubted.

        Args:
            found: the camera was lost on the way, and found at node i.
            rigid: both are cameras of one rig at one instant; nothing drifts between them.
            unknown: nothing is known of it: j begins a part at an arbitrary place (`KeyframeParts`).

        Raises:
            ValueError: j is not the newest node, has odometry already, or i is not before it.
        """
        if j != len(self) - 1 or len(self._tree) != j or not 0 <= i < j:
            raise ValueError(f"odometry {i} to {j}: expected from an older node to the newest, which has none yet")
        s, covariance = self.settings, _isotropic(PoseGraphTuning.rig_sigma_m, PoseGraphTuning.rig_sigma_deg)
        if not rigid:
            covariance = odometry_covariance(T_i_j, information, s)
        if unknown:
            far = PoseGraphTuning.unknown_lengths * float(np.linalg.norm(T_i_j[:3, 3]))
            covariance = covariance + covariance_in_frame(_isotropic(far, PoseGraphTuning.unknown_deg), T_i_j)
        if found:
            covariance += covariance_in_frame(_isotropic(s.found_translation, s.found_rotation_deg), T_i_j)
        self._tree.add(i, np.array(T_i_j, float), covariance)

    def add_loop(self, i: int, j: int, T_i_j: np.ndarray, information: np.ndarray) -> int:
        """A closure between two nodes; returns its number. Whether it is believed, `optimise` decides.

        Raises:
            ValueError: no two different nodes.
        """
        if i == j or not (0 <= i < len(self) and 0 <= j < len(self)):
            raise ValueError(f"closure from {i} to {j}: expected two different ones of {len(self)} nodes")
        self.loops.append(Link(i, j, np.array(T_i_j, float), closure_covariance(T_i_j, information, self.settings)))
        return len(self.loops) - 1

    def discrepancy(self, i: int, j: int, T_i_j: np.ndarray, information: np.ndarray) -> float:
        """How far two nodes are from where a closure, taken as `add_loop` does, has them: the Mahalanobis length of
        the motion between, in units of the limit that closures which agree stay below."""
        twist = se3_log(T_i_j @ inverse(inverse(self.poses[i]) @ self.poses[j]))
        squared = float(twist @ np.linalg.solve(closure_covariance(T_i_j, information, self.settings), twist))
        return (squared / chi_squared_limit(self.settings.inlier_probability)) ** 0.5

    def optimise(self, waiting: Iterable[int] = (), start: Sequence[np.ndarray] | None = None) -> GraphResult:
        """Judges all closures, also those rejected before, and finds where the nodes agree with the believed ones.
        `poses` stay as they are: whoever believes the result puts it there.

        Args:
            waiting: numbers of closures that are not to be believed yet, whatever they say.
            start: T_world_camera [4, 4] of each node to start from; None: `poses`.

        Raises:
            MissingDependency: gtsam is not installed.
            ValueError: the newest node has no odometry.
        """
        began, start = time.perf_counter(), list(self.poses if start is None else start)
        self._check_odometry()
        gtsam = _gtsam()
        aside = dict.fromkeys(waiting, "not confirmed yet")
        judged = [k for k in range(len(self.loops)) if k not in aside]
        far = self._beyond_drift(start, self._beyond_drift(self._tree.poses, judged))
        while True:
            condensed, disagreeing, errors = self._optimize_condensed(gtsam, far | aside, start)
            poses = condensed.all_poses()
            nearer = self._beyond_drift(poses, far)
            if len(nearer) == len(far):
                break
            far = nearer  # what is out of odometry's reach may be near once the closures before it are closed
        rejected = far | aside | disagreeing
        accepted = tuple(k for k in range(len(self.loops)) if k not in rejected)
        return GraphResult(poses, accepted, rejected, *errors, time.perf_counter() - began)

    def _beyond_drift(self, poses: Sequence[np.ndarray] | np.ndarray, numbers: Iterable[int]) -> dict[int, str]:
        """Reason by number of those closures that drift does not explain, given poses [n, 4, 4] to start from."""
        limit = chi_squared_limit(self.settings.drift_probability)
        rejected = {}
        for number in numbers:
            loop = self.loops[number]
            T = inverse(poses[loop.i]) @ poses[loop.j]
            covariance = self._tree.covariance_between(loop.i, loop.j) + loop.covariance
            twist = se3_log(loop.T_i_j @ inverse(T))
            squared = float(twist @ np.linalg.solve(covariance, twist))
            if squared > limit:
                shift = float(np.linalg.norm(loop.T_i_j[:3, 3] - T[:3, 3]))
                turn = float(np.degrees(np.linalg.norm(twist[3:])))
                rejected[number] = (
                    f"{shift:.2f} m and {turn:.1f} degrees off, beyond drift: {squared**0.5:.1f} standard deviations, "
                    f"limit {limit**0.5:.1f}"
                )
        return rejected

    def _optimize_condensed(
        self, gtsam: ModuleType, far: Mapping[int, str], start: list[np.ndarray]
    ) -> tuple[CondensedGraph, dict[int, str], tuple[float, float]]:
        """The graph, optimized on the plausible closures that agree; why the others do not; the error before and
        after."""
        candidates = [k for k in range(len(self.loops)) if k not in far]
        condensed = CondensedGraph(self._tree, start, [self.loops[k] for k in candidates])
        believed, limit, lengths = condensed.agreement(gtsam, self.settings.inlier_probability)
        disagreeing = {
            number: f"disagrees with other closures: {length:.1f} standard deviations, limit {limit:.1f}"
            for number, ok, length in zip(candidates, believed, lengths, strict=True)
            if not ok
        }
        return condensed, disagreeing, condensed.optimize(gtsam, believed)


def _isotropic(metres: float, degrees: float) -> np.ndarray:
    """Covariance [6, 6] of standard deviations per axis."""
    return np.diag([metres**2] * 3 + [np.radians(degrees) ** 2] * 3)


def _gtsam() -> ModuleType:
    try:
        import gtsam
    except ImportError:
        raise MissingDependency("closing loops needs gtsam: pip install gtsam, or run without loops") from None
    return gtsam
