"""Projections to reconstruct from: line integrals, how sure they are, and which views are held out."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.capture.projections.geometry import ProjectionGeometry
from difftetvr.capture.projections.intensities import absorbed
from difftetvr.capture.projections.raw_scan import RawScan, ScanOptions
from difftetvr.capture.projections.readers.table import read_scan
from difftetvr.capture.projections.scan_file import write_scan
from difftetvr.errors import CaptureError, CaptureWarning, shown
from difftetvr.inputs import as_reals, require_type


@dataclass(frozen=True, eq=False)
class ProjectionCapture:
    """Measured or made projections of an object that absorbs, V views of H rows and W columns.

    Attributes:
        geometry: Where source and detector were, the box to reconstruct, and the unit of length.
        line_integrals: (V, H, W) float32, integrals of the attenuation along the rays to the pixels: numbers without a
            unit, so that attenuation is per unit of the geometry. Noise may make them negative.
        variance: (V, H, W) float32 > 0 of the line integrals by the model of their noise; None where that is not known.
        valid: (V, H, W) bool, false for pixels that no loss should count: dead ones, and those that counted nothing.
            None where all are valid.
        test: (V,) bool, views that reconstruction never sees.
        name: What to call the capture.

    Raises:
        CaptureError: Shapes do not match the geometry, a valid value is not finite, or nothing is left to reconstruct
            from.
    """

    geometry: ProjectionGeometry
    line_integrals: torch.Tensor
    variance: torch.Tensor | None = None
    valid: torch.Tensor | None = None
    test: torch.Tensor = None  # type: ignore[assignment]  # becomes a mask
    name: str = "scan"

    def __post_init__(self) -> None:
        require_type(self.geometry, ProjectionGeometry, "geometry", "pass a ProjectionGeometry", CaptureError)
        require_type(self.name, str, "name", "pass a text", CaptureError)
        values = self._of_pixels("line_integrals", self.line_integrals)
        valid = self._mask("valid", self.valid, self.geometry.shape)
        kept = slice(None) if valid is None else valid
        if valid is not None and not bool(valid.any()):
            raise CaptureError(f"No pixel of '{self.name}' is valid; check the mask.")
        self._require_finite("line_integrals", values, valid)
        object.__setattr__(self, "line_integrals", values)
        object.__setattr__(self, "valid", valid)
        if self.variance is not None:
            variance = self._of_pixels("variance", self.variance)
            self._require_finite("variance", variance, valid)
            if not bool((variance[kept] > 0).all()):
                raise CaptureError(f"The variance of '{self.name}' must be greater than 0 in all valid pixels.")
            object.__setattr__(self, "variance", variance)
        test = self._mask("test", self.test, self.geometry.shape[:1])
        test = torch.zeros(self.geometry.num_views, dtype=torch.bool) if test is None else test
        if bool(test.all()):
            raise CaptureError(f"All views of '{self.name}' are held out for testing; leave some to reconstruct from.")
        object.__setattr__(self, "test", test)

    @property
    def train_indices(self) -> torch.Tensor:
        """Numbers of the views to reconstruct from."""
        return torch.nonzero(~self.test).reshape(-1)

    @property
    def test_indices(self) -> torch.Tensor:
        """Numbers of the views that are held out."""
        return torch.nonzero(self.test).reshape(-1)

    def select(self, indices: Any) -> ProjectionCapture:
        """The same capture with some of its views.

        Args:
            indices: Of the views, in any order; or (V,) bool.

        Raises:
            CaptureError: There is none, one is out of range, or all of them are held out.
        """
        geometry = self.geometry.select(indices)
        chosen = torch.arange(self.geometry.num_views)[torch.as_tensor(indices).cpu()].reshape(-1)
        parts = {n: getattr(self, n) for n in ("line_integrals", "variance", "valid", "test")}
        taken: dict[str, Any] = {name: None if part is None else part[chosen] for name, part in parts.items()}
        return dataclasses.replace(self, geometry=geometry, **taken)

    @staticmethod
    def from_intensities(
        geometry: ProjectionGeometry,
        counts: Any,
        flat: Any,
        dark: Any = None,
        *,
        gaussian: float = 0.0,
        test: torch.Tensor | None = None,
        name: str = "scan",
    ) -> ProjectionCapture:
        """Projections of counts by Beer and Lambert's law, -log((counts - dark) / (flat - dark)).

        Pixels that count nothing, and those that are dead, are not valid, which a warning counts. The variance is that
        of photons, one for each count, and of the electronics; where a count is several photons or a part of one, it
        is so in all pixels, and only the proportions of the variances are right, unless the noise is less than a
        twentieth of that of photons: then they are made to fit it, with a warning.

        Args:
            geometry: Of the V views.
            counts: (V, H, W) intensities.
            flat: Intensities without an object: one number, (H, W), or (F, H, W) frames, whose mean counts.
            dark: Intensities without rays, likewise; None for 0.
            gaussian: Standard deviation of the electronics' noise, in counts.
            test: (V,) bool, views that are held out; None for none.
            name: What to call the capture.

        Raises:
            CaptureError: Shapes do not fit, no pixel tells anything, or as for the class.

        Warns:
            CaptureWarning: Pixels are left out, or counts are no photons.
        """
        raw = RawScan(geometry, intensities=_array(counts, "counts"), flat=flat, dark=dark)
        return _captured(raw, name, gaussian, test)

    @staticmethod
    def load(path: str | Path, holdout_every: int | None = None, **options: Any) -> ProjectionCapture:
        """Read projections, whatever wrote them.

        Args:
            path: ``.npz`` or ``.h5`` of our own, a Data Exchange ``.h5``, a folder with ``meta_data.json`` as
                R2-Gaussian has, or a ``.npy`` with the geometry as ``.json`` beside it, ours or TIGRE's or ASTRA's.
            holdout_every: One of so many views is held out, from the middle of the first so many, besides those that
                the file holds out; None or 0 for none.
            **options: ``geometry``, path of the geometry of a ``.npy``; ``center``, ``pixel_size`` and ``unit`` of a
                Data Exchange file: where the axis is seen, in pixels from the left edge, and the distance of pixels;
                ``gaussian``, the standard deviation of the electronics' noise in counts.

        Raises:
            CaptureError: The file is missing, damaged or of an unknown kind, an option is not known, or as for the
                class.

        Warns:
            CaptureWarning: Pixels are left out, or a reader had to choose.
        """
        require_type(path, (str, PathLike), "The path of the scan", "give the name of a file or folder", CaptureError)
        known = [field.name for field in dataclasses.fields(ScanOptions)]
        if unknown := sorted(set(options) - set(known)):
            raise CaptureError(f"A scan has no setting '{unknown[0]}'; known are {', '.join(known)}.")
        chosen = ScanOptions(**options)
        raw = read_scan(Path(path), chosen)
        held_out = np.zeros(raw.geometry.num_views, dtype=bool) if raw.test is None else np.asarray(raw.test) != 0
        if held_out.shape == (raw.geometry.num_views,):
            held_out = held_out | ProjectionCapture.held_out(holdout_every, len(held_out)).numpy()
        name = Path(path).resolve().name.split(".")[0]
        return _captured(raw, name, chosen.gaussian, torch.from_numpy(held_out))

    @staticmethod
    def held_out(every: int | None, views: int) -> torch.Tensor:
        """(V,) bool, one of so many views, from the middle of the first so many; None or 0 for none.

        Raises:
            CaptureError: The number is 1, negative, or greater than that of the views.
        """
        if every is None or every == 0:
            return torch.zeros(views, dtype=torch.bool)
        if isinstance(every, bool) or not isinstance(every, int) or not 2 <= every <= views:
            least = f", or 2 to {views}" if views > 1 else ""
            raise CaptureError(
                f"holdout_every is {shown(every)}: one of so many views cannot be held out of {views}; give 0{least}."
            )
        return torch.arange(views) % every == every // 2

    def save(self, path: str | Path) -> None:
        """Writes the capture as ``.npz`` or, with the package h5py, as ``.h5``; `load` reads back the same.

        Raises:
            CaptureError: The suffix is another, or the file cannot be written.
        """
        write_scan(path, self.geometry.to_dict(), self._arrays())

    def _arrays(self) -> dict[str, np.ndarray]:
        tensors = {name: getattr(self, name) for name in ("line_integrals", "variance", "valid", "test")}
        return {name: tensor.cpu().numpy() for name, tensor in tensors.items() if tensor is not None}

    def _of_pixels(self, what: str, given: Any) -> torch.Tensor:
        values = as_reals(given, f"The {what} of '{self.name}'", CaptureError).detach().to("cpu", torch.float32)
        if tuple(values.shape) != self.geometry.shape:
            views, height, width = self.geometry.shape
            raise CaptureError(
                f"The {what} of '{self.name}' have shape {tuple(values.shape)}, but the geometry has {views} views of "
                f"{height} rows and {width} columns; correct either."
            )
        return values

    def _mask(self, what: str, given: Any, shape: tuple[int, ...]) -> torch.Tensor | None:
        if given is None:
            return None
        mask = given if isinstance(given, torch.Tensor) else torch.as_tensor(_array(given, what))
        if tuple(mask.shape) != shape or mask.is_floating_point() or mask.is_complex():
            raise CaptureError(f"The mask '{what}' of '{self.name}' is {shown(given)}; pass bool of shape {shape}.")
        return mask.detach().cpu() != 0

    def _require_finite(self, what: str, values: torch.Tensor, valid: torch.Tensor | None) -> None:
        wrong = ~torch.isfinite(values)
        if valid is not None:
            wrong &= valid
        if bool(wrong.any()):
            view, row, column = torch.nonzero(wrong)[0].tolist()
            value = float(values[view, row, column])
            raise CaptureError(
                f"The {what} of '{self.name}' hold {value} in view {view} at row {row}, column {column}; correct it, "
                "or mark such pixels as not valid."
            )


def _captured(raw: RawScan, name: str, sigma: float, test: torch.Tensor | None) -> ProjectionCapture:
    """The capture of what was read; says what there is to know."""
    notes, values, variance, valid = raw.notes, raw.line_integrals, raw.variance, raw.valid
    if valid is not None and valid.dtype.kind not in "biu" and not np.isin(valid, (0, 1)).all():
        raise CaptureError(f"The mask 'valid' of '{name}' holds more than 0 and 1; store truth values.")
    if values is None:
        counts = _array(raw.intensities, "intensities")
        if counts.shape != raw.geometry.shape:
            raise CaptureError(
                f"The intensities of '{name}' have shape {counts.shape}, but the geometry has {raw.geometry.shape}; "
                "correct either."
            )
        found = absorbed(counts, raw.flat, raw.dark, sigma, name)
        notes, values, variance = (*notes, *found.notes), found.line_integrals, found.variance
        if valid is None or valid.shape == found.valid.shape:  # others are refused as all masks of another shape
            valid = found.valid if valid is None else found.valid & (valid != 0)
    values = _array(values, "line_integrals")
    for note in notes:
        warnings.warn(note, CaptureWarning, stacklevel=3)
    everywhere = valid is None or (valid.shape == raw.geometry.shape and bool(np.all(valid)))
    return ProjectionCapture(
        raw.geometry,
        torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32)),
        None if variance is None else torch.from_numpy(np.ascontiguousarray(variance, dtype=np.float32)),
        None if everywhere else torch.from_numpy(np.ascontiguousarray(np.asarray(valid) != 0)),
        test,  # type: ignore[arg-type]  # becomes a mask
        name,
    )


def _array(given: Any, what: str) -> np.ndarray:
    """An array of numbers or truth values."""
    try:
        array = given.detach().cpu().numpy() if isinstance(given, torch.Tensor) else np.asarray(given)
    except (TypeError, ValueError, RuntimeError):
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in "biuf":
        raise CaptureError(f"The {what} are {shown(given)}; pass an array of numbers.")
    return array
