# SPDX-License-Identifier: Apache-2.0
"""What the records of a run have in common: reading with checks, writing, numbers that may be missing."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import pydantic

from ggslam.errors import RunFolderError
from ggslam.system.json_files import json_ready, read_json, write_json

if TYPE_CHECKING:
    from typing_extensions import Self


def _number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= sys.float_info.max:
        raise ValueError("expected a finite number")
    return value  # an int stays one: files are written as they were read


def _number_or_none(value: Any) -> Any:
    return None if value is None else _number(value)


def _array(value: Any) -> np.ndarray:
    try:
        return np.array(value, float)  # null becomes NaN
    except (TypeError, ValueError, OverflowError):
        raise ValueError("expected a matrix of numbers") from None


Number = Annotated[float, pydantic.PlainValidator(_number)]
"""A finite number."""
NumberOrNone = Annotated[float | None, pydantic.PlainValidator(_number_or_none)]
"""The same, None where the file says null: of what was not measured, or was NaN or infinite."""
Array = Annotated[np.ndarray, pydantic.PlainValidator(_array)]
"""float64 of any shape, NaN where the file says null."""


class Record(pydantic.BaseModel):
    """A JSON object with named fields, or a part of one."""

    model_config = pydantic.ConfigDict(frozen=True, extra="allow", arbitrary_types_allowed=True)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """From values that may be numpy's; NaN and infinity become None. Raises pydantic.ValidationError."""
        return cls.model_validate(json_ready(dict(values)))

    def values(self) -> dict[str, Any]:
        """For a JSON file: the fields that were given, in order."""
        return json_ready(self.model_dump(exclude_unset=True))

    def number(self, *keys: str) -> float | None:
        """The number that fields of these names lead to; None if there is none."""
        value: Any = self
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else getattr(value, key, None)
        return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None


class RecordFile(Record):
    """A record that is a file of its own in a run's folder, of the name `FILE`."""

    FILE: ClassVar[str]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Reads it from a run's folder.

        Raises:
            RunFolderError: it is missing or damaged; the message names file, field and what was found.
        """
        path = Path(folder) / cls.FILE
        try:
            return cls.model_validate(read_json(path))
        except pydantic.ValidationError as error:
            raise RunFolderError(f"{path}: {explain(error)}") from None

    @classmethod
    def read_if_there(cls, folder: Path) -> Self | None:
        """Reads it; None if there is no such file. Raises as `read`."""
        return cls.read(folder) if (Path(folder) / cls.FILE).is_file() else None

    def write(self, folder: Path) -> Path:
        """Writes it into a run's folder; returns the path of the file.

        Raises:
            RunFolderError: it cannot be written, or there is a link in its place.
        """
        return write_json(Path(folder) / self.FILE, self.values(), follow=False)


def explain(error: pydantic.ValidationError) -> str:
    """The first thing that is wrong, in a line: field, what was expected, what was found."""
    first = error.errors(include_url=False)[0]
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    if first["type"] == "missing":
        return f"not as ggslam writes it: {place} is missing"
    if first["type"] == "model_type":
        text = "expected an object"
    else:
        text = str(first["msg"]).removeprefix("Value error, ")
        text = text[:1].lower() + text[1:]
    return f"not as ggslam writes it: {f'{place}: ' if place else ''}{text}, found {first['input']!r:.60}"
