"""From counts to line integrals: Beer and Lambert's law, with flat and dark fields, and what no pixel can tell."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from difftetvr.capture.projections.noise import estimated_noise, log_variance
from difftetvr.errors import CaptureError, counted, shown

_GREATEST = 1e30  # count, so that squares of counts are numbers
_LEAST_TRANSMISSION = 1e-15  # of what is taken for light, and not for rounding
_LEAST_UNITS, _FEWEST_UNITS = 0.05, 1e-3  # noise in units of that of photons: with less, counts are none; at least


class Absorbed(NamedTuple):
    """Line integrals of intensities.

    Attributes:
        line_integrals: (V, H, W) float32; the greatest valid one where a pixel cannot tell.
        variance: (V, H, W) float32.
        valid: (V, H, W) bool.
        notes: What was clamped, a sentence each.
    """

    line_integrals: np.ndarray
    variance: np.ndarray
    valid: np.ndarray
    notes: tuple[str, ...]


def absorbed(intensities: np.ndarray, flat: Any, dark: Any, sigma: float, name: str) -> Absorbed:
    """Line integrals -log((I - dark) / (flat - dark)), in float64 view by view.

    Pixels that are dead, those whose flat field is not brighter than the dark one, are not valid in any view; those
    that count nothing, or something else than a finite number, not in that view. The noise is that of photons, one for
    each count, of the view and of the mean of the flat and the dark frames, and of the electronics. Where there is far
    less of it, counts are not photons, and variances are those of the noise that there is.

    Args:
        intensities: (V, H, W) counts.
        flat: Counts without an object: one number, (H, W) or (F, H, W).
        dark: Counts without rays, likewise; None for 0.
        sigma: Standard deviation of the electronics' noise in counts.
        name: Of the scan, for sentences.

    Raises:
        CaptureError: Shapes do not fit, or no pixel tells anything.
    """
    bright, bright_frames = _field(flat, intensities.shape, "flat", name)
    black, black_frames = _field(0.0 if dark is None else dark, intensities.shape, "dark", name)
    with np.errstate(invalid="ignore", over="ignore"):
        light = bright - black
        dead = ~((light > 1 / _GREATEST) & (light < _GREATEST))
    if dead.all():
        raise CaptureError(f"The flat field of '{name}' is nowhere brighter than its dark field; check which is which.")
    open_beam = np.where(dead, 1.0, light)
    background = (np.where(dead, 1.0, bright) + sigma**2) / (bright_frames * open_beam**2)
    line_integrals = np.zeros(intensities.shape, dtype=np.float32)
    variance, valid = np.ones_like(line_integrals), np.zeros(intensities.shape, dtype=bool)
    for view, into, spread, kept in zip(intensities, line_integrals, variance, valid):
        with np.errstate(invalid="ignore", over="ignore"):
            signal = view.astype(np.float64) - black
            kept[:] = (signal > _LEAST_TRANSMISSION * open_beam) & (signal < _GREATEST) & ~dead
        signal = np.where(kept, signal, 1.0)
        into[:] = np.where(kept, np.log(open_beam) - np.log(signal), 0.0)
        # The dark frames' own noise is that of the electronics, and small.
        noise = log_variance(signal, sigma) + sigma**2 / (black_frames * signal**2) + background
        spread[:] = np.where(kept, np.minimum(noise, _GREATEST), 1.0)
    if not valid.any():
        raise CaptureError(f"No pixel of '{name}' counts more than its dark field; check which arrays are which.")
    line_integrals[~valid] = line_integrals[valid].max()
    notes = _notes(dead, valid, name)
    units = _noise_in_units(line_integrals, variance, valid)
    if units is not None and units < _LEAST_UNITS:
        # Photons make more noise, also where a detector spreads them over neighbours and differences miss some of it.
        variance *= max(units, _FEWEST_UNITS) ** 2
        notes.append(
            f"The noise of '{name}' is {units:.2g} times that of one photon for each count, as of transmissions or "
            "averages; variances are taken so much smaller."
        )
    return Absorbed(line_integrals, variance, valid, tuple(notes))


def _noise_in_units(line_integrals: np.ndarray, variance: np.ndarray, valid: np.ndarray) -> float | None:
    """Noise of line integrals in standard deviations of its model; None where it cannot be told."""
    known = torch.from_numpy(np.where(valid, line_integrals, np.nan))
    found = estimated_noise(known, torch.from_numpy(variance))
    return found if found is None or found > 0.0 else None


def _notes(dead: np.ndarray, valid: np.ndarray, name: str) -> list[str]:
    notes = []
    if count := int(dead.sum()):
        of = f"of {dead.size:,} " if dead.ndim else ""
        notes.append(f"{counted(count, 'pixel')} {of}of '{name}' see no light without an object, and are left out.")
    if others := int((~valid & ~dead).sum()):
        verb = "counts" if others == 1 else "count"
        notes.append(
            f"{counted(others, 'pixel')} of {valid.size:,} in all views of '{name}' {verb} nothing, and are left out."
        )
    return notes


def _field(given: Any, shape: tuple[int, ...], what: str, name: str) -> tuple[np.ndarray, int]:
    """(H, W) float64 or a number: the mean of frames, and how many there were."""
    array = np.asarray(given)
    is_real = array.dtype.kind in "iuf"
    if is_real and array.ndim == 3 and array.shape[1:] == shape[1:] and len(array):
        with np.errstate(invalid="ignore", over="ignore"):
            return array.mean(axis=0, dtype=np.float64), len(array)
    if not is_real or array.shape not in ((), shape[1:]):
        size = " x ".join(map(str, shape[1:]))
        raise CaptureError(
            f"The {what} field of '{name}' is {shown(array)}; give one number, {size} pixels, or several such frames."
        )
    return array.astype(np.float64), 1
