"""What all panels work with: the server of the pages, the studio, and the folder that may be written to."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from difftetvr.errors import CaptureError, DiffTetError
from difftetvr.files import require_writable_folder
from difftetvr.rendering import Camera
from difftetvr.view.live.placement import Placement, fov_that_holds
from difftetvr.view.live.studio import Studio

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

_SECONDS_TOLD = 8.0
_LEAST_REACH = 0.05  # from a camera to the point that it turns around, in the size of the scene
_LONGEST_NAME = 100


@dataclass(frozen=True, eq=False)
class Desk:
    """What panels work with.

    Attributes:
        server: What serves the pages.
        studio: Where pictures are drawn.
        placement: Where things are in a browser.
        folder: Where files are written, and nowhere else.
    """

    server: ViserServer
    studio: Studio
    placement: Placement
    folder: Path

    def tell(self, sentence: str) -> None:
        """Says something in all windows."""
        self._notify("Done", sentence, "green")

    def complain(self, sentence: str) -> None:
        """Says in all windows what does not work."""
        self._notify("This does not work", sentence, "red")

    def _notify(self, title: str, sentence: str, color: Any) -> None:
        for client in self.server.get_clients().values():
            client.add_notification(title, sentence, color=color, auto_close_seconds=_SECONDS_TOLD)

    def guarded(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """A callback of a panel whose errors are said in the windows."""

        @functools.wraps(callback)
        def call(event: Any) -> None:
            try:
                callback(event)
            except DiffTetError as error:
                self.complain(str(error))

        return call

    def file(self, name: str, suffix: str) -> Path:
        """The file of a name that a hand has typed.

        Args:
            name: Its name, with or without the suffix.
            suffix: What it ends with; empty for a folder.

        Raises:
            CaptureError: It would lie outside of the folder, is no name, is there already, or cannot be written.
        """
        name = name.strip()
        name = name if name.lower().endswith(suffix) else name + suffix
        path = self.folder / name
        is_name = name not in ("", suffix) and not name.startswith(".") and len(name) <= _LONGEST_NAME
        has_place = any(sign in name for sign in "/\\:\0") or path.resolve().parent != self.folder.resolve()
        if not is_name or has_place:
            raise CaptureError(
                f"'{name}' is no name of a file in {self.folder}, the one folder that is written to; give a name "
                "without a path."
            )
        require_writable_folder(self.folder, CaptureError)
        self.folder.mkdir(parents=True, exist_ok=True)
        if path.exists():
            raise CaptureError(f"{path} is there already, and nothing is replaced; give another name.")
        return path

    def free_name(self, stem: str, suffix: str) -> str:
        """The first of the names stem-1, stem-2, ... that no file has."""
        number = 1
        while (self.folder / f"{stem}-{number}{suffix}").exists():
            number += 1
        return f"{stem}-{number}"

    def camera_of(self, client: ClientHandle) -> Camera:
        """The camera that a client looks through, of the size of its window."""
        camera = client.camera
        size = (camera.image_width, camera.image_height)
        return self.placement.camera(camera.wxyz, camera.position, camera.fov, size)

    def move(self, client: ClientHandle, camera: Camera) -> None:
        """Has a client look through a camera; what this sees is seen as a whole."""
        wxyz, position = self.placement.pose(camera)
        forward = camera.world_to_camera[2, :3].detach().cpu().double().numpy()
        focus = self.placement.inward(self.studio.scene.focus.numpy())
        reach = max(float((focus - position) @ forward), _LEAST_REACH)
        aspect = client.camera.image_width / max(1, client.camera.image_height)
        with client.atomic():
            client.camera.fov = fov_that_holds(camera, aspect)
            client.camera.position = position
            client.camera.wxyz = wxyz
            client.camera.look_at = position + reach * forward

    def bytes_of(self, image: torch.Tensor, longest: int) -> np.ndarray:
        """A small (h, w, 3) uint8 copy of an (H, W, 3) image, for a frustum."""
        step = max(1, -(-max(image.shape[:2]) // longest))
        small = torch.nn.functional.avg_pool2d(image.float().permute(2, 0, 1)[None], step, ceil_mode=True)[0]
        return (small.permute(1, 2, 0).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
