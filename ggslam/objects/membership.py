# SPDX-License-Identifier: Apache-2.0
"""Which Gaussians belong to an object: by their labels, then repaired by where they lie.

Labels alone leave specks behind and take strangers along: an identity vector that was seen twice is a guess. Four rules
mend that, in this order:

1. A Gaussian is claimed when its stored label says so, or when the classifier gives the object at least `threshold`.
   Where the two disagree, the stored label has nearly always been right (it has the votes as well): then the object
   must have at least as many of the neighbours as the label has.
2. A claimed Gaussian whose neighbours nearly all carry other labels is a wrong label on another object's surface, and
   is given back. (A floater hangs in the air, where it has no such neighbours.)
3. Claimed Gaussians are joined to components. Small components far from the large ones are floaters.
4. What lies among members (most neighbours are members), or inside the convex hull of a compact object without being
   any other object's or lying on one, is taken along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ggslam.objects.settings import ClassifierTuning
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.identity import IdentityClassifier
from ggslam.system.settings import setting, settings_class


@settings_class(frozen=True)
class MembershipSettings:
    """What counts as part of an object.

    Raises:
        ConfigError: a value outside its range.
    """

    threshold: float = setting(0.4, 0, 1)
    """Probability of the chosen objects (their sum) from which a Gaussian is claimed."""
    repair: bool = True
    """Rules 2 to 4; without, labels are taken as they are."""
    floaters: bool = True
    """Whether floaters count as members: yes for removing (they look like the object), no for moving (they would fly
    along as a swarm)."""
    neighbours: int = setting(12, 1, 1000)
    """Neighbours that are asked in rules 1, 2 and 4."""
    lonely: float = setting(0.1, 0, 1)
    """With no more than this share of its labelled neighbours on its side a label is taken for wrong (rule 2)."""
    agreement: float = setting(0.75, 0, 1)
    """Share of members that takes a Gaussian along (rule 4); neighbours that are unlabelled like it do not count."""
    few: float = setting(0.3, 0, 1)
    """Share of all neighbours that must be members to take a Gaussian along (rule 4)."""
    link_spacings: float = setting(4.0, 0, 1e6)
    """Members this many spacings of the object's Gaussians apart are still joined (rule 3)."""
    floater_share: float = setting(0.05, 0, 1)
    """Components with less than this share of the members are floaters."""
    confident: float = setting(0.6, 0, 1)
    """Probability of another object from which a Gaussian inside the hull is that object's."""
    crowding: float = setting(0.25, 0, 1)
    """A hull that holds more strangers than this share of its members is no compact object's (a wall's hull holds the
    room): then it claims nothing."""


def members(
    gaussians: GaussianMap,
    classifier: IdentityClassifier,
    ids: list[int],
    settings: MembershipSettings | None = None,
) -> np.ndarray:
    """Members of the objects `ids`, bool [N].

    Args:
        gaussians: the map; its identity vectors are read if it has as many channels as the classifier.
        classifier: may be empty; then labels (`object_id`) alone decide.
        ids: one or several object ids; several are treated one after the other, so that two things far apart do not
            make each other floaters.
        settings: see there.
    """
    settings = settings or MembershipSettings()
    chosen = np.zeros(len(gaussians), bool)
    if not len(gaussians):
        return chosen
    evidence = _Evidence.of(gaussians, classifier, ids)
    union = np.isin(evidence.stored, ids) | (evidence.own.sum(1) >= settings.threshold)
    if not settings.repair:
        return union
    surroundings = _Surroundings(gaussians.means.numpy())
    told = evidence.own >= settings.threshold
    for column, object_id in enumerate(ids):
        claimed = _claims(told[:, column], object_id, evidence.stored, surroundings, settings)
        chosen |= _repair(claimed, object_id, evidence, surroundings, settings)
    # claimed by the sum alone: on the border of two of the objects
    common = union & ~told.any(1) & ~np.isin(evidence.stored, ids)
    return chosen | (common & surroundings.near(chosen, settings)) if common.any() else chosen


@dataclass
class _Evidence:
    """What is known of each Gaussian.

    Attributes:
        stored: its label, int32 [N].
        best, probability: the classifier's most probable object (its label without a classifier), int32 and float32.
        own: probability of each of the chosen objects, float32 [N, len(ids)].
    """

    stored: np.ndarray
    best: np.ndarray
    probability: np.ndarray
    own: np.ndarray

    @staticmethod
    def of(gaussians: GaussianMap, classifier: IdentityClassifier, ids: list[int]) -> _Evidence:
        stored, features = gaussians.object_id.numpy().copy(), gaussians.features.numpy()
        if not len(classifier) or features.shape[1] != classifier.weight.shape[1]:
            return _Evidence(stored, stored, (stored > 0).astype(np.float32), (stored[:, None] == ids) * np.float32(1))
        out = _Evidence(
            stored, np.empty_like(stored), np.empty(len(stored), np.float32),
            np.zeros((len(stored), len(ids)), np.float32),
        )  # fmt: skip
        step = max(1, ClassifierTuning.values_at_once // len(classifier))
        for rows in (slice(start, start + step) for start in range(0, len(stored), step)):
            probabilities = classifier.probabilities(features[rows])
            out.best[rows] = classifier.class_ids[probabilities.argmax(1)]
            out.probability[rows] = probabilities.max(1)
            for column, object_id in enumerate(ids):
                out.own[rows, column] = probabilities[:, classifier.class_ids == object_id].sum(1)
        return out

    def label(self) -> np.ndarray:
        """One label for each: the stored one, else the classifier's if it is more likely than not; else 0."""
        return np.where(self.stored > 0, self.stored, np.where(self.probability >= 0.5, self.best, 0))

    def confidently_other(self, object_id: int, confident: float) -> np.ndarray:
        """Whether another object claims a Gaussian confidently."""
        other = (self.best != object_id) & (self.best > 0) & (self.probability >= confident)
        return other & (self.stored != object_id) & (self.stored > 0)


class _Surroundings:
    """Neighbours of Gaussians, looked up as they are needed."""

    def __init__(self, means: np.ndarray) -> None:
        self.means = means
        self.tree = cKDTree(means)

    def of(self, rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances and rows [M, count] of the nearest other Gaussians."""
        count = min(count + 1, len(self.means))
        distance, index = self.tree.query(self.means[rows], k=range(1, count + 1))
        return distance[:, 1:], index[:, 1:]

    def near(self, chosen: np.ndarray, settings: MembershipSettings) -> np.ndarray:
        """Gaussians no farther from a chosen one than chosen ones are joined over, bool [N]."""
        out = chosen.copy()
        if 1 < chosen.sum() < len(chosen):
            reach = _median_spacing(self.means[chosen]) * settings.link_spacings
            distance, _ = cKDTree(self.means[chosen]).query(self.means, distance_upper_bound=reach)
            out |= np.isfinite(distance)
        return out


def _median_spacing(points: np.ndarray) -> float:
    """Median distance to the second nearest of the others: the first is often a twin."""
    count = min(3, len(points))
    distance, _ = cKDTree(points).query(points, k=[count])
    return float(np.median(distance)) + 1e-9


def _claims(
    told: np.ndarray, object_id: int, stored: np.ndarray, surroundings: _Surroundings, s: MembershipSettings
) -> np.ndarray:
    """Whom an object claims, bool [N] (rule 1); `told`: whom the classifier gives it."""
    out = (stored == object_id) | (told & (stored == 0))
    disputed = np.flatnonzero(told & ~out)
    if len(disputed):
        around = stored[surroundings.of(disputed, s.neighbours)[1]]
        out[disputed] = (around == object_id).sum(1) >= (around == stored[disputed, None]).sum(1)
    return out


def _repair(
    claimed: np.ndarray, object_id: int, evidence: _Evidence, surroundings: _Surroundings, s: MembershipSettings
) -> np.ndarray:
    rows = np.flatnonzero(claimed)
    if len(rows) < 4:
        return claimed
    out = claimed.copy()
    label = np.where(claimed, object_id, evidence.label())
    out[rows[_strangers(rows, object_id, label, surroundings, s)]] = False
    if not s.floaters:
        out &= _large_components(out, surroundings.means, s)
    out |= _find_enclosed(out, object_id, evidence, surroundings, s)
    return out


def _strangers(
    rows: np.ndarray, object_id: int, label: np.ndarray, surroundings: _Surroundings, s: MembershipSettings
) -> np.ndarray:
    """Which of the claimed `rows` sit in the surface of other objects, bool [M] (rule 2).

    Only a Gaussian among neighbours as near as is usual there is meant: a floater's nearest neighbours may all be the
    wall's, a long way off.
    """
    distance, index = surroundings.of(rows, s.neighbours)
    around = label[index]
    labelled = (around > 0).sum(1)
    others = labelled - (around == object_id).sum(1)
    embedded = distance[:, distance.shape[1] // 2] <= 3 * np.median(distance[:, -1])
    return (labelled > 0) & (others >= (1 - s.lonely) * labelled) & embedded


def _components(points: np.ndarray, s: MembershipSettings) -> np.ndarray:
    """Number of the connected component of each point [M]."""
    reach = _median_spacing(points) * s.link_spacings
    count = min(9, len(points))
    distance, index = cKDTree(points).query(points, k=range(1, count + 1), distance_upper_bound=reach)
    row, column = np.nonzero(np.isfinite(distance[:, 1:]))
    links = coo_matrix((np.ones(len(row)), (row, index[row, column + 1])), (len(points), len(points)))
    return connected_components(links, directed=False)[1]


def _large_components(chosen: np.ndarray, means: np.ndarray, s: MembershipSettings) -> np.ndarray:
    """The chosen without floaters: small components that lie farther from the large ones than a tenth of their size."""
    rows = np.flatnonzero(chosen)
    if len(rows) < 4:
        return chosen
    points = means[rows]
    number = _components(points, s)
    sizes = np.bincount(number)
    large = (sizes >= s.floater_share * len(rows))[number]
    if not large.any():
        large = number == sizes.argmax()
    core = points[large]
    extent = float(np.linalg.norm(np.subtract(*np.percentile(core, [95, 5], axis=0))))
    distance, _ = cKDTree(core).query(points)
    out = np.zeros(len(chosen), bool)
    out[rows[large | (distance <= 0.1 * extent)]] = True
    return out


def _find_enclosed(
    chosen: np.ndarray, object_id: int, evidence: _Evidence, surroundings: _Surroundings, s: MembershipSettings
) -> np.ndarray:
    """Others that lie among the chosen or in their hull (rule 4), bool [N]."""
    means, out = surroundings.means, np.zeros(len(chosen), bool)
    core = means[_large_components(chosen, means, s)]
    if len(core) < 4:
        return out
    low, high = core.min(0), core.max(0)
    candidates = np.flatnonzero(~chosen & ((means >= low) & (means <= high)).all(1))
    if not len(candidates):
        return out
    other = evidence.confidently_other(object_id, s.confident)
    _, index = surroundings.of(candidates, s.neighbours)
    own = chosen[index].sum(1)
    counted = np.where(other[candidates], index.shape[1], (chosen | (evidence.label() > 0))[index].sum(1))
    out[candidates[(own >= s.agreement * counted) & (own >= s.few * index.shape[1])]] = True
    among_others = ((evidence.label() > 0) & ~chosen)[index].sum(1) > own
    hull = in_hull(core, means[candidates])
    inside, on_others = candidates[hull], among_others[hull]
    strangers = other[inside] | on_others
    if max(strangers.sum(), (~strangers).sum()) <= s.crowding * len(core):
        out[inside[~strangers]] = True
    return out


def in_hull(points: np.ndarray, queries: np.ndarray, trim: float = 0.01) -> np.ndarray:
    """Whether `queries` [Q, 3] lie in the convex hull of `points` [M, 3] less its outermost ones, bool [Q].

    Args:
        points: at least 4. Flat or straight sets are given a little thickness first.
        queries: what to test.
        trim: share of the points, farthest from the median, that is left out.
    """
    centre = np.median(points, 0)
    distance = np.linalg.norm(points - centre, axis=1)
    points = points[distance <= np.quantile(distance, 1 - trim)] if len(points) > 20 else points
    _, sizes, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    deviation = sizes / np.sqrt(len(points))
    thickness = 0.02 * max(float(deviation[0]), 1e-6)
    for axis, value in zip(axes, deviation, strict=True):
        if value < thickness:
            points = np.concatenate([points - thickness * axis, points + thickness * axis])
    try:
        planes = ConvexHull(points).equations.astype(np.float32)
    except QhullError:  # fewer than four different points
        return np.zeros(len(queries), bool)
    inside = np.ones(len(queries), bool)
    for start in range(0, len(planes), 64):  # most queries fail early
        left = np.flatnonzero(inside)
        normals, offsets = planes[start : start + 64, :3], planes[start : start + 64, 3]
        inside[left] = (queries[left] @ normals.T <= -offsets).all(1)
    return inside
