# SPDX-License-Identifier: Apache-2.0
"""Which objects were added, removed, moved or changed in look between two visits, and of which nothing can be said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from ggslam.changes.alignment_score import Fit, Judge
from ggslam.changes.candidate_views import CandidateViews
from ggslam.changes.candidates import UNNAMED, Candidate, JudgedSurface, candidates_by_id, candidates_by_surface
from ggslam.changes.change import HARDLY_SEEN, UNCLEAR, Change, Detection
from ggslam.changes.motions import CandidateMotionTuning
from ggslam.changes.pose_refinement import PoseRefinement
from ggslam.changes.rotation_ambiguity import hidden_sector, with_rotation_ambiguity
from ggslam.changes.settings import ChangeSettings
from ggslam.changes.shape import Shape
from ggslam.changes.shape_alignment import fit_shapes
from ggslam.changes.sightings import Sightings, Surface, Visit
from ggslam.native.loader import NativeContext
from ggslam.scene.poses import transform_points, turning_angle
from ggslam.sight.margin import Margin
from ggslam.system.tuning import Tuning
from ggslam.volumes.upright import estimate_up


class DetectionTuning(Tuning):
    """How two visits are compared."""

    same_place_m = 0.03
    """Largest distance between points of two visits that may be of one object, in metres."""
    max_replaced = 0.4
    """Share of the objects that seem to have stayed which may be others of the same shape."""
    rotation_points = 1500
    """Points of a candidate that other rotations are tried with."""
    samples = 20_000
    """Points that usual differences are measured at, about."""
    max_tolerances = 4
    """Differences above this many times the smallest tolerance are not usual."""


class ChangeDetector:
    """Compares two visits.

    Args:
        old, new: the visits, in one world.
        settings: see there.
        context: threads.
        ids: whether one id is one thing in both visits; None: it is found out.
    """

    def __init__(
        self, old: Visit, new: Visit, settings: ChangeSettings, context: NativeContext, ids: bool | None = None
    ) -> None:
        self.visits, self.settings, self._ids = (old, new), settings, ids
        self.sights = [Sightings(visit, settings, context) for visit in self.visits]
        self._up = estimate_up(old.T_world_camera, old.measured, old.normals).up
        self.judged: list[JudgedSurface] = []
        self._trees: list[cKDTree | None] = [None, None]
        """Of each visit's points, if there are any."""
        self.candidates: list[list[Candidate]] = [[], []]

    def detect(self) -> Detection:
        """Finds all changes."""
        found = Detection()
        surfaces = [sights.surface(self.settings.spacing_m) for sights in self.sights]
        found.tolerance = self._usual_tolerance(surfaces)
        self.judged = [self._judge(number, surface, found.tolerance) for number, surface in enumerate(surfaces)]
        self._trees = [cKDTree(judged.points) if len(judged.points) else None for judged in self.judged]
        both = all(visit.has_objects for visit in self.visits)
        found.ids_believed = both and (self._ids_agree() if self._ids is None else self._ids)
        if not both:
            words = ", whatever ids are said to mean" if self._ids else ""
            found.notes.append(f"a visit has no objects: changes are told by surfaces alone{words}")
        split = candidates_by_id if found.ids_believed else candidates_by_surface
        self.candidates = [split(judged, self.settings) for judged in self.judged]
        self._compare(found)
        found.changes.sort(key=lambda change: -change.confidence)
        return found

    # --- evidence ----------------------------------------------------------------------------------------------------

    def _usual_tolerance(self, surfaces: list[Surface]) -> Margin:
        """How near surfaces have to be to be one: by how much the visits differ where nothing changed."""
        s, offsets = self.settings, []
        for number, surface in enumerate(surfaces):
            sample = surface.points[:: max(1, len(surface.points) // DetectionTuning.samples)]
            least = Margin(
                DetectionTuning.max_tolerances * s.tolerance_m, DetectionTuning.max_tolerances * s.tolerance_relative
            )
            other = self.sights[1 - number].look_up(sample, least)
            offsets.append(np.abs(other.offset[np.isfinite(other.offset)]))
        usual = np.concatenate(offsets)
        spread = float(np.median(usual)) if len(usual) else 0.0
        return Margin(s.tolerance_m, max(s.tolerance_relative, s.tolerance_spread * spread))

    def _judge(self, number: int, surface: Surface, tolerance: Margin) -> JudgedSurface:
        own = self.sights[number].look_up(surface.points, tolerance)
        kept = (own.through <= self.settings.contradicted * own.present) & (own.present >= self.settings.min_views)
        points, ids = surface.points[kept], surface.labels[kept].astype(np.int64)
        other = self.sights[1 - number].look_up(points, tolerance)
        distance = cKDTree(self.visits[number].T_world_camera[:, :3, 3]).query(points)[0]
        return JudgedSurface(points, surface.colors[kept], surface.toward[kept], ids, other, tolerance(distance))

    def _ids_agree(self) -> bool:
        """Whether things that stayed have the same ids in both visits. Few may have taken the places of others."""
        same, count, taken = 0, 0, 0
        old = self.judged[0]
        stayed = old.other.is_there(self.settings.min_views) & (old.ids > 0)
        for i in np.unique(old.ids[stayed]).tolist():
            own = old.ids == i
            rows = np.flatnonzero(stayed & own)
            if len(rows) < max(self.settings.min_points, self.settings.whole * own.sum()):
                continue  # what stayed of a thing that went are the places where it touched others
            there = self._id_at(1, old.points[rows])
            if there is not None:
                count += 1
                same += int(there == i)
                taken += int(there not in (0, i))
        return same > 0 and same >= self.settings.ids_alike * (
            count - min(taken, int(DetectionTuning.max_replaced * count))
        )

    # --- verdicts ----------------------------------------------------------------------------------------------------

    def _compare(self, found: Detection) -> None:
        gone, come = ([t for t in things if self._is_changed(t, found.ids_believed)] for things in self.candidates)
        doubted = {id(thing) for thing in gone if thing.changed >= self.settings.whole}
        by_id, swapped = set[int](), set[int]()
        if found.ids_believed:
            doubted |= {id(thing) for thing in self._drop_hardly_seen(gone, come)}
            doubted |= {id(thing) for thing in self._pair_by_id(found, gone, come)}
            by_id = {id(thing) for thing in self._find_replaced(found, gone, come)}
        else:
            self._pair_by_shape(found, gone, come)
            swapped = {id(thing) for thing in self._find_swapped(gone, come)}
        found.changes += [Change("removed", t, None, confidence=_confidence(t, id(t) in by_id)) for t in gone]
        found.changes += [Change("added", None, t, confidence=_confidence(t, id(t) in by_id)) for t in come]
        self._compare_looks(found)
        known = swapped | {id(change.old) for change in found.changes}
        for thing in self.candidates[0]:
            if id(thing) in known:
                continue
            if thing.seen < self.settings.min_seen:
                found.unseen.append(Change("unseen", thing, None, reason=HARDLY_SEEN))
            elif id(thing) in doubted:
                found.unseen.append(Change("unseen", thing, None, reason=UNCLEAR))
            else:
                found.stayed += 1

    def _is_changed(self, thing: Candidate, ids_believed: bool) -> bool:
        """Where ids say nothing, what is gone of an object is a thing of its own."""
        s = self.settings
        changed = thing.seen >= s.min_seen and thing.changed >= s.min_changed
        return changed and (ids_believed or thing.label >= UNNAMED)

    def _shape(self, number: int, thing: Candidate) -> Shape:
        judged = self.judged[number]
        return Shape.from_views(*(values[thing.rows] for values in (judged.points, judged.colors, judged.toward)))

    def _fit(self, old: Candidate, new: Candidate) -> Fit | None:
        if min(len(old), len(new)) < self.settings.min_points:
            return None
        small, large = sorted((self.judged[0].extent(old), self.judged[1].extent(new)))
        if large > self.settings.max_size_ratio * small:
            return None
        before, after = self._shape(0, old), self._shape(1, new)
        return fit_shapes(before, after, self.sights[0], self.sights[1], self._up, self.settings)

    def _with_turn(self, old: Candidate, new: Candidate, fit: Fit) -> Fit:
        """A fit, with what makes its turn doubtful."""
        if fit.color_apart > self.settings.max_color:
            return replace(fit, repainted=True)
        before, after = self._shape(0, old), self._shape(1, new)
        judge = Judge(before, after, self.sights[0], self.sights[1], self.settings)
        toward = [judged.toward[thing.rows] for judged, thing in zip(self.judged, (old, new), strict=True)]
        hidden = hidden_sector(toward[0], self._up), hidden_sector(toward[1], self._up)
        sample = before.sample(DetectionTuning.rotation_points, np.random.default_rng(0))
        return with_rotation_ambiguity(fit, sample, after, judge, hidden, self._up)

    def _motion_change(self, old: Candidate, new: Candidate, fit: Fit) -> Change | None:
        """The change that a fit tells, once it is placed exactly; None: it did not move by more than the maps err."""
        T = fit.T_new_old
        if not self._has_moved(old, T) or not self._has_moved(old, T := self._place(old, new, T)):
            return None
        placed, fit = turning_angle(T, fit.T_new_old), self._with_turn(old, new, fit)
        if placed > CandidateMotionTuning.same_rotation_rad and fit.turn_known:  # surfaces and pictures tell two turns
            fit = replace(fit, as_good_deg=round(float(np.degrees(placed))))
        fit = replace(fit, T_new_old=T)
        return Change("moved", old, new, T, fit, fit.share * min(1.0, max(0.0, 1 - fit.color_apart)))

    def _place(self, old: Candidate, new: Candidate, T: np.ndarray) -> np.ndarray:
        """Where exactly a thing lies of which it is known that it moved, and about where to."""
        trees = [tree for tree in self._trees if tree is not None]
        views = [
            CandidateViews(self.sights[k].pictures, trees[k], thing.rows, thing.ids)
            for k, thing in enumerate((old, new))
        ]
        return PoseRefinement(self._shape(0, old), self._shape(1, new), (views[0], views[1])).place(T, self._up)

    def _has_moved(self, old: Candidate, T_new_old: np.ndarray) -> bool:
        """Whether by more than the maps err."""
        s, judged = self.settings, self.judged[0]
        middle, error = judged.points[old.rows].mean(0), 0.5 * float(judged.within[old.rows].mean())
        shift = float(np.linalg.norm(transform_points(middle[None], T_new_old)[0] - middle))
        turn = float(np.degrees(turning_angle(T_new_old, np.eye(4))))
        least_turn = max(s.least_turn_deg, float(np.degrees(error / (0.5 * judged.extent(old)))))
        return shift >= max(s.least_motion_m, error) or turn >= least_turn

    def _pair_by_id(self, found: Detection, gone: list[Candidate], come: list[Candidate]) -> list[Candidate]:
        """What has one id in both visits, and is elsewhere: takes it from `gone` and `come`. Returns what of the older
        visit changed in a way that cannot be told."""
        s, ours, theirs = self.settings, *({t.label: t for t in things} for things in self.candidates)
        changed = {t.label for t in (*gone, *come)}
        unclear: list[Candidate] = []
        for label in sorted(label for label in ours.keys() & theirs.keys() if label < UNNAMED):
            old, new = ours[label], theirs[label]
            shifted = label not in changed and self._has_shifted(old, new)
            if label not in changed and not shifted:
                continue
            for things, thing in ((gone, old), (come, new)):
                if thing in things:
                    things.remove(thing)
            # What one visit saw go or come as a whole is elsewhere, also where the other place was hidden from a visit.
            sure = any(t.seen >= s.min_seen and t.changed >= s.whole for t in (old, new))
            if min(old.seen, new.seen) < s.min_seen and not sure:  # of what hardly was seen nothing is said
                continue
            change = self._change_of_pair(old, new, shifted, sure)
            if change is not None:
                found.changes.append(change)
            elif sure or min(old.changed, new.changed) >= s.shifted:
                unclear.append(old)
        return unclear

    def _change_of_pair(self, old: Candidate, new: Candidate, shifted: bool, sure: bool) -> Change | None:
        """How a thing moved; `shifted`: along what it lies on; `sure`: a visit saw it go or come as a whole."""
        s, fit = self.settings, self._fit(old, new)
        if fit is None:
            return None
        fits = fit.share >= s.min_fit
        if shifted and fits and fit.color_apart <= s.max_color:
            return self._motion_change(old, new, fit)
        # Where surfaces do not fit, as of a cloth, both places have to have changed as a whole.
        enough = min(old.changed, new.changed) >= (s.min_changed if fits else s.whole)
        return self._motion_change(old, new, fit) if (fits and sure) or enough else None

    def _drop_hardly_seen(self, gone: list[Candidate], come: list[Candidate]) -> list[Candidate]:
        """What a visit has too little of to be a thing did not come or go; returns what seemed to be gone of these."""
        before = list(gone)
        for number, things in enumerate((gone, come)):
            known = set(np.unique(self.visits[1 - number].gaussians.object_id.numpy()).tolist())
            known -= {t.label for t in self.candidates[1 - number]}
            things[:] = [t for t in things if t.label not in known]
        kept = set(map(id, gone))
        return [thing for thing in before if id(thing) not in kept]

    def _find_replaced(self, found: Detection, gone: list[Candidate], come: list[Candidate]) -> list[Candidate]:
        """What stands where something else of another id stood: that was removed, if it is nowhere, and this was added,
        if it was nowhere. Returns what ids alone tell, for what moved is there now, or was."""
        s, ours, theirs = self.settings, *({t.label: t for t in things} for things in self.candidates)
        moved = {change.old.label for change in found.changes if change.kind == "moved" and change.old is not None}
        by_id: list[Candidate] = []
        for label, old in ours.items():
            if label >= UNNAMED or old.seen < s.min_seen or label in theirs or self._has_any(1, label):
                continue
            new = theirs.get(self._counterpart(old))
            if new is None or not (new.label in moved or (new.label not in ours and self._differ(old, new))):
                continue
            for things, thing in ((gone, old), (come, new)):
                if thing not in things and thing.label not in moved:
                    things.append(thing)
                    by_id += [thing] if new.label in moved else []
        for label, new in theirs.items():
            if label >= UNNAMED or new.seen < s.min_seen or label in ours or self._has_any(0, label) or new in come:
                continue
            if self._id_at(0, self.judged[1].points[new.rows]) in moved:
                come.append(new)
                by_id.append(new)
        return by_id

    def _has_any(self, number: int, label: int) -> bool:
        """Whether a visit's map has anything of an object."""
        return bool((self.visits[number].gaussians.object_id == label).any())

    def _differ(self, old: Candidate, new: Candidate) -> bool:
        """Whether things at one place have different shapes or colours."""
        shapes = max(old.changed, new.changed) >= self.settings.min_changed
        return shapes or max(_or_zero(old.color_apart), _or_zero(new.color_apart)) > self.settings.look

    def _counterpart(self, old: Candidate) -> int:
        """Id of what the newer visit has where a thing of the older one stood; 0: nothing with one."""
        return self._id_at(1, self.judged[0].points[old.rows]) or 0

    def _id_at(self, number: int, points: np.ndarray) -> int | None:
        """The id that a visit has most of at points [n, 3], 0 for no object; None: it has nothing there."""
        ids = self._ids_at(number, points)
        return int(np.bincount(ids).argmax()) if len(ids) else None

    def _ids_at(self, number: int, points: np.ndarray) -> np.ndarray:
        """The ids that a visit has at those of the points [n, 3] at which it has a surface, 0 for no object."""
        tree = self._trees[number]
        if tree is None:
            return np.zeros(0, np.int64)
        apart, nearest = tree.query(points, distance_upper_bound=DetectionTuning.same_place_m)
        return self.judged[number].ids[nearest[np.isfinite(apart)]]

    def _has_shifted(self, old: Candidate, new: Candidate) -> bool:
        """Whether much of where either visit has a thing is something else in the other one: what is thin and was
        pushed along its support leaves no gap. Of a thing that only one visit shows much of, labels end elsewhere."""
        if max(len(old), len(new)) > self.settings.max_size_ratio * min(len(old), len(new)):
            return False
        for number, thing in enumerate((old, new)):
            ids = self._ids_at(1 - number, self.judged[number].points[thing.rows])
            if thing.seen < self.settings.min_seen or (ids != thing.label).sum() < self.settings.shifted * len(thing):
                return False
        return True

    def _pair_by_shape(self, found: Detection, gone: list[Candidate], come: list[Candidate]) -> None:
        """What went and what came that is one thing by shape and colour: takes it from `gone` and `come`."""
        s = self.settings
        fits = {(a, b): self._fit(old, new) for a, old in enumerate(gone) for b, new in enumerate(come)}
        cost = np.full((len(gone), len(come)), 10.0)
        for pair, fit in fits.items():
            if fit is not None and fit.share >= s.min_fit and fit.color_apart <= s.max_color:
                cost[pair] = 1 - fit.quality()
        taken: list[tuple[int, int]] = [
            (int(a), int(b)) for a, b in zip(*linear_sum_assignment(cost), strict=True) if cost[a, b] < 10
        ]
        for a, b in taken:
            fit = fits[a, b]
            assert fit is not None
            change = self._motion_change(gone[a], come[b], fit)
            if change is not None:
                found.changes.append(change)
        for things, numbers in ((gone, {a for a, _ in taken}), (come, {b for _, b in taken})):
            things[:] = [thing for k, thing in enumerate(things) if k not in numbers]

    def _find_swapped(self, gone: list[Candidate], come: list[Candidate]) -> list[Candidate]:
        """Objects that stand where others stood, of another shape and other colours: what went and what came there are
        parts of them. Returns these parts."""
        s, theirs = self.settings, {t.label: t for t in self.candidates[1]}
        absorbed: list[Candidate] = []
        for old in [t for t in self.candidates[0] if t.label < UNNAMED]:
            new = theirs.get(self._counterpart(old))
            if new is None or new.label >= UNNAMED or min(old.seen, new.seen) < s.min_seen:
                continue
            parts = [self._parts(0, gone, old), self._parts(1, come, new)]
            if any(parts) and max(_or_zero(old.color_apart), _or_zero(new.color_apart)) > s.swapped:
                for things, own, whole in zip((gone, come), parts, (old, new), strict=True):
                    things[:] = [t for t in things if t not in own] + [whole]
                absorbed += [t for own in parts for t in own]
        return absorbed

    def _parts(self, number: int, things: list[Candidate], whole: Candidate) -> list[Candidate]:
        """Those that lie in an object for the most part."""
        ids = self.judged[number].ids
        return [t for t in things if (ids[t.rows] == whole.label).mean() > 0.5]

    def _compare_looks(self, found: Detection) -> None:
        """What stayed and looks otherwise."""
        s = self.settings
        known = {id(change.old) for change in found.changes}
        theirs = {t.label: t for t in self.candidates[1]}
        for old in self.candidates[0]:
            stays = id(old) not in known and old.seen >= s.min_seen and old.changed < s.min_changed
            if stays and old.label < UNNAMED and _or_zero(old.color_apart) > s.look:
                new = theirs.get(self._counterpart(old))
                if new is not None and found.ids_believed and new.label != old.label:
                    continue  # another thing
                if new is not None and _or_zero(new.color_apart) > s.look:
                    found.changes.append(Change("look", old, new, confidence=min(1.0, old.color_apart / (2 * s.look))))


def _or_zero(value: float) -> float:
    return value if np.isfinite(value) else 0.0


def _confidence(thing: Candidate, by_id: bool) -> float:
    """Of something that went or came, as its id tells, or surfaces and colours."""
    return min(1.0, 2 * thing.seen) * (1.0 if by_id else max(thing.changed, _or_zero(thing.color_apart)))
