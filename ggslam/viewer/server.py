# SPDX-License-Identifier: Apache-2.0
"""The web server of the viewer (viser, optional extra `viewer`)."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from ggslam.errors import ConfigError, MissingDependency
from ggslam.scene.camera import Camera
from ggslam.system.tuning import Tuning
from ggslam.viewer.access import Gate, guard
from ggslam.viewer.cameras import fitting_fov

if TYPE_CHECKING:
    import viser

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT: Final = 8080
"""Port of `--port` if it is left out."""


class PanelTuning(Tuning):
    """How the panel is laid out."""

    width = 384
    """Width of the panel, in pixels."""


def open_server(host: str = DEFAULT_HOST, port: int = DEFAULT_PORT, title: str = "ggslam") -> viser.ViserServer:
    """Serves an empty page.

    Args:
        host: address to listen at; with the default nobody but this machine can connect.
        port: to listen at; 0: any free one.
        title: above the controls.

    Raises:
        MissingDependency: viser is not installed.
        ConfigError: the address cannot be listened at.
    """
    try:
        import viser
    except ImportError as error:
        text = f"to look at maps in a browser the package viser is needed: `pip install 'ggslam[viewer]'` ({error})"
        raise MissingDependency(text) from None
    _check_free(host, port)

    gate = Gate(host)

    class LocalServer(viser.ViserServer):
        """A server that lets in who has the printed address, and never hands the page to an outside service."""

        token = gate.token

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    with _quiet(), guard(gate):
        server = LocalServer(host=host, port=port, label=title, verbose=False)
    clear_page(server, title)
    return server


def clear_page(server: viser.ViserServer, title: str = "ggslam") -> None:
    """Takes everything off the page but its looks and its title."""
    server.scene.reset()
    server.gui.reset()
    server.gui.set_panel_label(title)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(64, 130, 230))
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(PanelTuning.width)
    server.scene.world_axes.visible = False


def keep_fitting(server: viser.ViserServer, camera: Camera) -> None:
    """Pages of any shape show all that a camera sees, also after a window changed its size."""

    def fit(view: viser.CameraHandle) -> None:
        view.fov = fitting_fov(camera, view.aspect)

    @server.on_client_connect
    def on_connect(client: viser.ClientHandle) -> None:
        client.camera.on_update(fit)
        fit(client.camera)


def close_server(server: viser.ViserServer) -> None:
    """Ends it; browsers see that the connection is lost."""
    with _quiet():
        server.stop()


def address(server: viser.ViserServer) -> str:
    """Where a browser finds it, with the token that lets it in."""
    host = server.get_host()
    name = "localhost" if host in ("127.0.0.1", "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    token = getattr(server, "token", None)
    return f"http://{name}:{server.get_port()}" + (f"/?token={token}" if token else "")


def _check_free(host: str, port: int) -> None:
    """viser would silently take another port.

    Raises:
        ConfigError: another program listens there, or the address is not this machine's.
    """
    if not 0 <= port <= 65535:
        raise ConfigError(f"`port`: expected 0 to 65535, found {port}")
    try:
        kind = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(kind[0], kind[1]) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(kind[4])
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        argument = "port" if getattr(error, "errno", None) in (errno.EADDRINUSE, errno.EACCES) else "host"
        raise ConfigError(f"{host}:{port}: cannot be listened at: {reason}; choose another with `{argument}`") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """What viser prints about itself is not shown: the caller says what matters."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
