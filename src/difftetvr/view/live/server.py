"""The server of the pages: it takes cameras from browsers to the studio, and pictures back."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import logging
import socket
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from difftetvr.errors import DiffTetError
from difftetvr.fitting.loop import one_torch_thread
from difftetvr.view.live.panels.desk import Desk
from difftetvr.view.live.panels.function import FunctionPanel
from difftetvr.view.live.panels.path import PathPanel
from difftetvr.view.live.panels.save import SavePanel
from difftetvr.view.live.panels.show import ClipPanel, ShowPanel
from difftetvr.view.live.panels.views import ViewsPanel
from difftetvr.view.live.placement import Placement
from difftetvr.view.live.quantities import Painted
from difftetvr.view.live.scene import Scene
from difftetvr.view.live.studio import Studio, Window

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, ViserServer

LOCALHOST = "127.0.0.1"
PORT = 8080

_PORTS_TRIED = 100
_NEAR, _FAR = 1e-3, 1e3  # of the browser's own things, in the size of the scene
_MOVING_QUALITY, _STILL_QUALITY = 80, 95  # of JPEG
_WAIT_SECONDS = 0.2  # between looks at whether to stop
_EVERYONE = ("0.0.0.0", "::", "")
_REFUSED = 1008  # code of the protocol: against the rules of who is called
_OWN = (LOCALHOST, "localhost", "::1")


@dataclass(frozen=True)
class Listening:
    """Where to listen, and where files may be written.

    Attributes:
        folder: The one folder that is written to.
        host: Address to listen at; the default is that of this machine, which no other one can reach.
        port: Port; None: 8080, or the next one that is free.
    """

    folder: Path
    host: str = LOCALHOST
    port: int | None = None


class LiveServer:
    """Shows a scene in browsers, as long as the ``with`` block lasts.

    Args:
        scene: What to show.
        listening: Where to listen.

    Raises:
        DiffTetError: The package that serves the pages is not installed, or the address is taken or not this machine's.
    """

    def __init__(self, scene: Scene, listening: Listening) -> None:
        port = require_free(listening.host, listening.port)
        self._server = _serving(listening.host, port)
        self._listening = listening
        self.studio = Studio(scene, self._complain)
        self.desk = Desk(self._server, self.studio, Placement.of(scene.bounds), listening.folder)
        self._show_panel: ShowPanel | None = None
        self._windows: dict[int, Window] = {}
        try:
            self._furnish(scene)
            self._server.on_client_connect(self._welcome)
            self._server.on_client_disconnect(self._part)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> LiveServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stops serving."""
        with _silent():
            self._server.stop()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        host = "localhost" if self._listening.host in _EVERYONE else self._listening.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"

    @property
    def announcement(self) -> str:
        """Where it is to be seen, and by whom, in a sentence."""
        if self._listening.host in _OWN:
            return f"Open {self.address} in a browser; only this machine can reach it."
        return (
            f"Open {self.address} in a browser, or port {self._server.get_port()} of this machine from another one: "
            f"anyone in its network can, and can write files to {self._listening.folder}."
        )

    @property
    def is_watched(self) -> bool:
        """Whether anybody looks."""
        return bool(self._windows)

    def window_of(self, client: ClientHandle) -> Window:
        """What a client looks through."""
        return self._windows[client.client_id]

    def serve(self, is_over: Callable[[], bool] = lambda: False) -> None:
        """Draws for all who look, until something is over, or an interrupt.

        Args:
            is_over: Whether it is.
        """
        with one_torch_thread():
            while not is_over():
                self.studio.work(_WAIT_SECONDS)

    def _complain(self, sentence: str) -> None:
        self.desk.complain(sentence)

    def _furnish(self, scene: Scene) -> None:
        """Sets up what all windows have in common."""
        server, start = self._server, scene.start
        server.gui.set_panel_label(scene.title)
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.scene.set_up_direction(scene.up)
        _, position = self.desk.placement.pose(start)
        forward = start.world_to_camera[2, :3].detach().cpu().double().numpy()
        reach = max(float((self.desk.placement.inward(scene.focus.numpy()) - position) @ forward), 0.05)
        initial = server.initial_camera
        initial.position, initial.look_at = position, position + reach * forward
        initial.fov = 2.0 * float(np.arctan(0.5 * start.height / start.fy))
        initial.near, initial.far = _NEAR, _FAR
        self._show_panel = ShowPanel(self.desk)
        if scene.settings.look is not None:
            FunctionPanel(self.desk, scene.settings.look, scene.scalar or "scalars")
        if scene.content is not None:
            self.clip_panel = ClipPanel(self.desk)
        if scene.views is not None:
            ViewsPanel(self.desk, scene.views)
        SavePanel(self.desk)
        PathPanel(self.desk)

    def _welcome(self, client: ClientHandle) -> None:
        """Gives a client a window."""

        def show(picture: Painted, is_full: bool) -> None:
            quality = _STILL_QUALITY if is_full else _MOVING_QUALITY
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a client that has just gone
                client.scene.set_background_image(picture.pixels, format="jpeg", jpeg_quality=quality)
            if self._show_panel is not None:
                self._show_panel.tell_scale(picture.scale)

        window = self.studio.open(show)
        self._windows[client.client_id] = window

        async def follow(camera: CameraHandle) -> None:  # in the order in which they come
            size = (camera.image_width, camera.image_height)
            if min(size) > 0:
                view = self.desk.placement.camera(camera.wxyz, camera.position, camera.fov, size)
                self.studio.look(window, view)

        client.camera.on_update(follow)
        self.studio.look(window, self.desk.camera_of(client))

    def _part(self, client: ClientHandle) -> None:
        """Takes the window of a client away."""
        window = self._windows.pop(client.client_id, None)
        if window is not None:
            self.studio.close(window)


def require_viewer() -> None:
    """Checks that there is what serves the pages, before anything is read.

    Raises:
        DiffTetError: It is not installed.
    """
    if importlib.util.find_spec("viser") is None:
        raise DiffTetError(
            "The viewer's pages are served by viser, which is not installed; pip install 'difftetvr[view]' installs it."
        )


def _serving(host: str, port: int) -> ViserServer:
    """A server of pages that nobody sees yet; it says nothing, and is not handed on through servers of others."""
    require_viewer()
    from viser import ViserServer  # late: it is optional, and takes its time

    class Server(ViserServer):
        """One that pages cannot ask to be reachable from elsewhere."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    # What strangers send breaks their own connections alone; without a handler it would be told with a traceback.
    logging.getLogger("websockets").addHandler(logging.NullHandler())
    with _silent():
        server = Server(host=host, port=port, verbose=False)
    _refuse_strangers(server, is_local=host in _OWN)
    if server.get_port() != port:
        server.stop()
        raise DiffTetError(f"Port {port} of {host} is taken; give another --port.")
    return server


def _refuse_strangers(server: ViserServer, is_local: bool) -> None:
    """Takes only connections of the server's own pages: browsers let those of any web site connect to this machine.

    Args:
        server: The server.
        is_local: Whether it may only be called by a name of this machine, which no site can have.
    """
    sockets = server._websock_server

    async def check(connection: Any) -> None:
        live = sockets._live_connections[connection.client_id]
        assert live.request is not None
        headers = live.request.headers
        origin, host = headers.get("Origin"), headers.get("Host", "")
        is_own = origin is None or urlsplit(origin).netloc == host
        if not is_own or (is_local and urlsplit(f"//{host}").hostname not in _OWN):
            await live.close(_REFUSED, "This page is of another site.")

    sockets.on_client_connect(check)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Context in which what the package prints of itself is not printed."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def require_free(host: str, asked: int | None) -> int:
    """The port to listen at.

    Args:
        host: Address to listen at.
        asked: Port; None: 8080, or the next one that is free.

    Raises:
        DiffTetError: It is taken, or this machine has no such address.
    """
    candidates = [asked] if asked is not None else range(PORT, PORT + _PORTS_TRIED)
    problem: OSError | None = None
    for port in candidates:
        try:
            return _tried(host, port)
        except OSError as error:
            problem = error
    assert problem is not None
    reason = problem.strerror or str(problem)
    what = f"port {asked}" if asked is not None else f"any port from {PORT}"
    raise DiffTetError(
        f"Cannot listen at {what} of {host or 'all addresses'} ({reason}); give another --port or --host."
    )


def _tried(host: str, port: int) -> int:
    """A port that could be bound to just now; of 0 one that is free."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((host, port))
        found: Any = probe.getsockname()
        return int(found[1])
