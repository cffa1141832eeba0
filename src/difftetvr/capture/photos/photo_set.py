"""What the readers of photo captures find: views with their files, lenses and poses, before any image is decoded."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.photos.image_file import SUFFIXES
from difftetvr.capture.photos.lens import Lens
from difftetvr.errors import CaptureError, shown
from difftetvr.errors import CaptureWarning as CaptureWarning
from difftetvr.trust import file_beside, require_regular

_MOST_PIXELS = 2**20  # of a side: beyond, it is no image


@dataclass(frozen=True, eq=False)
class View:
    """One photograph and its camera.

    Attributes:
        owner: The file that names the image, or the folder of the capture: the image must lie there.
        root: Folder of the images; smaller copies may lie beside it in folders with ``_2``, ``_4``, ... appended, but
            not beside the owner's own folder.
        name: Path of the image inside ``root``; a suffix may be missing.
        world_to_camera: (4, 4) float64 rigid transform to OpenCV axes.
        lens: Intrinsics as the file gives them.
        is_test: Whether it is held out.
        mask: File that is black where pixels are not to be used, None for none.
    """

    owner: Path
    root: Path
    name: str
    world_to_camera: np.ndarray
    lens: Lens
    is_test: bool = False
    mask: Path | None = None

    @property
    def label(self) -> str:
        """What to call it in messages."""
        return f"'{self.root / self.name}'"

    def file(self, downscale: int) -> tuple[Path, int] | None:
        """The image's file that is nearest to a downscaling, and how much smaller than the original it is.

        Smaller copies are used if their factor divides ``downscale``. None stands for a missing image.

        Raises:
            CaptureError: It lies outside of the owner's folder, perhaps by a link, where that is not allowed.
        """
        for factor in range(downscale, 0, -1):
            root = self._root_of(factor) if downscale % factor == 0 else None
            path = None if root is None else _image_in(root, self.name)
            if path is not None:
                file_beside(self.owner, os.path.abspath(path), CaptureError)
                return path, factor
        return None

    def _root_of(self, factor: int) -> Path | None:
        if factor == 1:
            return self.root
        folder = self.owner if self.owner.is_dir() else self.owner.parent
        has_place = self.root.name and self.root != folder
        return self.root.with_name(f"{self.root.name}_{factor}") if has_place else None


def image_place(owner: Path, name: str, where: str) -> tuple[Path, str]:
    """Folder of the images and path of an image inside it, from a path that a file gives.

    The first folder of the path is the one that smaller copies lie beside.

    Args:
        owner: The file that names the image.
        name: Its path, relative to the owner's folder or absolute.
        where: What names it, for messages.

    Raises:
        CaptureError: It is no path of a file, or lies outside of the owner's folder, where that is not allowed.
    """
    plain = Path(name.replace("\\", "/"))
    if not plain.name:
        raise CaptureError(f"{where[0].upper()}{where[1:]} names the image {shown(name)}; give the path of a file.")
    file_beside(owner, name, CaptureError)
    folder = owner.parent
    if plain.is_absolute():
        resolved, inside = Path(os.path.realpath(plain.parent)), Path(os.path.realpath(folder))
        if not resolved.is_relative_to(inside):
            return plain.parent, plain.name
        plain = resolved.relative_to(inside) / plain.name
    root, *rest = plain.parts
    return (folder / root, str(Path(*rest))) if rest else (folder, root)


@dataclass(eq=False)
class PhotoSet:
    """A photo capture whose images are still in their files.

    Attributes:
        name: What to call it.
        views: The views, in the order that the capture will have.
        has_split: Whether the format says which views are held out.
        may_miss: Whether images that are listed may be absent.
        points: (P, 3) float64 points on the scene's surfaces, None where none are known.
        point_colors: (P, 3) float64 colours of the points in [0, 1], encoded as the images are.
        bounds: (2, 3) float64 corners of the object's box, where the format gives it.
        rough_bounds: (2, 3) float64 corners of a box that should hold the object, where nothing better is known.
    """

    name: str
    views: list[View] = field(default_factory=list)
    has_split: bool = False
    may_miss: bool = False
    points: np.ndarray | None = None
    point_colors: np.ndarray | None = None
    bounds: np.ndarray | None = None
    rough_bounds: np.ndarray | None = None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        CaptureError: The file is missing or no JSON object.
    """
    require_regular(path, CaptureError)
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}; check the capture's folder.") from None
    except (ValueError, RecursionError) as error:
        place = f"line {error.lineno}" if isinstance(error, json.JSONDecodeError) else "it cannot be decoded"
        raise CaptureError(f"'{path}' is no valid JSON ({place}); correct the file or get it anew.") from None
    if not isinstance(content, dict):
        raise CaptureError(f"'{path}' holds no JSON object; check that it describes cameras.")
    return content


def list_of_objects(content: dict[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    """The objects that a JSON file lists under a key, at least one.

    Raises:
        CaptureError: There are none, or something else is listed.
    """
    items = content.get(key)
    if not isinstance(items, list) or not items or not all(isinstance(item, dict) for item in items):
        raise CaptureError(f"'{path}' lists no '{key}'; check that it describes the cameras of a capture.")
    return items


def text_of(content: dict[str, Any], key: str, where: str) -> str:
    """A string of a JSON object.

    Raises:
        CaptureError: It is missing, empty or no string.
    """
    value = content.get(key)
    if not isinstance(value, str) or not value or "\0" in value:
        raise CaptureError(f"'{key}' of {where} is {shown(value)}; give the path of an image.")
    return value


def number_of(content: dict[str, Any], key: str, where: str) -> float | None:
    """A finite number of a JSON object; None where it is missing.

    Raises:
        CaptureError: It is no finite number, or larger than a float can be.
    """
    value = content.get(key)
    if value is None:
        return None
    numbers = numbers_of(None if isinstance(value, bool) or not isinstance(value, int | float) else value)
    if numbers.size != 1 or not math.isfinite(numbers):
        raise CaptureError(f"'{key}' of {where} is {shown(value)}; give a finite number.")
    return float(numbers)


def pixels_of(content: dict[str, Any], key: str, where: str) -> int | None:
    """A positive whole number of a JSON object, which may be written as a float; None where it is missing.

    Raises:
        CaptureError: It is no such number, or of more pixels than an image has.
    """
    value = number_of(content, key, where)
    if value is None:
        return None
    if value != int(value) or not 1 <= value <= _MOST_PIXELS:
        raise CaptureError(
            f"'{key}' of {where} is {value:g}; give a whole number of pixels, at least 1 and at most {_MOST_PIXELS:,}."
        )
    return int(value)


def numbers_of(values: object) -> np.ndarray:
    """float64 array of numbers, or nested lists of them, as JSON has them; empty where they are none."""
    try:
        return np.array([] if values is None else values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # integers of JSON may be larger than any float
        return np.empty(0)


def _image_in(root: Path, name: str) -> Path | None:
    path = root / name
    # Not Path.is_file, which raises where a name is too long.
    if os.path.isfile(path):
        return path
    if not path.name:
        return None
    # Blender's files leave the suffix out, and smaller copies may have another one.
    stem = path.with_suffix("") if path.suffix.lower() in SUFFIXES else path
    for suffix in SUFFIXES:
        for candidate in (stem.with_name(stem.name + suffix), stem.with_name(stem.name + suffix.upper())):
            if os.path.isfile(candidate):
                return candidate
    return None
