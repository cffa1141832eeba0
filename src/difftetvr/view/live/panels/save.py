"""The panel that saves what is seen: pictures, and cameras for the other commands."""

from __future__ import annotations

from typing import Any

from difftetvr.rendering import Camera, save_camera
from difftetvr.view.live.panels.desk import Desk
from difftetvr.view.live.quantities import picture_of
from difftetvr.view.pictures import save_picture

_MOST_PIXELS = 8192  # of a picture's width


class SavePanel:
    """Saves what is seen: as a picture, as a camera for the other commands.

    Args:
        desk: What it works with.
    """

    def __init__(self, desk: Desk) -> None:
        self._desk, gui = desk, desk.server.gui
        with gui.add_folder("Save", expand_by_default=False):
            self._width = gui.add_number("Width in pixels, 0: as seen", 0, min=0, max=_MOST_PIXELS, step=1)
            self._picture_name = gui.add_text("Name", desk.free_name("picture", ".png"))
            self._picture = gui.add_button("Save picture")
            self._camera_name = gui.add_text("Name", desk.free_name("camera", ".json"))
            self._camera = gui.add_button("Save camera")
        self._picture.on_click(desk.guarded(self._save_picture))
        self._camera.on_click(desk.guarded(self._save_camera))

    def _seen_by(self, event: Any) -> Camera:
        camera, width = self._desk.camera_of(event.client), int(self._width.value)
        return camera if not width else camera.with_size(width, max(1, round(width * camera.height / camera.width)))

    def _save_picture(self, event: Any) -> None:
        path, camera = self._desk.file(self._picture_name.value, ".png"), self._seen_by(event)
        studio = self._desk.studio

        def save() -> None:
            save_picture(path, picture_of(studio.scene, studio.settings, camera))
            self._desk.tell(f"Wrote {path} ({camera.width} x {camera.height}).")
            self._picture_name.value = self._desk.free_name("picture", ".png")

        studio.ask(save)

    def _save_camera(self, event: Any) -> None:
        path = self._desk.file(self._camera_name.value, ".json")
        save_camera(path, self._seen_by(event))
        self._desk.tell(f"Wrote {path}; difftetvr render MODEL --camera {path.name} looks from there.")
        self._camera_name.value = self._desk.free_name("camera", ".json")
