"""Where pictures are drawn for all windows, by the one thread that works here."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from difftetvr.errors import DiffTetError
from difftetvr.rendering import Camera
from difftetvr.view.live.pace import Pace
from difftetvr.view.live.quantities import Painted, band, measured, painted
from difftetvr.view.live.scene import Scene
from difftetvr.view.live.settings import Settings

STILL_SECONDS = 0.15
"""How long nothing moves before a picture is drawn in full."""

_MOST_KNOWN = 1000


@dataclass(eq=False)
class Window:
    """What one client looks through.

    Attributes:
        show: Takes a picture to the client, and whether that is in full.
        camera: Its camera, of the size of the window; None before it has said so.
        changed: When what it shows changed last.
        version: How often it has.
        is_drafted: Whether it has been shown as it is now, if coarsely.
        is_done: Whether it has in full.
        rows: What has been measured for the picture in full, from the top.
    """

    show: Callable[[Painted, bool], None]
    camera: Camera | None = None
    changed: float = 0.0
    version: int = 0
    is_drafted: bool = False
    is_done: bool = False
    rows: list[torch.Tensor] = field(default_factory=list)

    def restart(self, now: float) -> None:
        """What it shows is no longer true."""
        self.changed, self.version = now, self.version + 1
        self.is_drafted, self.is_done, self.rows = False, False, []


class Studio:
    """Draws a scene for windows, coarsely while something changes, in full once nothing does.

    Any thread may look, change and ask; drawing is done by :meth:`work` alone, whose caller is the one thread that
    renders. A picture in full is drawn in bands of rows, and given up as soon as it is no longer true.

    Args:
        scene: What there is to see.
        complain: Told the sentence where a picture cannot be drawn.
    """

    def __init__(self, scene: Scene, complain: Callable[[str], None]) -> None:
        self._scene, self._settings, self._complain = scene, scene.settings, complain
        self._windows: list[Window] = []
        self._jobs: deque[Callable[[], None]] = deque()
        self._changed = threading.Condition()
        self._paces: dict[str, Pace] = {}
        self._known: set[tuple[object, ...]] = set()

    @property
    def scene(self) -> Scene:
        """What there is to see."""
        return self._scene

    @property
    def settings(self) -> Settings:
        """How it is seen."""
        return self._settings

    def open(self, show: Callable[[Painted, bool], None]) -> Window:
        """A new window.

        Args:
            show: Takes a picture to it, on the thread that works, and whether it is in full.
        """
        window = Window(show)
        with self._changed:
            self._windows.append(window)
        return window

    def close(self, window: Window) -> None:
        """Forgets a window; closing it twice is no fault."""
        with self._changed:
            self._windows = [other for other in self._windows if other is not window]

    def look(self, window: Window, camera: Camera) -> None:
        """Moves the camera of a window; of cameras that are not drawn yet the newest counts."""
        with self._changed:
            window.camera = camera
            window.restart(time.monotonic())
            self._changed.notify()

    def change(self, **settings: Any) -> None:
        """Changes settings, by the names of the attributes of `Settings`, in all windows."""
        with self._changed:
            self._settings = dataclasses.replace(self._settings, **settings)
            self._restart()

    def replace(self, scene: Scene) -> None:
        """Shows another scene from now on, as the settings say, such as the same one a few iterations later."""
        with self._changed:
            self._scene = scene
            self._restart()

    def ask(self, job: Callable[[], None]) -> None:
        """Has something done by the thread that works, before it draws on."""
        with self._changed:
            self._jobs.append(job)
            self._changed.notify()

    def work(self, seconds: float) -> bool:
        """Does what is due first: a job, a coarse picture, or some rows of one in full.

        Args:
            seconds: How long to wait for something to be due.

        Returns:
            Whether there was anything to do.
        """
        end = time.monotonic() + seconds
        with self._changed:
            while (task := self._due()) is None:
                now = time.monotonic()
                left = min(end, self._next_still(end)) - now
                if end <= now:
                    return False
                self._changed.wait(max(left, 1e-3))
        try:
            task()
        except (DiffTetError, MemoryError) as error:
            self._complain(str(error) or "There is not enough memory for this picture; ask for a smaller one.")
        return True

    def _restart(self) -> None:
        now = time.monotonic()
        for window in self._windows:
            window.restart(now)
        self._changed.notify()

    def _next_still(self, latest: float) -> float:
        """When the next picture is to be drawn in full."""
        waiting = [w.changed + STILL_SECONDS for w in self._windows if w.camera is not None and not w.is_done]
        return min([latest, *waiting])

    def _due(self) -> Callable[[], None] | None:
        """What is to be done now; called with the lock held."""
        if self._jobs:
            return self._jobs.popleft()
        windows = sorted((w for w in self._windows if w.camera is not None), key=lambda window: window.changed)
        for window in windows:
            if not window.is_drafted:
                window.is_drafted = True  # whether it succeeds or not: said once is said often enough
                return self._draft_for(window)
        now = time.monotonic()
        for window in windows:
            if not window.is_done and now >= window.changed + STILL_SECONDS:
                window.is_done = True
                return self._rows_for(window)
        return None

    def _draft_for(self, window: Window) -> Callable[[], None]:
        camera, version, scene, settings = window.camera, window.version, self._scene, self._settings
        assert camera is not None

        def draft() -> None:
            pace = self._paces.setdefault(settings.mode, Pace())
            width, height = pace.size(camera.width, camera.height)
            start = time.perf_counter()
            picture = painted(measured(scene, settings, _resized(camera, width, height)), settings)
            is_full = (width, height) == (camera.width, camera.height)
            # What moves is shown although it has moved on: the next picture will be as late.
            if self._is_open(window):
                window.show(picture, is_full)
            self._observe(settings, (width, height), time.perf_counter() - start, camera)
            with self._changed:
                if window.version == version:
                    window.is_done = is_full

        return draft

    def _rows_for(self, window: Window) -> Callable[[], None]:
        camera, version, scene, settings = window.camera, window.version, self._scene, self._settings
        assert camera is not None
        before = window.rows

        def rows() -> None:
            done = sum(len(part) for part in before)
            bands = self._paces.setdefault(settings.mode, Pace()).bands(camera.width, camera.height)
            count = min(-(-camera.height // bands), camera.height - done)
            start = time.perf_counter()
            parts = [*before, measured(scene, settings, band(camera, done, count))]
            self._observe(settings, (camera.width, count), time.perf_counter() - start, camera)
            is_whole = done + count == camera.height
            with self._changed:
                is_true = window.version == version
                if is_true:
                    window.rows, window.is_done = [] if is_whole else parts, is_whole
            if is_whole and is_true and self._is_open(window):
                window.show(painted(torch.cat(parts), settings), True)

        return rows

    def _is_open(self, window: Window) -> bool:
        with self._changed:
            return window in self._windows

    def _observe(self, settings: Settings, size: tuple[int, int], seconds: float, whole: Camera) -> None:
        """Takes note of how long something took, unless kernels had to be recorded for its size first."""
        kind = (settings.mode, settings.clip is None, *size)
        if kind in self._known:
            self._paces[settings.mode].observe(size[0] * size[1], seconds, whole.width * whole.height)
        elif len(self._known) > _MOST_KNOWN:
            self._known.clear()
        self._known.add(kind)


def _resized(camera: Camera, width: int, height: int) -> Camera:
    """The same view in other pixels; a hair squeezed where these have not quite the same proportions."""
    x, y = width / camera.width, height / camera.height
    return Camera(camera.world_to_camera, x * camera.fx, y * camera.fy, x * camera.cx, y * camera.cy, width, height)
