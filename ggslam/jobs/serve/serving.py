# SPDX-License-Identifier: Apache-2.0
"""Serves a finished run: publishes it, and answers what is asked. What `ggslam serve` does, usable from Python."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ggslam.jobs.serve.http_face import serve_functions
from ggslam.jobs.serve.outlets import HTTP_PORT, Opened, PublishRequest, open_outlets
from ggslam.jobs.serve.publishing import MapPublisher
from ggslam.jobs.serve.ros_face import RosFace
from ggslam.jobs.serve.run_contents import RunContents, ServedRun
from ggslam.jobs.serve.run_functions import RunFunctions
from ggslam.jobs.serve.run_volumes import RunVolumes
from ggslam.jobs.serve.services import MapServices
from ggslam.runs.folder import RunFolder
from ggslam.system.tuning import Tuning
from ggslam.viewer.page_server import DEFAULT_HOST, PageServer


class ServingTuning(Tuning):
    """How files are written."""

    make_s = 3600.0
    """Longest time, in seconds, that making what a file gets may take."""


@dataclass(frozen=True)
class ServeRequest:
    """A run to serve.

    Attributes:
        publish: through what.
        host, port: of the HTTP face; port None: there is none.
        robots: that grids are made for, see `RunVolumes`.
        changes: folder of changes, see `RunContents`.
    """

    publish: PublishRequest
    host: str = DEFAULT_HOST
    port: int | None = HTTP_PORT
    robots: Sequence[str] = ()
    changes: Path | None = None


@dataclass
class Serving:
    """A run that is served.

    Attributes:
        publisher: of its contents.
        services: that answer.
        lines: for people: where it is found.
        http: the HTTP face, if there is one.
    """

    publisher: MapPublisher
    services: MapServices
    lines: list[str] = field(default_factory=list)
    http: PageServer | None = None
    _served: ServedRun | None = None

    def problems(self) -> dict[str, str]:
        """Why channels have no content, by their names."""
        return {} if self._served is None else self._served.contents.problems

    def finish_files(self) -> None:
        """Waits until all that was asked for is made and sent; where only files listen, that is all."""
        if self._served is not None:
            self._served.wait_made(ServingTuning.make_s)
        self.publisher.wait_idle(ServingTuning.make_s)


@contextmanager
def serve_map(folder: RunFolder, request: ServeRequest) -> Iterator[Serving]:
    """Serves a run until the block is left.

    Raises:
        GgslamError: the run is damaged, a package is missing, or an address is taken.
    """
    with ExitStack() as opened:
        volumes = RunVolumes(folder, request.robots)
        opened.callback(volumes.close)
        contents = RunContents(folder, volumes, request.changes)
        outlets = opened.enter_context(open_outlets(request.publish))
        publisher = MapPublisher(outlets.outlets, contents.channels())
        opened.callback(publisher.close)
        functions = RunFunctions(contents, publisher)
        opened.callback(functions.close)
        services = MapServices(functions.functions(), functions.locate)
        serving = Serving(publisher, services, list(outlets.lines))
        offer_faces(serving, outlets, request, opened)
        serving._served = ServedRun(contents, publisher)
        opened.callback(serving._served.close)
        yield serving


def offer_faces(serving: Serving, outlets: Opened, request: ServeRequest, opened: ExitStack) -> None:
    """Offers functions over ROS 2, if it was opened, and over HTTP."""
    if outlets.node is not None and outlets.types is not None:
        RosFace(outlets.node, outlets.types, serving.services)
        serving.lines.append(f"ros2: services ggslam/... ({', '.join(serving.services.names)})")
    if request.port is not None:
        serving.http = serve_functions(serving.services, request.host, request.port)
        opened.callback(serving.http.close)
        serving.lines.append(f"http: {serving.http.address}")
