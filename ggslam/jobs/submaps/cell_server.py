# SPDX-License-Identifier: Apache-2.0
"""Several clients send the cells of their stores to one process, which keeps them in one store.

A cell is written whole or not at all, and acknowledged when it is on the disk: a client that dies leaves whole cells,
and one that talks nonsense is refused and leaves nothing (`cell_checks`). A cell that the store has is taken as a later
visit's is: if it was recorded longer than T (`SubmapSettings.refresh`) after the one that is there, or goes on with the
same visit and was not recorded before. It takes the old one's place, as cells of runs and clouds do; a recording that
is added here keeps what it did not look at.
What stores know of runs and objects (`visits/`, `objects.json`) is not sent.
"""

from __future__ import annotations

import hmac
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ggslam.errors import ConfigError, GgslamError, RunFolderError
from ggslam.jobs.submaps.cell_checks import check_cell
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
    hello_s = 3.0
    """Seconds in which a client has to tell the token. It does so unasked, before anybody listens to it."""
    idle_s = 600.0
    """Longest silence between two cells, in seconds: a robot stands still."""
    stop_s = 1.0
    """Seconds that clients are given to be told that the server ends."""


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
        listener: of `listen`; it is closed at the end.
        token: that clients have to tell.
        tell: is given a line for people about every client.
    """

    def __init__(
        self, store: GridStore, listener: socket.socket, token: str, tell: Callable[[str], None] = lambda text: None
    ) -> None:
        self._store, self._token, self._tell = store, token, tell
        self._writing, self._stop = threading.Lock(), threading.Event()
        self._free = threading.Semaphore(CellServerTuning.clients)
        self._threads: list[threading.Thread] = []
        self._connections: set[socket.socket] = set()
        self._listener = listener
        self._listener.settimeout(0.2)
        self.address: tuple[str, int] = self._listener.getsockname()[:2]

    def __enter__(self) -> CellServer:
        self._accepting = self._begin(self._accept)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._accepting.join()
        self._listener.close()
        until = time.monotonic() + CellServerTuning.stop_s
        for how in (socket.SHUT_RD, socket.SHUT_RDWR):  # first nothing is read any more, then nothing is sent either
            for connection in list(self._connections):
                with suppress(OSError):
                    connection.shutdown(how)
            for thread in self._threads:
                thread.join(max(until - time.monotonic(), 0))
        for thread in self._threads:  # one may still be writing a cell
            thread.join()

    def _begin(self, target: Callable[[], None]) -> threading.Thread:
        thread = threading.Thread(target=target, name="cells", daemon=True)
        self._threads = [one for one in self._threads if one.is_alive()] + [thread]
        thread.start()
        return thread

    def _accept(self) -> None:
        while not self._stop.is_set():
            if not self._free.acquire(timeout=0.2):
                continue
            try:
                connection, address = self._listener.accept()
            except OSError:  # nobody came
                self._free.release()
                continue
            self._connections.add(connection)
            name = shown_address(*address[:2])
            self._begin(lambda connection=connection, name=name: self._serve(connection, name))  # type: ignore[misc]

    def _serve(self, connection: socket.socket, name: str) -> None:
        """One client, to its end."""
        sent = Sent()
        try:
            with connection:
                try:
                    self._take_all(connection, sent)
                    end = "done"
                except Exception as error:  # whatever it sent, others are served on
                    if isinstance(error, OSError) and not self._stop.is_set():
                        raise
                    end, reason, code = self._refusal(error)
                    send_text(connection, Kind.REFUSED, {"reason": reason[:1000], "exit_code": code})
        except OSError as error:
            end = f"lost: {error}"
        finally:
            self._connections.discard(connection)
            self._free.release()
        self._tell(f"{name}: {quantity(sent.written, 'cell')} written, {sent.kept} kept, {sent.bytes} bytes; {end}")

    def _refusal(self, error: Exception) -> tuple[str, str, int]:
        """A line for people here, what a client is told, and whose fault it is (`GgslamError.exit_code`)."""
        if self._stop.is_set():
            return "the server ends", "the server ends", 1
        return f"refused: {error}", str(error), error.exit_code if isinstance(error, GgslamError) else 1

    def _take_all(self, connection: socket.socket, sent: Sent) -> None:
        limit = CellServerTuning.hello_s
        self._check_hello(receive_message(connection, [Kind.HELLO], in_all_s=limit, stop=self._stop))
        send_text(connection, Kind.OK, {})
        while True:
            message = receive_message(connection, [Kind.CELL], CellServerTuning.idle_s, stop=self._stop)
            if self._stop.is_set():
                raise RunFolderError("the server ends")
            if message is None:
                return
            body = message[1]
            write, visit = cell_of_body(body)
            written = self._take(write, visit)
            sent.bytes += len(body)
            sent.written, sent.kept = sent.written + written, sent.kept + (not written)
            send_text(connection, Kind.OK, {"written": written})

    def _check_hello(self, message: tuple[Kind, bytes] | None) -> None:
        """Raises ConfigError if the token or the grid is another one."""
        if message is None:
            raise ConnectionError("the client said nothing")
        values, settings = read_text(message[1]), self._store.settings
        if not hmac.compare_digest(str(values.get("token")).encode(), self._token.encode()):
            raise ConfigError("the token is another one")
        own = {"spacing": settings.spacing, "axes": settings.axes}
        theirs = {name: values.get(name) for name in own}
        if own != theirs:
            raise ConfigError(f"the server's cells are {own}, the client's {theirs}")

    def _take(self, write: CellWrite, visit: str) -> bool:
        """Writes a cell if it is due; whether it was."""
        check_cell(write, self._store.settings)
        with self._writing:
            if not self._is_due(write, visit):
                return False
            self._store.begin_visit(visit)
            self._store.put_cells([write])
        return True

    def _is_due(self, write: CellWrite, visit: str) -> bool:
        if write.key not in self._store:
            return True
        there, at = self._store.cell(write.key), write.recorded_at
        if there.visit != visit:
            return at is not None and self._store.due(write.key, at)
        return there.recorded_at is None or (at is not None and at >= there.recorded_at)


def listen(host: str, port: int) -> socket.socket:
    """A socket for `CellServer`; port 0: any free one, see `CellServer.address`.

    Raises:
        ConfigError: one cannot listen there.
    """
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except (OSError, OverflowError, UnicodeError) as error:
        raise ConfigError(f"cannot listen at {shown_address(host, port)}: {error}") from None


def send_store(path: Path, host: str, port: int, token: str) -> Sent:
    """Sends all cells of a store in the order in which they were written, and waits for each until it is kept. While
    another process records into the store, goes on with cells as they are finished.

    Raises:
        ConfigError: nobody listens there, the server refuses, or the connection breaks; what it acknowledged it has.
        FormatError: the store is damaged.
    """
    sent, accepted = Sent(), False
    with GridStore.open(path) as store:
        try:
            with socket.create_connection((host, port), MessageTuning.timeout_s) as connection:
                settings = store.settings
                hello = {"token": token, "spacing": settings.spacing, "axes": settings.axes}
                send_text(connection, Kind.HELLO, hello)
                _answer(connection)
                accepted = True
                for write, visit in _cells_as_they_end(store):
                    body = cell_to_body(write, visit)
                    send_message(connection, Kind.CELL, body)
                    written = bool(_answer(connection).get("written"))
                    sent.bytes += len(body)
                    sent.written, sent.kept = sent.written + written, sent.kept + (not written)
        except (OSError, OverflowError, UnicodeError, ConfigError) as error:
            before = f"; {quantity(sent.written, 'cell')} written before" if accepted else ""
            failure = ConfigError(f"{shown_address(host, port)}: {error}{before}")
            if accepted:  # by a server that was there, and has gone, or says whose fault it is
                failure.exit_code = error.exit_code if isinstance(error, ConfigError) else 1
            raise failure from None
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
    message = receive_message(connection, [Kind.OK, Kind.REFUSED])
    if message is None:
        raise ConnectionError("the server ended the connection")
    kind, values = message[0], read_text(message[1])
    if kind is not Kind.OK:
        refusal = ConfigError(f"the server refuses: {values.get('reason')}")
        refusal.exit_code = 1 if values.get("exit_code") == 1 else 2
        raise refusal
    return values


def address_of(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, of [HOST]:PORT where the host has colons, or of PORT on this machine.

    Raises:
        ConfigError: it is neither.
    """
    host, _, port = text.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    host = host[1:-1] if bracketed else host
    if not port.isdecimal() or not port.isascii() or int(port) > 65535 or (":" in host) != bracketed:
        raise ConfigError(f"expected HOST:PORT, or [HOST]:PORT for IPv6, found {text!r}")
    return host or "127.0.0.1", int(port)


def shown_address(host: str, port: int) -> str:
    """What `address_of` reads."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
