# SPDX-License-Identifier: Apache-2.0
"""The list of the objects of a map: what each is called, where it is, how large, how sure, when it was seen."""

from __future__ import annotations

import difflib
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from ggslam.errors import ConfigError, FormatError, InputError
from ggslam.objects.boxes import middle_of, oriented_box
from ggslam.objects.history import History
from ggslam.objects.settings import ClassifierTuning
from ggslam.scene.gaussian_map import GaussianMap
from ggslam.scene.id_colors import id_palette
from ggslam.scene.identity import IdentityClassifier
from ggslam.scene.object_names import object_label
from ggslam.scene.oriented_box import OrientedBox, Vector
from ggslam.system.atomic import write_text
from ggslam.system.savable import savable
from ggslam.system.untrusted_files import read_untrusted_text

Supervision = Literal["masks", "associated masks", "geometry", "model"]
"""Where the ids came from: masks whose ids are constant in time; masks made consistent by association; the geometric
segmenter; a segmentation model."""

Byte = Annotated[int, pydantic.Field(ge=0, le=255)]
Count = Annotated[int, pydantic.Field(ge=0)]
ObjectId = Annotated[int, pydantic.Field(ge=1, le=65535)]


@savable()
@dataclass(frozen=True)
class Observation:
    """When an object was seen: first and last frame, and in how many views (keyframes)."""

    first_frame: int
    last_frame: int
    views: int


@dataclass(frozen=True)
class ObjectRecord:
    """One object.

    Attributes:
        id: 1 to 65535.
        name: None if nobody named it.
        color: RGB in pictures.
        gaussians: how many belong to it.
        confidence: mean probability of this object over its Gaussians, by the classifier; None where the classifier
            does not know the object.
        centroid: mean of its Gaussians' centres by opacity, metres, world frame.
        box: around its Gaussians' centres.
        first_frame, last_frame: frames it was seen in; None if it was never observed.
        views: how many views it was seen in.
    """

    id: ObjectId
    name: str | None
    color: tuple[Byte, Byte, Byte]
    gaussians: Count
    confidence: Annotated[float, pydantic.Field(ge=0, le=1)] | None
    centroid: Vector
    box: OrientedBox
    first_frame: Count | None = None
    last_frame: Count | None = None
    views: Count = 0

    def label(self) -> str:
        """For people: the name and id, or the id alone."""
        return object_label(self.id, self.name)


@dataclass(frozen=True)
class ObjectTable:
    """The objects of a map, by rising id.

    Attributes:
        supervision: where the ids came from.
        unlabelled_gaussians: Gaussians that belong to none.
        objects: the records.
        history: what became of objects from visit to visit; None: the map is of one visit.
    """

    supervision: Supervision
    unlabelled_gaussians: Count
    objects: list[ObjectRecord] = field(default_factory=list)
    history: History | None = None

    @staticmethod
    def build(
        gaussians: GaussianMap,
        classifier: IdentityClassifier,
        supervision: Supervision,
        names: Mapping[int, str] | None = None,
        observations: Mapping[int, Observation] | None = None,
    ) -> ObjectTable:
        """Describes the objects of a map.

        Args:
            gaussians: with `object_id` and, for the confidence, identity vectors in `features`.
            classifier: of the identity vectors.
            supervision: see `Supervision`.
            names: of ids, where known.
            observations: of ids, where known.

        Raises:
            InputError: an object id outside 0 to 65535.
        """
        return ObjectTable.of_parts([gaussians], classifier, supervision, names, observations)

    @staticmethod
    def of_parts(
        parts: Iterable[GaussianMap],
        classifier: IdentityClassifier,
        supervision: Supervision,
        names: Mapping[int, str] | None = None,
        observations: Mapping[int, Observation] | None = None,
    ) -> ObjectTable:
        """Like `build` for a map that comes in parts; of them, centres and opacities of labelled Gaussians are kept in
        memory until the end (16 bytes each)."""
        gathered: dict[int, _Gathered] = {}
        unlabelled = 0
        for part in parts:
            unlabelled += _gather(part, classifier, gathered)
        known, seen = names or {}, observations or {}
        records = []
        for name, own in sorted(gathered.items()):
            observed = asdict(seen[name]) if name in seen else {}
            means, opacities = np.concatenate(own.means), np.concatenate(own.opacities)
            records.append(
                ObjectRecord(
                    name, known.get(name), object_color(name), len(means), own.confidence(len(means)),
                    middle_of(means, opacities), oriented_box(means), **observed,
                )
            )  # fmt: skip
        return ObjectTable(supervision, unlabelled, records)

    def __len__(self) -> int:
        return len(self.objects)

    def ids(self) -> list[int]:
        """Ids of all objects, rising."""
        return [record.id for record in self.objects]

    def record(self, object_id: int) -> ObjectRecord:
        """The object of an id.

        Raises:
            ConfigError: no such object.
        """
        found = [record for record in self.objects if record.id == object_id]
        if not found:
            raise self._unknown(str(object_id))
        return found[0]

    def find(self, name_or_id: str) -> list[int]:
        """Ids that "mug" or "7" stand for; a name that several objects share stands for all of them. Case and spaces
        around do not matter; an id goes before a name of the same digits, a name before a label ("mug (2)", "object 7")
        as messages print it.

        Raises:
            ConfigError: no object is called so; the message lists near names.
        """
        wanted = name_or_id.strip().casefold()
        if wanted.isdecimal() and int(wanted) in self.ids():
            return [int(wanted)]
        found = [record.id for record in self.objects if record.name is not None and record.name.casefold() == wanted]
        if not found:
            found = [record.id for record in self.objects if record.label().casefold() == wanted]
        if not found:
            raise self._unknown(name_or_id)
        return found

    def select(self, text: str) -> list[int]:
        """Ids that a list like "mug,7" or "all" stands for, each once, in the order given.

        Raises:
            ConfigError: no object is called so, or the list is empty, or it is no text.
        """
        if not isinstance(text, str):
            raise ConfigError(f'objects: expected names or ids as text like "mug,7", found {text!r}')
        wanted = text.strip().casefold()
        if wanted == "all":
            return self.ids()
        if any(record.name is not None and record.name.casefold() == wanted for record in self.objects):
            return self.find(text)  # a name may hold commas
        return list(dict.fromkeys(i for part in text.split(",") for i in self.find(part)))

    def palette(self) -> np.ndarray:
        """Colour of every id, uint8 [65536, 3] RGB: the table's for its objects, the usual one for others."""
        colors = id_palette().copy()
        for record in self.objects:
            colors[record.id] = record.color
        return colors

    def _unknown(self, wanted: str) -> ConfigError:
        names = sorted({record.name for record in self.objects if record.name})
        folded = {name.casefold(): name for name in names}
        near = [folded[name] for name in difflib.get_close_matches(wanted.strip().casefold(), folded, 3, 0.5)]
        if near:
            hint = f"did you mean {' or '.join(near)}?"
        else:
            shown = [record.label() for record in self.objects[:12]]
            rest = len(self.objects) - len(shown)
            hint = f"there are: {', '.join(shown) or 'none'}" + (f" and {rest} more" if rest else "")
        return ConfigError(f"no object {wanted.strip()!r}; {hint}")

    # --- on disk -----------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """For JSON, as `load` reads it."""
        values = asdict(self)
        if self.history is None:
            del values["history"]
        return values

    def save(self, path: str | Path) -> None:
        """Writes the table as JSON, atomically."""
        write_text(path, json.dumps(self.to_dict(), indent=1) + "\n")

    @staticmethod
    def load(path: str | Path) -> ObjectTable:
        """Reads a table.

        Raises:
            FormatError: missing, no JSON, or not as `save` writes it; the message names the object and the field.
        """
        try:
            values = json.loads(read_untrusted_text(path))
            table = pydantic.TypeAdapter(ObjectTable).validate_python(values)
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"]) or "top level"
            raise FormatError(f"{path}: {place}: {first['msg']}, found {first['input']!r:.60}") from None
        except (ValueError, RecursionError) as error:
            raise FormatError(f"{path}: cannot be read: {error}") from None
        twice = [name for name, times in Counter(table.ids()).items() if times > 1]
        if twice:
            raise FormatError(f"{path}: object {twice[0]} is listed twice")
        return table


def object_color(object_id: int) -> tuple[int, int, int]:
    red, green, blue = id_palette()[object_id].tolist()
    return red, green, blue


@dataclass
class _Gathered:
    """What is known of an object so far; the sum of its probabilities is None if the classifier has no class for it."""

    means: list[np.ndarray] = field(default_factory=list)
    opacities: list[np.ndarray] = field(default_factory=list)
    probability: float | None = 0.0

    def confidence(self, count: int) -> float | None:
        """Mean probability over its Gaussians."""
        if self.probability is None or not math.isfinite(self.probability):
            return None
        return min(self.probability / count, 1.0)


def _gather(part: GaussianMap, classifier: IdentityClassifier, gathered: dict[int, _Gathered]) -> int:
    """Adds the labelled Gaussians of a part of a map to their objects; returns how many are not labelled."""
    ids = part.object_id.numpy()
    if len(ids) and not 0 <= ids.min() <= ids.max() < 1 << 16:
        raise InputError(f"object ids must be 0 to 65535, found {ids.min()} to {ids.max()}")
    order = np.argsort(ids, kind="stable")
    present, starts = np.unique(ids[order], return_index=True)
    rows = dict(zip(present.tolist(), np.split(order, starts[1:]), strict=True)) if len(ids) else {}
    unlabelled = len(rows.pop(0, []))
    means, opacities, features = part.means.numpy(), part.opacities.numpy(), part.features.numpy()
    for name, own in rows.items():
        found = gathered.setdefault(name, _Gathered())
        found.means.append(means[own])
        found.opacities.append(opacities[own])
        added = _probability(features[own], name, classifier)
        found.probability = None if added is None or found.probability is None else found.probability + added
    return unlabelled


def _probability(features: np.ndarray, object_id: int, classifier: IdentityClassifier) -> float | None:
    """Sum of the probabilities of an object over identity vectors [M, F]; None if the classifier has no class for
    it."""
    try:
        number = classifier.class_of(object_id)
    except KeyError:
        return None
    step, total = max(1, ClassifierTuning.values_at_once // len(classifier)), 0.0
    for start in range(0, len(features), step):
        total += float(classifier.probabilities(features[start : start + step])[:, number].sum(dtype=np.float64))
    return total
