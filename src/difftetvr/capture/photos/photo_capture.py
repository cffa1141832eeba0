"""Captures from photographs, or renderings, whose cameras are known."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from difftetvr.capture.camera_set import CameraSet
from difftetvr.capture.capture import Capture
from difftetvr.capture.hull import silhouettes
from difftetvr.capture.photos.bounds import hull_bounds, point_bounds, require_resolved, require_seen, surroundings_of
from difftetvr.capture.photos.lens import make_camera
from difftetvr.capture.photos.photo_load import Photos, fitting_downscale, load_photos, photo_cameras, present_views
from difftetvr.capture.photos.photo_set import PhotoSet, read_json
from difftetvr.capture.photos.readers.camera_list import CAMERAS_FORMAT, read_camera_list
from difftetvr.capture.photos.readers.colmap import colmap_models, read_colmap
from difftetvr.capture.photos.readers.foreign import known_export
from difftetvr.capture.photos.readers.phone_apps import is_polycam, is_record3d, read_polycam, read_record3d
from difftetvr.capture.photos.readers.tiny_nerf import TinyNerf, is_tiny_nerf, read_tiny_nerf
from difftetvr.capture.photos.readers.transforms import read_nerf_synthetic, read_transforms
from difftetvr.capture.volumes.readers.table import is_volume_file
from difftetvr.declared import require_declared
from difftetvr.errors import CaptureError, shown
from difftetvr.inputs import as_whole

Corner = tuple[float, float, float]
PhotoFormat = Literal["nerf-synthetic", "transforms", "colmap", "cameras", "tiny-nerf", "polycam", "record3d"]

_READERS = {
    "nerf-synthetic": read_nerf_synthetic,
    "transforms": read_transforms,
    "colmap": read_colmap,
    "cameras": read_camera_list,
    "polycam": read_polycam,
    "record3d": read_record3d,
}
# Every 8th view, the convention since mip-NeRF 360.
_TEST_EVERY = 8
_MOST_DOWNSCALE = 1024


@dataclass(frozen=True)
class PhotoCapture:
    """Photographs with known cameras; "Photographs in" in the manual tells which formats are read, and how.

    Attributes:
        path: Folder, ``.json`` or ``.npz`` file.
        format: What it is; None finds out by looking.
        downscale: Pixels of an image along x and y that are averaged to one.
        test_every: One of so many views, by name, is held out, beginning with the first; 0 holds out none. None stands
            for 8 where the format does not say itself which views are held out.
        bounds: Lower and upper corner of the box to reconstruct, (x, y, z, x, y, z) or one after the other; None finds
            it by the images' alpha, the sparse points or the cameras.
        keep_lens: Whether photographs are left as their lens has distorted them, and seen by a
            :class:`~difftetvr.LensCamera`, fisheyes among them; else they are resampled to what a pinhole sees.
    """

    path: str
    format: PhotoFormat | None = None
    downscale: int = 1
    test_every: int | None = None
    bounds: tuple[float, float, float, float, float, float] | tuple[Corner, Corner] | None = None
    keep_lens: bool = False

    def __post_init__(self) -> None:
        require_declared(self, CaptureError)

    def fitting_downscale(self, longest_side: int) -> int:
        """The least ``downscale`` with which images have at most so many pixels along their longer side, or nearly so.

        Args:
            longest_side: Pixels, >= 1.

        Raises:
            CaptureError: There is no such capture, or its first image cannot be read.
        """
        self._check()
        most = as_whole(longest_side, "The longest_side", CaptureError)
        if most < 1:
            raise CaptureError(f"The longest_side is {shown(most)}; it must be at least 1.")
        path = Path(self.path)
        kind = self.format or find_format(path)
        # Archives of tiny NeRFs are tiny.
        return 1 if kind == "tiny-nerf" else fitting_downscale(self._read(kind, path), most)

    def build(self) -> Capture:
        """Read cameras and images.

        Raises:
            CaptureError: A file or a value is not valid.
        """
        self._check()
        path = Path(self.path)
        kind = self.format or find_format(path)
        if kind == "tiny-nerf":
            return self._build_tiny_nerf(path)
        photo_set, test = self._present(kind, path)
        photos = load_photos(photo_set, self.downscale, self.keep_lens)
        bounds, surroundings = self._find_bounds(photo_set, photos, test)
        return Capture(
            photos.cameras,
            photos.images,
            photos.alphas,
            test,
            bounds,
            photo_set.name,
            encoding="srgb",
            valid=photos.valid,
            points=_tensor(photo_set.points),
            point_colors=_tensor(photo_set.point_colors),
            surroundings=surroundings,
        )

    def camera_set(self) -> CameraSet:
        """The cameras that `build` finds, without the images: in a moment, however many and large these are.

        Raises:
            CaptureError: A file or a value is not valid.
        """
        self._check()
        path = Path(self.path)
        kind = self.format or find_format(path)
        if kind == "tiny-nerf":
            return self._read_tiny_nerf(path)[1]
        photo_set, test = self._present(kind, path)
        return CameraSet(photo_cameras(photo_set, self.downscale, self.keep_lens), test, photo_set.name)

    def _present(self, kind: PhotoFormat, path: Path) -> tuple[PhotoSet, torch.Tensor]:
        """What a reader finds, with those views alone whose images exist; and which of them are held out."""
        photo_set = self._read(kind, path)
        photo_set.views = present_views(photo_set, self.downscale)
        given = torch.tensor([view.is_test for view in photo_set.views]) if photo_set.has_split else None
        return photo_set, self._test_mask(given, len(photo_set.views), photo_set.name)

    @staticmethod
    def _read(kind: PhotoFormat, path: Path) -> PhotoSet:
        if not os.path.exists(path):
            raise CaptureError(f"There is no '{path}'; check the path of the capture.")
        return _READERS[kind](path)

    def _build_tiny_nerf(self, path: Path) -> Capture:
        content, views = self._read_tiny_nerf(path)
        photos = Photos(views.cameras, content.images, content.alphas, None)
        bounds, surroundings = self._find_bounds(PhotoSet(path.stem), photos, views.test)
        return Capture(
            views.cameras,
            content.images,
            content.alphas,
            views.test,
            bounds,
            path.stem,
            encoding="srgb",
            surroundings=surroundings,
        )

    def _read_tiny_nerf(self, path: Path) -> tuple[TinyNerf, CameraSet]:
        content = read_tiny_nerf(path, self.downscale)
        cameras = [
            make_camera(content.intrinsics, torch.from_numpy(pose).float(), f"view {index} of '{path}'")
            for index, pose in enumerate(content.poses)
        ]
        return content, CameraSet(cameras, self._test_mask(None, len(cameras), path.stem), path.stem)

    def _check(self) -> None:
        if not 1 <= self.downscale <= _MOST_DOWNSCALE:
            raise CaptureError(
                f"The downscale is {shown(self.downscale)}; it must be at least 1 and at most {_MOST_DOWNSCALE}."
            )
        if self.test_every is not None and (self.test_every < 0 or self.test_every == 1):
            raise CaptureError(f"The test_every is {shown(self.test_every)}; it must be 0 or at least 2.")

    def _test_mask(self, given: torch.Tensor | None, count: int, name: str) -> torch.Tensor:
        if given is not None:
            if self.test_every is not None:
                raise CaptureError(f"'{name}' says itself which views are held out; leave out test_every.")
            return given
        every = _TEST_EVERY if self.test_every is None else self.test_every
        return torch.tensor([every > 0 and index % every == 0 for index in range(count)], dtype=torch.bool)

    def _find_bounds(self, photo_set: PhotoSet, photos: Photos, test: torch.Tensor) -> tuple[torch.Tensor, float]:
        """(2, 3) float32 bounds, and the surroundings' factor; only images for training are looked at."""
        cameras = photos.cameras
        train = (~test).nonzero().flatten().tolist() or list(range(len(cameras)))
        seeing = [cameras[view] for view in train]
        masks = silhouettes(photos.images, photos.alphas, train, photos.valid)
        if self.bounds is not None:
            box = np.array(self.bounds, dtype=np.float64).reshape(2, 3)
        elif photo_set.bounds is not None:
            box = photo_set.bounds
        elif masks is not None:
            box = hull_bounds(seeing, masks)
        elif photo_set.points is not None:
            box = point_bounds(photo_set.points, seeing)
        elif photo_set.rough_bounds is not None:
            box = photo_set.rough_bounds
        else:
            box = hull_bounds(seeing, None)
        with np.errstate(over="ignore"):
            corners = box.astype(np.float32)
        surroundings = 1.0
        if np.isfinite(corners).all() and (box[0] < box[1]).all():
            # A box that is given may be of something that few cameras look at.
            require_seen(box, seeing, photo_set.name, most_blind=0.5 if self.bounds is None else 0.75)
            require_resolved(box, photo_set.name)
            surroundings = 1.0 if masks is not None else surroundings_of(box, seeing)
        return torch.from_numpy(corners), surroundings


def is_photo_source(source: str | Path) -> bool:
    """Whether something can only be a photo capture: a folder, a ``.json`` file or a tiny NeRF archive.

    A folder of ``.tif`` slices is a volume instead.
    """
    path = Path(source)
    suffix = path.suffix.lower()
    if os.path.isdir(path):
        return not is_volume_file(path)
    return os.path.isfile(path) and (suffix == ".json" or (suffix == ".npz" and is_tiny_nerf(path)))


def find_format(path: Path) -> PhotoFormat:
    """What kind of photo capture lies at a path.

    Raises:
        CaptureError: None that is known.
    """
    if os.path.isdir(path):
        if (path / "transforms_train.json").is_file():
            return "nerf-synthetic"
        if (path / "transforms.json").is_file():
            return "transforms"
        if _is_camera_list(path / "cameras.json"):
            return "cameras"
        if colmap_models(path):
            return "colmap"
        if is_polycam(path):
            return "polycam"
        if is_record3d(path):
            return "record3d"
    elif path.suffix.lower() == ".json":
        return "cameras" if _is_camera_list(path) else "transforms"
    elif path.suffix.lower() == ".npz":
        return "tiny-nerf"
    if (export := known_export(path)) is not None:
        raise CaptureError(f"'{path}' {export}.")
    raise CaptureError(
        f"'{path}' holds no capture that is known: neither transforms.json, transforms_train.json, a sparse model of "
        "COLMAP nor our cameras.json; see docs/captures.md."
    )


def _is_camera_list(path: Path) -> bool:
    try:
        return os.path.isfile(path) and read_json(path).get("format") == CAMERAS_FORMAT
    except CaptureError:
        return False


def _tensor(values: np.ndarray | None) -> torch.Tensor | None:
    with np.errstate(over="ignore"):  # what float32 cannot hold is refused as not finite
        return None if values is None else torch.from_numpy(values.astype(np.float32))
