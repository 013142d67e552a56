# SPDX-License-Identifier: Apache-2.0
"""Several clients send the cells of their stores to one process, which keeps them in one store.

A cell is written whole or not at all, and acknowledged when it is on the disk: a client that dies leaves whole cells,
and one that talks nonsense is refused and leaves nothing. A cell that the store has is taken as a later visit's is: if
it was recorded longer than T (`SubmapSettings.refresh`) after the one that is there, or goes on with the same visit. It
takes the old one's place, as cells of runs and clouds do; a recording that is added here keeps what it did not look at.
What stores know of runs and objects (`visits/`, `objects.json`) is not sent.
"""

from __future__ import annotations

import hmac
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import ConfigError, FormatError, RunFolderError
from ggslam.jobs.submaps.cell_gaussians import GAUSSIANS, gaussians_from_bytes
from ggslam.submaps.cell_messages import (
    Kind,
    MessageTuning,
    cell_of_body,
    cell_to_body,
    read_text,
    receive_message,
    send_message,
    send_text,
)
from ggslam.submaps.cell_points import POINTS, decode_points
from ggslam.submaps.cell_records import CellWrite
from ggslam.submaps.grid import GridStore, is_being_written
from ggslam.system.plurals import quantity
from ggslam.system.tuning import Tuning


class CellServerTuning(Tuning):
    """How cells are sent and taken."""

    clients = 16
    """Most connections at once; others wait."""
    look_every_s = 0.5
    """Seconds between two looks at a store that is being written."""


@dataclass
class Sent:
    """What a client sent: cells that were written, cells that the store has newer already, bytes on the way."""

    written: int = 0
    kept: int = 0
    bytes: int = 0


class CellServer:
    """Takes cells from clients, each in a thread, from `start` until `stop`.

    Args:
        store: open for writing.
        host, port: to listen at; port 0: any free one, see `address`.
        token: that clients have to tell.
        tell: is given a line for people about every client.

    Raises:
        ConfigError: one cannot listen there.
    """

    def __init__(
        self, store: GridStore, host: str, port: int, token: str, tell: Callable[[str], None] = lambda text: None
    ) -> None:
        self._store, self._token, self._tell = store, token, tell
        self._writing, self._stop = threading.Lock(), threading.Event()
        self._free = threading.Semaphore(CellServerTuning.clients)
        self._threads: list[threading.Thread] = []
        try:
            self._listener = socket.create_server((host, port))
        except (OSError, OverflowError) as error:
            raise ConfigError(f"cannot listen at {host}:{port}: {error}") from None
        self._listener.settimeout(0.2)
        self.address: tuple[str, int] = self._listener.getsockname()[:2]

    def __enter__(self) -> CellServer:
        self._begin(self._accept)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._listener.close()

    def _begin(self, target: Callable[[], None]) -> None:
        thread = threading.Thread(target=target, name="cells", daemon=True)
        self._threads = [one for one in self._threads if one.is_alive()] + [thread]
        thread.start()

    def _accept(self) -> None:
        while not self._stop.is_set():
            if not self._free.acquire(timeout=0.2):
                continue
            try:
                connection, address = self._listener.accept()
            except OSError:  # nobody came
                self._free.release()
                continue
            connection.settimeout(MessageTuning.timeout_s)
            name = f"{address[0]}:{address[1]}"
            self._begin(lambda connection=connection, name=name: self._serve(connection, name))  # type: ignore[misc]

    def _serve(self, connection: socket.socket, name: str) -> None:
        """One client, to its end."""
        sent = Sent()
        try:
            with connection:
                try:
                    self._take_all(connection, sent)
                    end = "done"
                except OSError:
                    raise
                except Exception as error:  # whatever it sent, others are served on
                    end = f"refused: {error}"
                    send_text(connection, Kind.REFUSED, {"reason": str(error)[:1000]})
        except OSError as error:
            end = f"lost: {error}"
        finally:
            self._free.release()
        self._tell(f"{name}: {quantity(sent.written, 'cell')} written, {sent.kept} kept, {sent.bytes} bytes; {end}")

    def _take_all(self, connection: socket.socket, sent: Sent) -> None:
        self._check_hello(receive_message(connection))
        send_text(connection, Kind.OK, {})
        while not self._stop.is_set():
            message = receive_message(connection)
            if message is None:
                return
            kind, body = message
            if kind is not Kind.CELL:
                raise FormatError(f"expected a cell, found {kind.name}")
            write, visit = cell_of_body(body)
            written = self._take(write, visit)
            sent.bytes += len(body)
            sent.written, sent.kept = sent.written + written, sent.kept + (not written)
            send_text(connection, Kind.OK, {"written": written})
        raise RunFolderError("the server ends")

    def _check_hello(self, message: tuple[Kind, bytes] | None) -> None:
        """Raises ConfigError if the token or the grid is another one."""
        if message is None or message[0] is not Kind.HELLO:
            raise FormatError("expected HELLO first")
        values, settings = read_text(message[1]), self._store.settings
        if not hmac.compare_digest(str(values.get("token")).encode(), self._token.encode()):
            raise ConfigError("the token is another one")
        own = {"spacing": settings.spacing, "axes": settings.axes}
        theirs = {name: values.get(name) for name in own}
        if own != theirs:
            raise ConfigError(f"the server's cells are {own}, the client's {theirs}")

    def _take(self, write: CellWrite, visit: str) -> bool:
        """Writes a cell if it is due; whether it was."""
        what = f"cell {write.key}"
        if POINTS in write.parts:
            decode_points(write.parts[POINTS], what)
        if GAUSSIANS in write.parts:
            gaussians_from_bytes(write.parts[GAUSSIANS], what)
        with self._writing:
            store = self._store
            is_others = write.key in store and store.cell(write.key).visit != visit
            if is_others and (write.recorded_at is None or not store.due(write.key, write.recorded_at)):
                return False
            store.begin_visit(visit)
            store.put_cells([write])
        return True


def send_store(path: Path, host: str, port: int, token: str) -> Sent:
    """Sends all cells of a store in the order in which they were written, and waits for each until it is kept. While
    another process records into the store, goes on with cells as they are finished.

    Raises:
        ConfigError: nobody listens there, the server refuses, or the connection breaks; what it acknowledged it has.
        FormatError: the store is damaged.
    """
    sent = Sent()
    with GridStore.open(path) as store:
        try:
            with socket.create_connection((host, port), MessageTuning.timeout_s) as connection:
                settings = store.settings
                hello = {"token": token, "spacing": settings.spacing, "axes": settings.axes}
                send_text(connection, Kind.HELLO, hello)
                _answer(connection)
                for write, visit in _cells_as_they_end(store):
                    body = cell_to_body(write, visit)
                    send_message(connection, Kind.CELL, body)
                    written = bool(_answer(connection).get("written"))
                    sent.bytes += len(body)
                    sent.written, sent.kept = sent.written + written, sent.kept + (not written)
        except (OSError, OverflowError) as error:
            raise ConfigError(f"{host}:{port}: {error}; {quantity(sent.written, 'cell')} written before") from None
    return sent


def _cells_as_they_end(store: GridStore) -> Iterator[tuple[CellWrite, str]]:
    """Cells of a store and their visits, in the order of their versions, until nobody writes to it any more."""
    last, grows = 0, True
    while grows:
        grows = is_being_written(store.path)  # before looking: what is written until then is seen
        records = sorted((store.cell(key) for key in store.cells()), key=lambda record: record.version)
        for record in records:
            if record.version <= last:
                continue
            last = record.version
            try:
                parts = {name: store.get(record.key, name) for name in record.parts}
                if store.cell(record.key) != record:
                    continue  # written anew meanwhile: it comes with its next version
            except KeyError:
                continue  # removed meanwhile
            counts = {name: part.count for name, part in record.parts.items()}
            yield CellWrite(record.key, parts, record.recorded_at, counts), record.visit or store.path.name
        if grows:
            time.sleep(CellServerTuning.look_every_s)


def _answer(connection: socket.socket) -> dict[str, object]:
    message = receive_message(connection)
    if message is None:
        raise ConnectionError("the server ended the connection")
    kind, values = message[0], read_text(message[1])
    if kind is not Kind.OK:
        raise ConfigError(f"the server refuses: {values.get('reason')}")
    return values


def address_of(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, or PORT on this machine.

    Raises:
        ConfigError: it is neither.
    """
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"expected HOST:PORT, found {text!r}")
    return host or "127.0.0.1", int(port)
