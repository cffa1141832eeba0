"""The panel that records a path of the camera, and has a film made of it."""

from __future__ import annotations

import dataclasses
import importlib.util
from typing import Any

import numpy as np

from difftetvr.capture.camera_paths import CameraPath, save_camera_path
from difftetvr.errors import CameraError, counted
from difftetvr.rendering import Camera
from difftetvr.view.frames.films import require_film
from difftetvr.view.live.panels.desk import Desk
from difftetvr.view.live.shooting import Shooting

_LINE = "/path"
_MOST_FRAMES, _MOST_KEYS = 10_000, 1000
_VIDEO = "imageio_ffmpeg"  # what writes videos


class PathPanel:
    """Records a path of the camera through views, and films it.

    Args:
        desk: What it works with.
    """

    def __init__(self, desk: Desk) -> None:
        self._desk, gui = desk, desk.server.gui
        self._keys: list[Camera] = []
        self._film: Shooting | None = None
        kinds = (*((".mp4", ".webm") if importlib.util.find_spec(_VIDEO) else ()), ".webp", ".gif")
        with gui.add_folder("Camera path", expand_by_default=False):
            self._count = gui.add_markdown("")
            self._add = gui.add_button("Add this view")
            self._edit = gui.add_button_group("Views", ("Remove last", "Clear"))
            self._frames = gui.add_number("Frames", 120, min=1, max=_MOST_FRAMES, step=1)
            self._fps = gui.add_number("Frames a second", 24.0, min=0.1, max=1000.0, step=1.0)
            self._loop = gui.add_checkbox("Back to the first", False)
            self._name = gui.add_text("Name", desk.free_name("path", ".json"))
            self._save = gui.add_button("Save path")
            self._kind = gui.add_dropdown("Film", kinds, initial_value=kinds[0])
            self._shoot = gui.add_button("Make film")
            self._progress = gui.add_progress_bar(0.0, visible=False)
            self._cancel = gui.add_button("Stop", visible=False)
        self._add.on_click(desk.guarded(self._add_key))
        self._edit.on_click(desk.guarded(lambda _: self._remove(self._edit.value == "Clear")))
        self._loop.on_update(desk.guarded(lambda _: self._draw()))
        self._save.on_click(desk.guarded(lambda _: self._save_path()))
        self._shoot.on_click(desk.guarded(lambda _: self._make_film()))
        self._cancel.on_click(lambda _: self._stop())
        self._draw()

    def _path(self) -> CameraPath:
        """The path as it is.

        Raises:
            CameraError: No view has been added.
        """
        if not self._keys:
            raise CameraError("The path has no views; add one or more.")
        return CameraPath(list(self._keys), int(self._frames.value), bool(self._loop.value), float(self._fps.value))

    def _add_key(self, event: Any) -> None:
        if len(self._keys) >= _MOST_KEYS:
            raise CameraError(f"The path has {_MOST_KEYS} views already; remove some.")
        self._keys.append(self._desk.camera_of(event.client))
        self._draw()

    def _remove(self, all_of_them: bool) -> None:
        self._keys = [] if all_of_them else self._keys[:-1]
        self._draw()

    def _draw(self) -> None:
        self._count.content = f"{counted(len(self._keys), 'view')} to run through"
        scene = self._desk.server.scene
        if len(self._keys) < 2:
            scene.remove_by_name(_LINE)
            return
        cameras = dataclasses.replace(self._path(), frames=20 * len(self._keys)).cameras_of_frames()
        places = np.stack([self._desk.placement.pose(camera)[1] for camera in cameras]).astype(np.float32)
        points = np.stack((places[:-1], places[1:]), 1)
        scene.add_line_segments(_LINE, points, (240, 90, 160), thickness=2.0, thickness_units="screen")

    def _save_path(self) -> None:
        path = self._desk.file(self._name.value, ".json")
        save_camera_path(path, self._path())
        self._desk.tell(f"Wrote {path}; difftetvr render MODEL --path {path.name} films it.")
        self._name.value = self._desk.free_name("path", ".json")

    def _make_film(self) -> None:
        if self._film is not None:
            raise CameraError("A film is being made already; wait for it, or stop it.")
        content, kind = self._path(), self._kind.value
        path = self._desk.file(self._name.value, kind)
        require_film(path)
        cameras = content.cameras_of_frames()
        self._film = Shooting(self._desk.studio, cameras, self._filmed)
        self._progress.visible = self._cancel.visible = True
        self._film.begin(path, content.fps or 24.0, self._ended)

    def _stop(self) -> None:
        if self._film is not None:
            self._film.stop()

    def _filmed(self, share: float) -> None:
        self._progress.value = 100.0 * share

    def _ended(self, sentence: str, is_there: bool) -> None:
        self._film = None
        self._progress.visible = self._cancel.visible = False
        (self._desk.tell if is_there else self._desk.complain)(sentence)
