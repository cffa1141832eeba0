"""How projections were taken: where source and detector were in each view, and which box is to be reconstructed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.capture.projections.coverage import require_sight
from difftetvr.capture.projections.descriptions.astra import is_astra, parse_astra
from difftetvr.capture.projections.descriptions.described import Parts, described, parse_described
from difftetvr.capture.projections.descriptions.entries import read_json
from difftetvr.capture.projections.descriptions.tigre import is_tigre, parse_tigre
from difftetvr.errors import CaptureError, counted, shown
from difftetvr.inputs import as_reals, require_type
from difftetvr.rendering.cameras.detector import Detector

_VECTORS = ("source", "direction", "center", "columns", "rows")


@dataclass(frozen=True, eq=False)
class ProjectionGeometry:
    """Where source and detector were in each of V views, in one unit of length; see "Projections in" in the manual.

    Attributes:
        detector: All V views; vectors that are given once hold for each of them.
        bounds: (2, 3) float64 lower and upper corner of the box to reconstruct; the faces of a volume's outer voxels.
        unit: Of length, such as "mm"; attenuation is per this unit. None if it is not known.
        angles: (V,) float64 degrees around z, for plots and orders of views; None where there are none.

    Raises:
        CaptureError: Shapes do not fit, a value is not finite, or a view sees nothing of the bounds.
    """

    detector: Detector
    bounds: torch.Tensor
    unit: str | None = None
    angles: torch.Tensor | None = None

    def __post_init__(self) -> None:
        require_type(self.detector, Detector, "detector", "pass a difftetvr.Detector", CaptureError)
        if self.unit is not None:
            require_type(self.unit, str, "unit", "pass the name of a unit of length, or None", CaptureError)
        bounds = as_reals(self.bounds, "bounds", CaptureError, torch.float64, "pass two corners").detach()
        bounds = bounds.to("cpu", torch.float64)
        is_box = bounds.shape == (2, 3) and bool(torch.isfinite(bounds).all() and (bounds[0] < bounds[1]).all())
        if not is_box:
            raise CaptureError(
                f"bounds is {shown(self.bounds)}; pass a lower and, greater in all axes, an upper corner."
            )
        object.__setattr__(self, "bounds", bounds)
        object.__setattr__(self, "detector", _expanded(self.detector))
        require_sight(self.detector, bounds)
        if self.angles is not None:
            angles = as_reals(self.angles, "angles", CaptureError, torch.float64).detach().to("cpu", torch.float64)
            if angles.shape != (self.num_views,) or not bool(torch.isfinite(angles).all()):
                views = counted(self.num_views, "view")
                raise CaptureError(f"angles is {shown(self.angles)}; pass finite degrees, one for each of {views}.")
            object.__setattr__(self, "angles", angles)

    @property
    def num_views(self) -> int:
        """How many views there are, V."""
        return int(self.detector.center.shape[0])

    @property
    def shape(self) -> tuple[int, int, int]:
        """(V, H, W) of the projections: views, rows, columns."""
        return self.num_views, self.detector.height, self.detector.width

    def view(self, index: int) -> Detector:
        """The detector in one view; rendering through it makes one image.

        Raises:
            CaptureError: There is no such view.
        """
        if not -self.num_views <= index < self.num_views:
            raise CaptureError(f"There is no view {index} of {self.num_views}.")
        return _with_vectors(self.detector, lambda vector: vector[index])

    def select(self, indices: Sequence[int] | torch.Tensor) -> ProjectionGeometry:
        """The same geometry of some views.

        Args:
            indices: Of the views, in any order; or (V,) bool.

        Raises:
            CaptureError: There is none, or one of them is out of range.
        """
        chosen = torch.arange(self.num_views)
        try:
            chosen = chosen[torch.as_tensor(indices).cpu()].reshape(-1)
        except (IndexError, TypeError, ValueError, RuntimeError):
            raise CaptureError(f"{shown(indices)} are no views of {self.num_views}; pass their numbers.") from None
        if not len(chosen):
            raise CaptureError("No view is selected; pass at least one.")
        detector = _with_vectors(self.detector, lambda vector: vector[chosen.to(vector.device)])
        return ProjectionGeometry(
            detector, self.bounds, self.unit, None if self.angles is None else self.angles[chosen]
        )

    def to_dict(self) -> dict[str, Any]:
        """The geometry as JSON has it, each view by its vectors; `from_dict` reads back the same, to the last bit."""
        return described(self.detector, self.bounds, self.unit, self.angles)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> ProjectionGeometry:
        """The geometry that a dictionary tells: ours, or one of TIGRE or ASTRA as plain numbers and lists.

        Raises:
            CaptureError: An entry is missing, unknown or out of range, or a view sees nothing of the bounds.
        """
        return geometry_of(parse_parts(values, "The geometry"))

    @staticmethod
    def load(path: str | Path) -> ProjectionGeometry:
        """Read a geometry file in JSON: ours, or what TIGRE or ASTRA keep as a dictionary.

        Raises:
            CaptureError: It cannot be read, or as `from_dict`.
        """
        require_type(path, (str, PathLike), "The path of the geometry", "give the name of a file", CaptureError)
        return geometry_of(load_parts(Path(path)), path)


def load_parts(path: Path) -> Parts:
    """What a geometry file tells, with how arrays beside it are laid out.

    Raises:
        CaptureError: It cannot be read, or an entry is missing, unknown or out of range.
    """
    if path.suffix.lower() in (".yml", ".yaml"):
        raise CaptureError(f"'{path}' is YAML, which is not read; write the same entries as JSON.")
    return parse_parts(read_json(path, "geometry"), f"'{path}'")


def parse_parts(values: Any, source: str) -> Parts:
    """What a dictionary of any of the dialects tells.

    Raises:
        CaptureError: An entry is missing, unknown or out of range.
    """
    if is_astra(values):
        return parse_astra(values, source)
    if is_tigre(values):
        return parse_tigre(values, source)
    return parse_described(values, source)


def geometry_of(parts: Parts, path: str | Path | None = None) -> ProjectionGeometry:
    """A checked geometry.

    Args:
        parts: What it is made of.
        path: The file that these come from, for sentences.

    Raises:
        CaptureError: A view sees nothing of the bounds.
    """
    angles = None if parts.angles is None or parts.angles.ndim != 1 else torch.from_numpy(np.array(parts.angles))
    try:
        return ProjectionGeometry(parts.detector, torch.from_numpy(np.array(parts.bounds)), parts.unit, angles)
    except CaptureError as error:
        if path is None:
            raise
        raise CaptureError(f"'{path}': {error}") from error


def _expanded(detector: Detector) -> Detector:
    """The same detector with all vectors for each view."""
    given = (vector for name in _VECTORS if (vector := getattr(detector, name)) is not None)
    count = max(vector.shape[0] if vector.ndim == 2 else 1 for vector in given)
    return _with_vectors(detector, lambda vector: vector.expand(count, 3))


def _with_vectors(detector: Detector, change: Any) -> Detector:
    vectors: dict[str, Any] = {name: getattr(detector, name) for name in _VECTORS}
    changed: dict[str, Any] = {name: None if vector is None else change(vector) for name, vector in vectors.items()}
    return dataclasses.replace(detector, **changed)
