"""Turning volumes so that their axes run along the world's, in the same sense and in a right-handed system."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from difftetvr.capture.volumes.volume_file import RawVolume, World
from difftetvr.errors import CaptureError

# Direction cosines are written with about six digits; over a thousand samples this is half of one.
_ROUNDING = 5e-4


def in_world_axes(raw: RawVolume, source: str | Path) -> RawVolume:
    """The same volume with samples and spacing in the order and sense of the world's axes.

    Exchanged and reversed axes are put right exactly. Axes at right angles that are turned against the world's, as of
    most magnetic resonance scans, are taken for the nearest ones of the same handedness, which a note says: the volume
    keeps its shape and is seen turned by as much.

    Args:
        raw: What a reader found.
        source: The file, for the sentences.

    Raises:
        CaptureError: The axes are not at right angles.
    """
    if raw.directions is None:
        return raw
    require_right_angles(raw.directions, source)
    axes, signs = nearest_axes(raw.directions)
    # values[z, y, x]: axis a of the file is dimension 2 - a.
    values = raw.values.transpose([2 - axes.index(axis) for axis in (2, 1, 0)])
    values = np.flip(values, tuple(2 - axes[a] for a in range(3) if signs[a] < 0))
    x, y, z = (raw.spacing[axes.index(axis)] for axis in range(3))
    notes = (*raw.notes, *_tilt(raw.directions, axes, source))
    return RawVolume(values, (x, y, z), None, notes, World(unit=raw.world.unit))


def require_right_angles(directions: np.ndarray, source: str | Path) -> None:
    """Checks that a file's axes are at right angles.

    Args:
        directions: (3, 3) the axes, as `RawVolume` has them.
        source: The file, for the sentence.

    Raises:
        CaptureError: They are not.
    """
    angles = np.abs(directions @ directions.T - np.eye(3))
    if angles.max() > _ROUNDING:
        a, b = np.unravel_index(angles.argmax(), angles.shape)
        degrees = np.degrees(np.arccos(np.clip(directions[a] @ directions[b], -1.0, 1.0)))
        raise CaptureError(
            f"The axes {'xyz'[a]} and {'xyz'[b]} of '{source}' meet at {degrees:.4g} degrees; resample it to a grid "
            "with right angles."
        )


def nearest_axes(directions: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """For each axis of the file the world's axis it runs along, and in which sense: 1 or -1."""
    handedness = np.linalg.det(directions)
    choices = [
        (axes, signs)
        for axes in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
        if np.linalg.det(np.eye(3)[list(axes)]) * np.prod(signs) * handedness > 0
    ]
    return max(choices, key=lambda choice: sum(s * directions[a, w] for a, (w, s) in enumerate(zip(*choice))))


def _tilt(directions: np.ndarray, axes: tuple[int, ...], source: str | Path) -> list[str]:
    """A note on how far the axes are turned against those they are taken for; none where that is rounding."""
    along = np.abs(directions[range(3), axes])
    across = np.sqrt(np.maximum(1.0 - along**2, 0.0))
    if across.max() <= _ROUNDING:
        return []
    degrees = np.degrees(np.arctan2(across, along)).max()
    return [
        f"The axes of '{source}' are turned by {degrees:.3g} degrees against the world's; they are taken for the "
        "nearest ones, so the volume is seen turned by as much."
    ]
