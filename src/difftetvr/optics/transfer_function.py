"""Piecewise-linear transfer functions: from a scalar in [0, 1] to colour and opacity, and their files."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch

from difftetvr.errors import CaptureError
from difftetvr.files import atomic_write
from difftetvr.inputs import as_reals, require_type
from difftetvr.trust import require_regular

Values = TypeVar("Values", np.ndarray, torch.Tensor)

# Largest stored value of each colour encoding that the XML format of the original's tools knows.
_XML_COLOR_MAXIMUM = {"ubyte": 255.0, "ushort": 65535.0, "float": 1.0, "float_255": 255.0}
_HINT = "give a transfer function as .json or .xml"


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """Colour and opacity as piecewise-linear functions of a scalar, constant outside the first and last knot.

    Two knots at the same scalar make a jump; at the jump itself the later knot counts. Derivatives of images by their
    places are one-sided: the earlier one can only move down, the later one only up.

    Attributes:
        scalar: (K,) knot positions in [0, 1], not decreasing, K >= 1. Lists and arrays are accepted and converted.
        opacity: (K,) opacity in [0, 1] at the knots. The density of a medium is attenuation * opacity.
        color: (K, 3) linear RGB >= 0 at the knots.
        name: What to call it, for messages and files.

    Raises:
        CaptureError: Shapes do not match or a value is out of range; names the first offending knot.
    """

    scalar: torch.Tensor
    opacity: torch.Tensor
    color: torch.Tensor
    name: str = "transfer function"

    def __post_init__(self) -> None:
        for key in ("scalar", "opacity", "color"):
            name = f"The {key} of the transfer function '{self.name}'"
            object.__setattr__(self, key, as_reals(getattr(self, key), name, CaptureError, torch.float32))
        count = self.scalar.numel()
        if count < 1 or self.scalar.dim() != 1:
            raise CaptureError(f"The transfer function '{self.name}' has no control points; give at least one.")
        if self.opacity.shape != (count,) or self.color.shape != (count, 3):
            raise CaptureError(
                f"The transfer function '{self.name}' has {count} scalars but opacities of shape "
                f"{tuple(self.opacity.shape)} and colours of shape {tuple(self.color.shape)}; "
                f"give ({count},) and ({count}, 3)."
            )
        self._check(~((self.scalar >= 0) & (self.scalar <= 1)), "a scalar outside [0, 1]")
        steps = torch.cat([torch.zeros_like(self.scalar[:1]), self.scalar.diff()])
        self._check(steps < 0, "a scalar smaller than the one before; sort the points by scalar")
        self._check(~((self.opacity >= 0) & (self.opacity <= 1)), "an opacity outside [0, 1]")
        self._check(
            ~(torch.isfinite(self.color) & (self.color >= 0)).all(dim=1), "a colour that is negative or not finite"
        )

    def _check(self, wrong: torch.Tensor, what: str) -> None:
        if bool(wrong.any()):
            first = int(wrong.nonzero()[0])
            raise CaptureError(f"Control point {first} of the transfer function '{self.name}' has {what}.")

    def __call__(self, scalar: Values) -> tuple[Values, Values]:
        """Colour and opacity at scalars; the torch version is differentiable in the scalars and in the knots' values.

        Args:
            scalar: (...) scalars, a NumPy array or a tensor.

        Returns:
            Colour (..., 3) and opacity (...), of the same kind and precision as ``scalar``.

        Raises:
            CaptureError: These are no real numbers.
        """
        require_type(scalar, (np.ndarray, torch.Tensor), "The scalar", "pass an array or a tensor", CaptureError)
        if isinstance(scalar, np.ndarray):
            color, opacity = self(as_reals(np.ascontiguousarray(scalar), "The scalar", CaptureError))
            return color.numpy(), opacity.numpy()
        scalar = as_reals(scalar, "The scalar", CaptureError)
        knots = self.scalar.to(scalar)
        last = knots.numel() - 1
        right = torch.searchsorted(knots.detach(), scalar.detach().contiguous(), right=True)
        lower, upper = (right - 1).clamp(min=0), right.clamp(max=last)
        width = knots[upper] - knots[lower]
        inside = width > 0
        weight = torch.where(inside, (scalar - knots[lower]) / torch.where(inside, width, 1.0), 0.0)
        opacity_knots, color_knots = self.opacity.to(scalar), self.color.to(scalar)
        opacity = torch.lerp(opacity_knots[lower], opacity_knots[upper], weight)
        color = torch.lerp(color_knots[lower], color_knots[upper], weight[..., None])
        return color, opacity

    def is_transparent(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Whether the opacity is zero everywhere on scalar intervals.

        Args:
            lower: (...) lower ends of the intervals.
            upper: (...) upper ends, >= ``lower``.

        Returns:
            (...) bool.
        """
        knots = self.scalar.detach().cpu().numpy()
        visible_before = np.concatenate([[0], np.cumsum(self.opacity.detach().cpu().numpy() > 0)])
        first, behind = np.searchsorted(knots, lower, side="left"), np.searchsorted(knots, upper, side="right")
        return (visible_before[behind] == visible_before[first]) & (self(lower)[1] == 0) & (self(upper)[1] == 0)

    @staticmethod
    def default() -> TransferFunction:
        """Blue over white to red, the more opaque the greater the scalar: for a first look."""
        color = [(0.03, 0.09, 0.55), (0.25, 0.55, 0.85), (0.9, 0.9, 0.9), (0.85, 0.4, 0.2), (0.5, 0.02, 0.03)]
        scalar, opacity = torch.linspace(0.0, 1.0, 5), torch.tensor([0.0, 0.04, 0.12, 0.3, 0.7])
        return TransferFunction(scalar, opacity, torch.tensor(color), "default")

    @staticmethod
    def load(path: str | Path) -> TransferFunction:
        """Read a ``.json`` or ``.xml`` transfer function, see :meth:`from_json` and :meth:`from_xml`.

        Raises:
            CaptureError: The file is missing, of another kind, or not valid.
        """
        require_type(path, (str, Path), "The file of the transfer function", "pass its path", CaptureError)
        suffix = Path(path).suffix.lower()
        if suffix == ".json":
            return TransferFunction.from_json(path)
        if suffix == ".xml":
            return TransferFunction.from_xml(path)
        raise CaptureError(f"'{path}' is no transfer function that can be read; {_HINT}.")

    @staticmethod
    def from_json(path: str | Path) -> TransferFunction:
        """Read an object with ``scalar`` (K), ``opacity`` (K) and ``color`` or ``color_srgb`` (K x 3) lists.

        Colours are taken as they are stored and as linear RGB, whichever of the two names they carry, as the
        published experiments do.

        Raises:
            CaptureError: The file is missing or not valid.
        """
        try:
            content = json.loads(_read(path))
        except (ValueError, RecursionError):
            raise CaptureError(f"The transfer function '{path}' is not valid JSON; {_HINT}.") from None
        content = content if isinstance(content, dict) else {}
        missing = [key for key in ("scalar", "opacity") if key not in content]
        if "color" not in content and "color_srgb" not in content:
            missing.append("color")
        if missing:
            raise CaptureError(f"The transfer function '{path}' has no '{missing[0]}' list; {_HINT}.")
        content.setdefault("color", content.get("color_srgb"))
        lists = []
        for key in ("scalar", "opacity", "color"):
            try:
                with np.errstate(over="ignore"):  # The infinity that a number over 3e38 becomes is told below.
                    lists.append(torch.tensor(np.array(content[key], dtype=np.float32)))
            except (ValueError, TypeError, OverflowError, RecursionError):
                raise CaptureError(f"'{key}' in the transfer function '{path}' is not a list of numbers.") from None
        scalar, opacity, color = lists
        name = content.get("name")
        return TransferFunction(scalar, opacity, color, name if isinstance(name, str) else str(path))

    @staticmethod
    def from_xml(path: str | Path) -> TransferFunction:
        """Read the XML format of the original's tools (DiffTetVR, DiffDVR exports, LineVis and others).

        Opacity and colour points have positions of their own; the knots are the union of both. ``color_data`` is
        ``ubyte`` (the default), ``ushort``, ``float`` or ``float_255``. Colours are taken as they are stored and
        interpolated linearly, whatever colour space the file names, as for JSON.

        Raises:
            CaptureError: The file is missing or not valid.
        """
        try:
            root = ElementTree.fromstring(_read(path))
        except (ElementTree.ParseError, ValueError):
            raise CaptureError(f"The transfer function '{path}' is not valid XML; {_HINT}.") from None
        if root.tag != "TransferFunction":
            raise CaptureError(
                f"'{path}' has the root <{root.tag}>, a transfer function has <TransferFunction>; {_HINT}."
            )
        colors = root.find("ColorPoints")
        encoding = "ubyte" if colors is None else (colors.get("color_data") or colors.get("type") or "ubyte")
        if encoding not in _XML_COLOR_MAXIMUM:
            known = ", ".join(_XML_COLOR_MAXIMUM)
            raise CaptureError(f"The transfer function '{path}' stores colours as '{encoding}'; known are {known}.")
        opacity_points = _xml_points(path, root, "OpacityPoint", ("position", "opacity"))
        color_points = _xml_points(path, root, "ColorPoint", ("position", "r", "g", "b"))
        color_points[:, 1:] /= _XML_COLOR_MAXIMUM[encoding]
        return TransferFunction.joined(opacity_points, color_points, str(path))

    @staticmethod
    def joined(opacity_points: np.ndarray, color_points: np.ndarray, name: str) -> TransferFunction:
        """One whose opacity and colour have points of their own: the knots are the union of both.

        Args:
            opacity_points: (K, 2) scalars, not decreasing, and opacities there; two at one scalar are a jump.
            color_points: (L, 4) scalars and linear RGB there, likewise.
            name: What to call it.

        Raises:
            CaptureError: A value is out of range.
        """
        knots = _union_of_knots(opacity_points[:, 0], color_points[:, 0])
        opacity, color = _resample(knots, opacity_points)[:, 0], _resample(knots, color_points)
        scalar = torch.tensor(knots[:, 0], dtype=torch.float32)
        return TransferFunction(scalar, torch.tensor(opacity).float(), torch.tensor(color).float(), name)

    def save(self, path: str | Path) -> None:
        """Write it as JSON that :meth:`from_json` reads back to the bit.

        Raises:
            CaptureError: The file cannot be written.
        """
        content: dict[str, Any] = {"name": self.name}
        for key in ("scalar", "opacity", "color"):
            content[key] = getattr(self, key).detach().cpu().tolist()
        with atomic_write(path, CaptureError) as temporary:
            Path(temporary).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _read(path: str | Path) -> str:
    require_regular(Path(path), CaptureError)
    try:
        return Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise CaptureError(f"The transfer function '{path}' is not a text file; {_HINT}.") from None
    except OSError as error:
        raise CaptureError(f"Cannot read the transfer function '{path}': {error.strerror or error}.") from None


def _xml_points(path: str | Path, root: ElementTree.Element, tag: str, keys: tuple[str, ...]) -> np.ndarray:
    """(K, len(keys)) numbers of the points of one kind, in the file's order."""
    rows = []
    for index, point in enumerate(root.iterfind(f"{tag}s/{tag}")):
        try:
            row = [float(point.attrib[key]) for key in keys]
        except (KeyError, ValueError):
            row = [math.nan]
        if not all(math.isfinite(v) for v in row):
            needed = ", ".join(keys)
            raise CaptureError(f"<{tag}> {index} of the transfer function '{path}' needs numbers for {needed}.")
        rows.append(row)
    if not rows:
        raise CaptureError(f"The transfer function '{path}' has no <{tag}>; {_HINT}.")
    points = np.array(rows)
    if (np.diff(points[:, 0]) < 0).any():
        raise CaptureError(f"The <{tag}> positions of the transfer function '{path}' decrease; sort them by position.")
    return points


def _union_of_knots(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(K, 2) positions of a common refinement and, for each, the side it is approached from (-1 left, 1 right).

    A position where either function jumps appears twice, once for each side.
    """
    knots = []
    for position in np.union1d(first, second):
        jumps = max((first == position).sum(), (second == position).sum()) > 1
        knots += [(position, -1.0), (position, 1.0)] if jumps else [(position, 1.0)]
    return np.array(knots)


def _resample(knots: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(K, C) values of the piecewise-linear function through ``points`` at one-sided ``knots``."""
    positions, values = points[:, 0], points[:, 1:]
    from_right = np.searchsorted(positions, knots[:, 0], side="right")
    from_left = np.searchsorted(positions, knots[:, 0], side="left")
    right_of = np.where(knots[:, 1] > 0, from_right, from_left)
    lower, upper = np.maximum(right_of - 1, 0), np.minimum(right_of, len(positions) - 1)
    width = positions[upper] - positions[lower]
    weight = np.where(width > 0, (knots[:, 0] - positions[lower]) / np.where(width > 0, width, 1.0), 0.0)
    return cast(np.ndarray, values[lower] + weight[:, None] * (values[upper] - values[lower]))
