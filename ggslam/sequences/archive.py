# SPDX-License-Identifier: Apache-2.0
"""Images inside a zip archive, read where they are asked for."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ggslam.errors import SequenceError
from ggslam.system.untrusted_files import FileTuning, open_untrusted
from ggslam.system.zip_files import ZIP_DAMAGE, check_zip, read_member


class Archive:
    """A zip archive; members are read by name. May be used from several threads.

    Attributes:
        path: the file.
        names: of its members.
    """

    def __init__(self, path: Path) -> None:
        """Raises SequenceError if the file is no whole zip archive."""
        self.path = path
        file = open_untrusted(path, SequenceError)
        try:
            self._zip = zipfile.ZipFile(file)
            check_zip(self._zip)
        except ZIP_DAMAGE as error:
            file.close()
            raise SequenceError(f"{path}: not a whole zip archive (truncated?): {error}") from None
        self.names = frozenset(self._zip.namelist())

    def read(self, name: str) -> bytes:
        """Content of a member. Raises SequenceError if it is missing or damaged."""
        try:
            return read_member(self._zip, name, FileTuning.max_image_bytes)
        except KeyError:
            raise SequenceError(f"{self.path}: holds no {name}") from None
        except ZIP_DAMAGE as error:
            raise SequenceError(f"{self.path}, {name}: cannot be read: {error}") from None


@dataclass(frozen=True)
class ArchiveImage:
    """A member of an archive as an image of a recording; see `ImageSource`.

    Attributes:
        archive, member: where it is.
        decode: makes the image of (place for messages, bytes).
    """

    archive: Archive
    member: str
    decode: Callable[[str, bytes], np.ndarray]

    @property
    def name(self) -> str:
        return Path(self.member).name

    @property
    def stem(self) -> str:
        return Path(self.member).stem

    def __str__(self) -> str:
        return f"{self.archive.path}, {self.member}"

    def read(self) -> np.ndarray:
        return self.decode(str(self), self.archive.read(self.member))
