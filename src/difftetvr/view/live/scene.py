"""What there is to see: a content, the cameras that looked at it, and from where it is looked at first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch

from difftetvr.capture import CameraSet, Capture
from difftetvr.capture.viewing import positions_of
from difftetvr.rendering import Camera
from difftetvr.view.live.contents import Content
from difftetvr.view.live.settings import MODES, Mode, Settings


@dataclass(frozen=True, eq=False)
class Views:
    """The views of a capture.

    Attributes:
        cameras: N cameras.
        test: (N,) bool, those that training never sees.
        capture: Their images; None where these are not at hand.
    """

    cameras: Sequence[Camera]
    test: torch.Tensor
    capture: Capture | None = None

    @staticmethod
    def of(source: Capture | CameraSet) -> Views:
        """Those of a capture, or of its cameras alone."""
        return Views(source.cameras, source.test, source if isinstance(source, Capture) else None)

    @cached_property
    def _places(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, 3) positions of the cameras, and (N, 3) directions that they look in."""
        forward = torch.stack([camera.world_to_camera[2, :3].detach().cpu().double() for camera in self.cameras])
        return torch.from_numpy(positions_of(list(self.cameras))).double(), forward

    def nearest_to(self, camera: Camera, focus: torch.Tensor) -> int:
        """The view whose camera is most like another one.

        Args:
            camera: The other one.
            focus: (3,) what is looked at; its distance makes distances comparable with angles.
        """
        positions, forward = self._places
        place = camera.position.detach().cpu().double()
        distance = (positions - place).norm(dim=1) / (place - focus).norm().clamp_min(torch.finfo(torch.float64).tiny)
        turned = (forward - camera.world_to_camera[2, :3].detach().cpu().double()).norm(dim=1)
        return int((distance.square() + turned.square()).argmin())


@dataclass(frozen=True, eq=False)
class Scene:
    """What there is to see.

    Attributes:
        title: What it is called.
        content: The mesh or the volume; None: only the views are known.
        bounds: (2, 3) float64 lower and upper corner of what is looked at, on the CPU.
        start: Camera of the first picture.
        up: Direction that points upwards, as long as nobody turns it.
        settings: How it is seen at first.
        views: Those of the capture that it comes from, if it comes from one.
        scalar: Name of the scalar that is shown, if one is.
    """

    title: str
    content: Content | None
    bounds: torch.Tensor
    start: Camera
    up: tuple[float, float, float]
    settings: Settings
    views: Views | None = None
    scalar: str | None = None

    @property
    def modes(self) -> tuple[Mode, ...]:
        """What can be shown."""
        if self.content is None:
            return ("color",)
        has_images = self.views is not None and self.views.capture is not None
        known = {*self.content.modes, *(("error",) if has_images and "depth" in self.content.modes else ())}
        return tuple(mode for mode in MODES if mode in known)

    @property
    def focus(self) -> torch.Tensor:
        """(3,) float64 the middle of what is looked at."""
        return self.bounds.mean(0)
