# SPDX-License-Identifier: Apache-2.0
"""Messages of a ROS 1 or ROS 2 bag, read one at a time where they are asked for."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ggslam.errors import GgslamError, MissingDependency, SequenceError
from ggslam.system.untrusted_files import open_untrusted, refuse_links

NO_MESSAGE = "there is none"
ZSTD_START = b"\x28\xb5\x2f\xfd"
"""First bytes of what zstd compressed."""


def short_type(kind: str) -> str:
    """A type as ROS 1 names it: `sensor_msgs/Image` of `sensor_msgs/msg/Image`."""
    return kind.replace("/msg/", "/")


def cdr_stamp(head: bytes) -> float:
    """Time in the header of a ROS 2 message, seconds, by its first 12 bytes."""
    seconds, nanoseconds = struct.unpack("<iI" if head[1] & 1 else ">iI", head[4:12])
    return float(seconds + 1e-9 * nanoseconds)


class Bag:
    """A bag, open for as long as this object lives. May be used from several threads.

    Attributes:
        path: the file, or the folder of a ROS 2 bag.
        types: topic -> name of its messages' type, without /msg/.
    """

    def __init__(self, path: Path) -> None:
        """Raises MissingDependency without the package rosbags, SequenceError if the bag is damaged."""
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingDependency(f"reading ROS bags needs rosbags: pip install 'ggslam[ros]' ({error})") from None
        if path.suffix.lower() == ".zstd":
            raise SequenceError(f"{path}: a compressed file of a bag cannot be read alone: open the bag's folder")
        if path.is_dir():
            refuse_links(path, SequenceError, links=True)
        else:
            open_untrusted(path, SequenceError).close()
        self.path = path
        self._lock = threading.RLock()
        self._cursors: dict[str, tuple[int, Iterator[Any]]] = {}
        self._logged: dict[str, list[int]] = {}
        try:
            # Old ROS 2 bags do not carry the definitions of their messages.
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        except Exception as error:  # the package raises many types, and takes what memory a damaged bag claims
            raise SequenceError(f"{path}: not a whole bag (truncated, or not indexed?): {_text(error)}") from None
        if path.is_file() and self._reader.is2:
            self._check_uncompressed()
        self.types = {c.topic: short_type(c.msgtype) for c in self._reader.connections}

    def _check_uncompressed(self) -> None:
        """Of one file of a bag nothing tells that each message is compressed."""
        with _errors_of_damage(str(self.path)):
            first = next(iter(self._reader.messages()), None)
        if first is not None and bytes(first[2][:4]) == ZSTD_START:
            raise SequenceError(
                f"{self.path}: its messages are compressed, as metadata.yaml must say: open the bag's folder"
            )

    def stamps(self, topic: str) -> np.ndarray:
        """Times in the headers of a topic's messages, float64 [n], seconds, in the order of the bag.

        Raises:
            SequenceError: the bag is damaged.
        """
        stamps, logged = [], []
        with self._lock, _errors_of_damage(f"{self.path}, {topic}"):
            for _, time, raw in self._read(topic):
                stamps.append(self._stamp(raw))
                logged.append(time)
        self._logged[topic] = logged
        return np.array(stamps)

    def log_times(self, topic: str) -> np.ndarray:
        """Times at which a topic's messages were recorded, float64 [n], seconds, in the order of the bag.

        Raises:
            SequenceError: the bag is damaged.
        """
        if topic not in self._logged:
            self.stamps(topic)
        return np.array(self._logged[topic], np.int64) * 1e-9

    def message(self, topic: str, number: int) -> Any:
        """Message `number` of a topic, in the order of the bag. Reading them in order is quick.

        Raises:
            SequenceError: there is none, or the bag is damaged.
        """
        place = f"{self.path}, {topic}, message {number}"
        with self._lock, _errors_of_damage(place):
            at, cursor = self._cursors.pop(topic, (-1, iter(())))
            if at != number:
                at, cursor = self._seek(topic, number)
            for _, _, raw in cursor:
                at += 1
                if at > number:
                    self._cursors[topic] = (at, cursor)
                    return self._reader.deserialize(raw, self._type(topic))
        raise SequenceError(f"{place}: {NO_MESSAGE}")

    def messages(self, topic: str) -> list[Any]:
        """All messages of a topic of small ones. Raises SequenceError if the bag is damaged."""
        with self._lock, _errors_of_damage(f"{self.path}, {topic}"):
            return [self._reader.deserialize(raw, self._type(topic)) for _, _, raw in self._read(topic)]

    def _seek(self, topic: str, number: int) -> tuple[int, Iterator[Any]]:
        """Number of the first message that a new cursor will give, and the cursor, at or before `number`."""
        logged = self._logged.get(topic, [])
        if number >= len(logged) or logged != sorted(logged):
            return 0, self._read(topic)
        return logged.index(logged[number]), self._read(topic, logged[number])

    def _read(self, topic: str, start: int | None = None) -> Iterator[Any]:
        chosen = [c for c in self._reader.connections if c.topic == topic]
        return iter(self._reader.messages(connections=chosen, start=start))

    def _type(self, topic: str) -> str:
        return next(c.msgtype for c in self._reader.connections if c.topic == topic)

    def _stamp(self, raw: Any) -> float:
        """Only the header is looked at: images are large."""
        head = bytes(raw[:12])
        if self._reader.is2:
            return cdr_stamp(head)
        _, seconds, nanoseconds = struct.unpack("<III", head)
        return float(seconds + 1e-9 * nanoseconds)


class _errors_of_damage:
    """Turns any error inside a damaged bag into one SequenceError."""

    def __init__(self, place: str) -> None:
        self._place = place

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Exception) and not isinstance(error, GgslamError):
            raise SequenceError(f"{self._place}: bag is damaged: {_text(error)}") from None


def _text(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@dataclass(frozen=True)
class BagImage:
    """An image message as an image of a recording; see `ImageSource`.

    Attributes:
        bag, topic, number: where it is.
        stamp: seconds.
        decode: makes the image of (place for messages, message).
    """

    bag: Bag
    topic: str
    number: int
    stamp: float
    decode: Callable[[str, Any], np.ndarray]

    @property
    def stem(self) -> str:
        return f"{self.stamp:.6f}"

    @property
    def name(self) -> str:
        return f"{self.stem}.png"

    def __str__(self) -> str:
        return f"{self.bag.path}, {self.topic}, message {self.number}"

    def read(self) -> np.ndarray:
        return self.decode(str(self), self.bag.message(self.topic, self.number))
