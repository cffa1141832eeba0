"""What views of a capture show, where a mesh is that is to show the same."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch

from difftetvr.capture.capture import Capture
from difftetvr.capture.packed import stored, unpacked
from difftetvr.errors import CaptureError
from difftetvr.inputs import handed_over
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.rays import Rays

Color = tuple[float, float, float]
BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)
_MOST_MEMORY = 0.5  # of what is free on a GPU may be filled with views
_LEAST_SHARE = 1e-6  # of the pixels


def counted_share(valid: torch.Tensor | None) -> float:
    """Share of pixels that count, by which means over all of them are divided; never 0, for then there is no error."""
    return 1.0 if valid is None else max(float(valid.float().mean()), _LEAST_SHARE)


class Truth:
    """Images, masks and cameras of a capture for whoever renders on a device.

    On a GPU of CUDA's, views are copied there once, as they are kept: as bytes where the capture has bytes, which are
    unpacked there each time. If they would fill more than half of the memory that is free, none is, and each one is
    copied every time that it is asked for. Everywhere else views are the capture's own, in the memory of the host.

    Attributes:
        capture: Where the views come from.
        device: Where images and masks are.
        cameras: Cameras of views by their index, where they are not those of the capture.
    """

    def __init__(self, capture: Capture, device: torch.device) -> None:
        """No view is kept on the device yet.

        Args:
            capture: Where the views come from.
            device: Where the mesh is.
        """
        self.capture = capture
        self.device = device if device.type == "cuda" else torch.device("cpu")
        self.cameras: Callable[[int], Camera] | None = None
        self._kept: dict[int, _View] = {}
        self._last: tuple[int, _View] | None = None
        self._shares: dict[int, float] = {}

    def keep(self, views: Iterable[int]) -> Truth:
        """Have views copied to the device for all later calls, if that is no CPU and has room for them."""
        if self.device.type == "cuda":
            found = {view: _View.of(self.capture, view) for view in views}
            if sum(view.bytes for view in found.values()) <= _MOST_MEMORY * torch.cuda.mem_get_info(self.device)[0]:
                self._kept |= {view: parts.to(self.device) for view, parts in found.items()}
        return self

    def image(self, view: int, background: Color = BLACK) -> torch.Tensor:
        """(H, W, 3) float32 image of a view over a background.

        Raises:
            CaptureError: The background is not black and the capture knows no alpha.
        """
        parts = self._view(view)
        image = unpacked(parts.image)
        if background == BLACK:
            return image
        if parts.alpha is None:
            raise CaptureError(
                f"The images of '{self.capture.name}' have no alpha, so they cannot be put over the background "
                f"{background}; use a black background."
            )
        return image + (1.0 - unpacked(parts.alpha))[..., None] * handed_over(torch.tensor(background), image)

    def valid(self, view: int) -> torch.Tensor | None:
        """(H, W) bool, the pixels of a view that count; None where all do."""
        return self._view(view).valid

    def share(self, view: int) -> float:
        """Share of a view's pixels that count."""
        if self.capture.valid is None:
            return 1.0
        if view not in self._shares:
            self._shares[view] = float(self.capture.valid[view].float().mean())
        return self._shares[view]

    def counted_share(self, view: int) -> float:
        """The same for divisions, see :func:`counted_share`."""
        return max(self.share(view), _LEAST_SHARE)

    def where_valid(self, view: int, image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        """An image of a view with the truth in the pixels that do not count."""
        valid = self.valid(view)
        return image if valid is None else torch.where(valid.to(image.device)[..., None], image, truth)

    def camera(self, view: int) -> Camera:
        """What to render a view with: rays that kernels do not make themselves are made on the device."""
        if self.cameras is not None:
            return self.cameras(view)
        camera = self.capture.cameras[view]
        return camera if type(camera) is Camera else self._view(view).camera

    def rays(self, view: int, pixels: torch.Tensor) -> Rays:
        """The rays of some pixels of a view, (N,); these are counted row by row."""
        if self.cameras is None:
            return self._view(view).camera.rays_of(pixels)
        camera = self.cameras(view)
        return camera.with_pose(camera.world_to_camera.to(self.device)).rays_of(pixels)

    def _view(self, view: int) -> _View:
        if view in self._kept:
            return self._kept[view]
        # Of one view, image, mask and rays are asked for one after the other.
        if self._last is None or self._last[0] != view:
            self._last = view, _View.of(self.capture, view).to(self.device)
        return self._last[1]


@dataclass(frozen=True)
class _View:
    """A view as the capture keeps it; None for what it has not."""

    camera: Camera
    image: torch.Tensor
    alpha: torch.Tensor | None
    valid: torch.Tensor | None

    @staticmethod
    def of(capture: Capture, view: int) -> _View:
        alpha, valid = (None if t is None else stored(t, view) for t in (capture.alphas, capture.valid))
        return _View(capture.cameras[view], stored(capture.images, view), alpha, valid)

    @property
    def bytes(self) -> int:
        return sum(part.nbytes for part in (self.image, self.alpha, self.valid) if part is not None)

    def to(self, device: torch.device) -> _View:
        if device.type == "cpu":
            return self
        alpha, valid = (None if part is None else part.to(device) for part in (self.alpha, self.valid))
        camera = self.camera.with_pose(self.camera.world_to_camera.to(device))
        return _View(camera, self.image.to(device), alpha, valid)
