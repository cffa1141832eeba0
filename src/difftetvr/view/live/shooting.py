"""Films of what is seen, whose frames are drawn between the pictures of the windows."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from PIL import Image

from difftetvr.errors import CaptureError, DiffTetError, counted
from difftetvr.rendering import Camera
from difftetvr.view.frames import save_film
from difftetvr.view.live.quantities import picture_of
from difftetvr.view.live.studio import Studio

_LOOK_SECONDS = 0.2  # between looks whether a film is to be stopped


class Shooting:
    """A film that is being made.

    It is written on a thread of its own, which asks the studio for one frame after the other.

    Args:
        studio: Where the frames are drawn, as the settings are now.
        cameras: One for each frame.
        tell: Told the share of the frames that there is.
    """

    def __init__(self, studio: Studio, cameras: list[Camera], tell: Callable[[float], None]) -> None:
        self._studio, self._cameras, self._tell = studio, cameras, tell
        self._scene, self._settings = studio.scene, studio.settings
        self._is_stopped = threading.Event()

    def begin(self, path: Path, fps: float, end: Callable[[str, bool], None]) -> None:
        """Begins with it.

        Args:
            path: The film to write, whole or not at all.
            fps: Frames a second.
            end: Told a sentence at the end, and whether the film is there.
        """

        def write() -> None:
            try:
                count = save_film(path, self._frames(), fps)
                end(f"Wrote {path} ({counted(count, 'frame')}).", True)
            except DiffTetError as error:
                end(str(error), False)

        threading.Thread(target=write, daemon=True).start()

    def stop(self) -> None:
        """Has it end, and leave no file."""
        self._is_stopped.set()

    def _frames(self) -> Iterator[Image.Image]:
        for index, camera in enumerate(self._cameras):
            yield self._frame(camera)
            self._tell((index + 1) / len(self._cameras))

    def _frame(self, camera: Camera) -> Image.Image:
        drawn: queue.Queue[Image.Image | DiffTetError] = queue.Queue()

        def draw() -> None:
            try:
                drawn.put(picture_of(self._scene, self._settings, camera))
            except DiffTetError as error:
                drawn.put(error)

        self._studio.ask(draw)
        while not self._is_stopped.is_set():
            try:
                found = drawn.get(timeout=_LOOK_SECONDS)
            except queue.Empty:
                continue
            if isinstance(found, DiffTetError):
                raise found
            return found
        raise CaptureError("The film was stopped, and nothing was written; make it again.")
