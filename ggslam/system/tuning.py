# SPDX-License-Identifier: Apache-2.0
"""Numbers that somebody chose and that no settings reach, each with a sentence and a unit, beside the code they steer.

    class FocalTuning(Tuning):
        \"\"\"When a focal length is doubted.\"\"\"

        min_matches = 40
        \"\"\"Fewest matched features that an estimate is made from.\"\"\"

    if len(matches) < FocalTuning.min_matches: ...

A number that a file format, a standard or a unit gives is not tuning: it is a constant `NAME: Final = 26`.
Numbers that a user may set are fields of settings (`ggslam.system.settings`).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class _Frozen(type):
    """Refuses to assign and delete attributes of a class."""

    def __setattr__(cls, name: str, value: object) -> None:
        raise AttributeError(f"{cls.__name__}.{name} is fixed; overridden() changes it for the length of a block")

    def __delattr__(cls, name: str) -> None:
        raise AttributeError(f"{cls.__name__}.{name} is fixed")


class Tuning(metaclass=_Frozen):
    """Base of the classes that hold such numbers. They are read from the class, which cannot be changed."""


@contextmanager
def overridden(kind: type[Tuning], **values: Any) -> Iterator[None]:
    """Gives fields of a tuning class other values inside a `with` block: for tests and for measuring sensitivity.

    Values that were read when a module was loaded, such as defaults of arguments, keep the old value.

    Raises:
        AttributeError: the class has no field of this name.
    """
    before = {name: getattr(kind, name) for name in values}
    try:
        for name, value in values.items():
            type.__setattr__(kind, name, value)
        yield
    finally:
        for name, value in before.items():
            type.__setattr__(kind, name, value)
