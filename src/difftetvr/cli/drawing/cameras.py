"""Options of where pictures are taken from: single cameras, those of a capture, and paths for films."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, arg

from difftetvr.cli.options import Color, color_of, saying
from difftetvr.cli.saved import SavedRun, run_behind, saved_beside
from difftetvr.errors import CameraError, CaptureError, DiffTetError, counted

if TYPE_CHECKING:
    import torch
    from rich.console import Console

    from difftetvr.capture import CameraSet
    from difftetvr.rendering import Camera

CAMERA_GROUPS = {
    "Camera": ("camera", "eye", "target", "up", "fov", "capture", "view", "width", "height"),
    "Film": ("turntable", "path", "frames", "fps"),
}
"""Names of the options below."""

_SIZE, _FRAMES, _FPS = 512, 120, 24.0
_TURNS, _HALVINGS = 72, 50
_MOST_FRAMES = 100_000


@dataclass(frozen=True)
class FilmOptions:
    """How the camera moves, where a film is to be made."""

    turntable: int | None = None
    """Go once around what is shown, in so many frames, beginning with the camera's place."""
    path: Annotated[str | None, arg(metavar="FILE|ellipse|interpolate")] = None
    """Path of the camera: a .json file, ours or nerfstudio's; an ellipse through the middle of the capture's cameras;
    or a smooth path through some of these."""
    frames: int | None = None
    """Frames of a --path; default: 120, or as its file says."""
    fps: float | None = None
    """Frames a second; default: 24, or as the file of the path says."""

    @property
    def is_asked_for(self) -> bool:
        """Whether a film is to be made."""
        return self.turntable is not None or self.path is not None

    def require_valid(self) -> None:
        """Refuse options out of range.

        Raises:
            CameraError: One of them is, or they contradict each other.
        """
        if self.turntable is not None and self.path is not None:
            raise CameraError("--turntable and --path both say how the camera moves; leave out one of them.")
        for name in ("turntable", "frames"):
            count = getattr(self, name)
            if count is not None and not 1 <= count <= _MOST_FRAMES:
                raise CameraError(f"--{name} is {count}; it must be a number of frames from 1 to {_MOST_FRAMES:,}.")
        if self.fps is not None and not (math.isfinite(self.fps) and 0.1 <= self.fps <= 1000.0):
            raise CameraError(f"--fps is {self.fps:g}; it must lie between 0.1 and 1000.")
        if self.frames is not None and self.path is None:
            raise CameraError("--frames counts those of a --path; name one, or give their number to --turntable.")
        if self.fps is not None and not self.is_asked_for:
            raise CameraError("--fps is for films; make one with --turntable or --path.")


@dataclass(frozen=True)
class CameraOptions:
    """From where a picture is taken."""

    camera: Path | None = None
    """File of the camera, .json, such as viewpoint writes it, instead of the following options; with --width its
    picture in that size."""
    eye: tuple[float, float, float] | None = None
    """Position of the camera; default: where all of the mesh is seen, whose visible part then fills the picture; of
    what was fitted to photographs, that of the photograph in the middle."""
    target: tuple[float, float, float] | None = None
    """Point in the middle of the picture; default: the centre of the mesh, or of what is seen of it."""
    up: tuple[float, float, float] | None = None
    """Direction that points upwards in the picture; default: 0 0 1."""
    fov: float | None = None
    """Vertical field of view in degrees; default: 53.13, or so small that what is seen fills the picture."""
    capture: str | None = None
    """Capture whose cameras --view and --path are about, such as a folder of photographs; default: that of the run
    whose model this is."""
    view: int | None = None
    """Number of one of its views, from 0, as eval counts them: look from that camera."""
    width: int | None = None
    """Pixels; default: 512, or as the camera's file or the view says."""
    height: int | None = None
    """Pixels; default: likewise."""
    film: OmitArgPrefixes[FilmOptions] = field(default_factory=FilmOptions)

    def require_valid(self) -> None:
        """Refuse options that are out of range, or say different things.

        Raises:
            CameraError: They do.
        """
        if self.fov is not None and not 0.0 < self.fov < 180.0:
            raise CameraError(f"--fov is {self.fov:g} degrees; it must lie between 0 and 180.")
        for name in ("eye", "target", "up"):
            values = getattr(self, name)
            if values is not None and not all(math.isfinite(v) for v in values):
                given = " ".join(f"{v:g}" for v in values)
                raise CameraError(f"--{name} is {given}; give three finite numbers.")
        placed = [name for name in ("view", "eye", "target", "up", "fov") if getattr(self, name) is not None]
        if self.camera is not None and placed:
            raise CameraError(f"--camera {self.camera} says where the camera is; leave out --{placed[0]}.")
        if self.view is not None and len(placed) > 1:
            raise CameraError(f"--view {self.view} says where the camera is; leave out --{placed[1]}.")
        if self.film.path is not None and (self.camera is not None or placed):
            other = "camera" if self.camera is not None else placed[0]
            raise CameraError(f"--path {self.film.path} says where the camera is; leave out --{other}.")
        self.film.require_valid()

    @property
    def is_placed(self) -> bool:
        """Whether an option says where the camera is."""
        return any(getattr(self, name) is not None for name in ("camera", "view", "eye", "target", "up", "fov"))


@dataclass(frozen=True)
class Shots:
    """Cameras of the pictures to take: one, or those of a film with its frames a second.

    Attributes:
        cameras: The cameras.
        fps: Frames a second; None for one picture.
        is_chosen: Whether nothing says where the camera is, so that it may be turned to what there is to see.
    """

    cameras: list[Camera]
    fps: float | None = None
    is_chosen: bool = False


class Place:
    """Where cameras stand around a model, by what is asked for and by what is known of the run it comes from.

    Args:
        model: The model's file.
        options: What is asked for.
        console: Where to say what was found.
    """

    def __init__(self, model: Path, options: CameraOptions, console: Console) -> None:
        self._model, self._options, self._console = model, options, console
        self._run = saved_beside(model) if options.capture is None else run_behind(model, options.capture)
        self._views: CameraSet | None = None
        self.is_of_photographs = self._looks_at_photographs()
        """Whether the model comes from photographs, so that it is looked at as they were taken."""

    @property
    def run(self) -> SavedRun | None:
        """The run whose model this is, as far as it is known."""
        return self._run

    @property
    def views(self) -> CameraSet | None:
        """Cameras of the photographs that the model comes from; None where it comes from none, or they are gone."""
        return self._known_views() if self.is_of_photographs else None

    def background(self, given: Color | None) -> tuple[float, float, float]:
        """What is behind the model: what is given, else that of the run from photographs whose model it is, or black.

        Args:
            given: What the command line says.

        Raises:
            CaptureError: That is not finite.
        """
        if given is None and self._run is not None and self.is_of_photographs:
            return self._run.fit.evaluation_background()
        return color_of("black" if given is None else given)

    def take(self, views: CameraSet) -> None:
        """Makes known the cameras of its capture to who has read them already."""
        self._views = views

    def shots(self, bounds: torch.Tensor, room: tuple[float, float] = (0.0, 0.0)) -> Shots:
        """The cameras.

        Args:
            bounds: (2, 3) float64 of what is shown.
            room: Shares of the picture on its right, and on every side, that a default camera leaves free.

        Raises:
            CameraError: An option does not fit the others, a file is not valid, or no picture of that size can be
                computed.
        """
        film = self._options.film
        if film.path in ("ellipse", "interpolate"):
            return self._through_views(film.path, film.frames or _FRAMES, film.fps or _FPS)
        if film.path is not None:
            from difftetvr.capture.camera_paths import load_camera_path

            path = load_camera_path(Path(film.path))
            cameras = [self._resized(camera, film.path) for camera in path.cameras_of_frames(film.frames)]
            return Shots(cameras, film.fps or path.fps or _FPS)
        camera = self._start(bounds, room)
        if film.turntable is None:
            return Shots([camera], is_chosen=not (self.is_of_photographs or self._options.is_placed))
        from difftetvr.capture.camera_paths import turntable

        return Shots(turntable(camera, film.turntable, *self._axis(bounds)), film.fps or _FPS)

    def _through_views(self, kind: str, frames: int, fps: float) -> Shots:
        from difftetvr.capture.camera_paths import ellipse, interpolated, key_cameras_of

        views = self._required_views(f"--path {kind}")
        if kind == "ellipse":
            cameras = ellipse(views, frames)
        else:
            cameras = interpolated(key_cameras_of(views, frames), frames)
        first = cameras[0]
        sized = self._enlarged(first, views.name)
        return Shots([camera.with_size(sized.width, sized.height) for camera in cameras], fps)

    def _start(self, bounds: torch.Tensor, room: tuple[float, float]) -> Camera:
        """The camera of a single picture, or that a turntable begins with."""
        from difftetvr.rendering.cameras.camera_file import load_camera

        options = self._options
        if options.camera is not None:
            return self._resized(load_camera(options.camera), str(options.camera))
        if options.view is not None:
            views = self._required_views(f"--view {options.view}")
            count = len(views.cameras)
            if not 0 <= options.view < count:
                raise CameraError(
                    f"--view is {options.view}, but '{views.name}' has {counted(count, 'view')}, numbered from 0."
                )
            return self._resized(views.cameras[options.view], f"view {options.view}")
        known = self._known_views() if self.is_of_photographs and not options.is_placed else None
        if known is not None:
            return self._enlarged(known.typical, known.name)
        return self._placed(bounds, room)

    def _axis(self, bounds: torch.Tensor) -> tuple[list[float], list[float]]:
        """A point of the axis of a turntable, and its direction."""
        from difftetvr.view.frames.visible import UP

        options, views = self._options, None
        if self.is_of_photographs and options.target is None:
            views = self._known_views()
        if views is not None:
            return views.focus.tolist(), list(options.up or views.up.tolist())
        return list(options.target or bounds.mean(0).tolist()), list(options.up or UP)

    def _looks_at_photographs(self) -> bool:
        """Whether the cameras of the capture say where the scene is looked at from."""
        from difftetvr.capture import TOOTH, is_photo_source, is_volume_file

        name = self._options.capture or (None if self._run is None else self._run.capture)
        if name is None:
            return False
        if not (name == TOOTH or is_volume_file(name) or Path(name).exists() or self._options.is_placed):
            self._console.print(
                f"Looked at from outside, as {name}, which it was fitted to, is no longer there; a --capture would say "
                "from where.",
                highlight=False,
            )
            return False
        has_format = self._run is not None and self._run.capture_options.format is not None
        return has_format or is_photo_source(name) or self._options.capture is not None

    def _known_views(self) -> CameraSet | None:
        """The views of the capture; None, with a line that says so, where it cannot be read."""
        try:
            return self._required_views("the camera")
        except DiffTetError as error:
            if self._options.capture is not None:
                raise
            self._console.print(f"Looked at from outside, as the views of its run cannot be read: {error}")
            self.is_of_photographs = False
            return None

    def _required_views(self, what: str) -> CameraSet:
        """The views of the capture.

        Raises:
            CaptureError: There is none, or it cannot be read.
        """
        if self._views is None:
            from difftetvr.capture import load_cameras

            name = self._options.capture or (None if self._run is None else self._run.capture)
            if name is None:
                raise CaptureError(
                    f"No config.json of a run lies beside {self._model}, so {what} needs the name of a --capture."
                )
            settings = {} if self._run is None else self._run.capture_options.given()
            with saying(self._console):
                self._views = load_cameras(name, **settings)
        return self._views

    def _resized(self, camera: Camera, name: str) -> Camera:
        """A camera that is given, in the size that is asked for."""
        options = self._options
        if options.width is None and options.height is None:
            return camera
        width = options.width or round(camera.width * (options.height or 0) / camera.height)
        height = options.height or round(camera.height * width / camera.width)
        # To a pixel: other proportions would squeeze the picture.
        if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
            raise CameraError(
                f"The camera {name} takes pictures of {camera.width} x {camera.height} pixels, which "
                f"{width} x {height} would squeeze; give one of --width and --height."
            )
        return camera.with_size(width, height)

    def _enlarged(self, camera: Camera, name: str) -> Camera:
        """A camera that is chosen, in the size that is asked for, else with the usual longer side."""
        if self._options.width is not None or self._options.height is not None:
            return self._resized(camera, f"of '{name}'")
        scale = _SIZE / max(camera.width, camera.height)
        return camera.with_size(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))

    def _placed(self, bounds: torch.Tensor, room: tuple[float, float]) -> Camera:
        """A camera of our own: where eye, target, up and field of view say, else where the whole box is seen."""
        import torch

        from difftetvr.rendering.cameras.pinhole import Camera
        from difftetvr.view.blank import require_drawable
        from difftetvr.view.frames.visible import DIRECTION, FILLED, FOV, UP

        options = self._options
        size = float((bounds[1] - bounds[0]).max())
        require_drawable(size, str(self._model))
        width, height = (_SIZE if pixels is None else pixels for pixels in (options.width, options.height))
        up, fov_y = options.up or UP, math.radians(FOV if options.fov is None else options.fov)
        target = torch.tensor(options.target, dtype=torch.float64) if options.target else bounds.mean(0)
        if options.eye is not None:
            return Camera.look_at(options.eye, target, up, fov_y, width, height)
        direction = torch.tensor(DIRECTION, dtype=torch.float64)
        direction = direction / direction.norm()
        # One far away has the axes of all that look this way.
        far = Camera.look_at(target + 10.0 * size * direction, target, up, fov_y, width, height)
        free = ((1.0 - room[0]) * (FILLED - 2.0 * room[1]), FILLED - 2.0 * room[1])
        distance, (x, y) = _fitted(far, self._corners(bounds - target, up), free)
        camera = Camera.look_at(target + distance * direction, target, up, fov_y, width, height)
        if options.target is not None:
            return camera  # which is to be in the middle
        cx, cy = 0.5 * (1.0 - room[0]) * width - x * camera.fx, 0.5 * height - y * camera.fy
        return Camera(camera.world_to_camera, camera.fx, camera.fy, cx, cy, width, height)

    def _corners(self, box: torch.Tensor, up: tuple[float, float, float]) -> torch.Tensor:
        """(N, 3) points whose hull is seen: corners of a box, of a turntable's all that it turns through."""
        import itertools

        import numpy as np
        import torch
        from scipy.spatial.transform import Rotation

        corners = torch.stack([torch.stack(corner) for corner in itertools.product(*box.T)])
        axis = np.array(up) / max(float(np.linalg.norm(up)), 1e-300)
        if self._options.film.turntable is None or not axis.any():
            return corners
        angles = np.linspace(0.0, 2.0 * np.pi, _TURNS, endpoint=False)
        return torch.from_numpy(
            np.concatenate([turn.apply(corners) for turn in Rotation.from_rotvec(np.outer(angles, axis))])
        )


def _fitted(camera: Camera, points: torch.Tensor, free: tuple[float, float]) -> tuple[float, tuple[float, float]]:
    """How far from a target a camera sees points around it within shares of the picture, as near as that allows.

    Args:
        camera: Any that looks so.
        points: (N, 3), seen from the target.
        free: Shares of the width and the height.

    Returns:
        The distance, and where the middle of what is seen then lies in the plane at distance 1.
    """
    right, down, forward = camera.world_to_camera[:3, :3].double().cpu() @ points.T
    room = (free[0] * camera.width / camera.fx, free[1] * camera.height / camera.fy)
    nearest, size = -float(forward.min()), float(points.norm(dim=1).max())

    def extents(distance: float) -> list[tuple[float, float]]:
        seen = [across / (forward + distance) for across in (right, down)]
        return [(float(across.min()), float(across.max())) for across in seen]

    near, far = nearest, nearest + 2.0 * size / min(*room, 1.0)
    for _ in range(_HALVINGS):
        middle = 0.5 * (near + far)
        fits = middle > nearest and all(
            high - low <= share for (low, high), share in zip(extents(middle), room, strict=True)
        )
        near, far = (near, middle) if fits else (middle, far)
    (left, rightmost), (top, bottom) = extents(far)
    return far, (0.5 * (left + rightmost), 0.5 * (top + bottom))
