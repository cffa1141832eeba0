"""Whether detectors see anything of a box."""

from __future__ import annotations

import itertools

import numpy as np
import torch

from difftetvr.errors import CaptureError, counted
from difftetvr.rendering.cameras.detector import Detector

_FLAT = 1e-6  # of its longest side: what the shorter side of a pixel has at least


def require_sight(detector: Detector, bounds: torch.Tensor) -> None:
    """Checks that rays of each view cross a box.

    Args:
        detector: All views, vectors of (V, 3).
        bounds: (2, 3) corners of the box.

    Raises:
        CaptureError: In a view they do not, the detector is behind its source, or pixels have no area.
    """
    center, columns, rows = (part.detach().cpu().double().numpy() for part in _plane(detector))
    box = bounds.detach().cpu().double().numpy()
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i, j, k in itertools.product((0, 1), repeat=3)])
    normal = np.cross(columns, rows)
    area = np.linalg.norm(normal, axis=-1)
    flat = area <= _FLAT * np.square(np.maximum(np.linalg.norm(columns, axis=-1), np.linalg.norm(rows, axis=-1)))
    _refuse(flat, "has pixels without an area; give two directions that differ")
    if detector.source is not None:
        eye = detector.source.detach().cpu().double().numpy()
        distance = np.einsum("vi,vi->v", center - eye, normal)
        _refuse(np.abs(distance) <= _FLAT * area, "has its source in the plane of its detector; move either")
        rays = corners[None] - eye[:, None]
        ahead = np.einsum("vci,vi->vc", rays, normal) / distance[:, None]  # 0 at the source, 1 at the detector
        behind = (ahead <= 0).all(axis=1)
        _refuse(behind, "looks away from the bounds: its detector is behind the source; exchange their places")
        _refuse((ahead >= 1).all(axis=1), "has the bounds behind its detector; move it away from the source")
        sure = (ahead <= 0).any(axis=1)  # the source is beside the box or in it: some ray hits, or no corner tells
        with np.errstate(divide="ignore", invalid="ignore"):
            places = eye[:, None] + rays / ahead[..., None]
    else:
        assert detector.direction is not None
        along = detector.direction.detach().cpu().double().numpy()
        slope = np.einsum("vi,vi->v", along, normal)
        length = np.linalg.norm(along, axis=-1)
        _refuse(np.abs(slope) <= _FLAT * area * length, "has rays along its detector; turn either")
        depth = np.einsum("vci,vi->vc", center[:, None] - corners[None], normal) / slope[:, None]
        places = corners[None] + depth[..., None] * along[:, None]
        sure = np.zeros(len(center), dtype=bool)
    pixels = _in_pixels(places - center[:, None], columns, rows)
    half = 0.5 * np.array([detector.width, detector.height])
    with np.errstate(invalid="ignore"):
        missed = ((pixels.min(axis=1) >= half) | (pixels.max(axis=1) <= -half)).any(axis=1)
    _refuse(missed & ~sure, "sees nothing of the bounds; check the distances, the offsets and the unit")


def _plane(detector: Detector) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return detector.center, detector.columns, detector.rows


def _in_pixels(places: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(V, C, 2) pixels from the detector's middle, of points in its plane."""
    cc, cr, rr = (np.einsum("vi,vi->v", a, b)[:, None] for a, b in ((columns, columns), (columns, rows), (rows, rows)))
    c, r = (np.einsum("vci,vi->vc", places, axis) for axis in (columns, rows))
    determinant = cc * rr - cr * cr
    return np.stack([(rr * c - cr * r) / determinant, (cc * r - cr * c) / determinant], axis=-1)


def _refuse(wrong: np.ndarray, what: str) -> None:
    if wrong.any():
        first, count = int(np.flatnonzero(wrong)[0]), int(wrong.sum())
        others = f" (as {counted(count - 1, 'other')})" if count > 1 else ""
        raise CaptureError(f"View {first}{others} {what}.")
