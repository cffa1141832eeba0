"""Line integrals of voxels in float64 NumPy, ray by ray, that share no code with the kernel."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from difftetvr.rendering import Detector


def rays_of(detector: Detector, view: int) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Origins and unit directions (H, W, 3) of one view, from the definition of `Detector`; where they begin and end.

    Ends are multiples of the distance from origin to pixel.
    """
    center, columns, rows = (part[view].double().numpy() for part in (detector.center, detector.columns, detector.rows))
    pixels = np.zeros((detector.height, detector.width, 3))
    for j in range(detector.height):
        for i in range(detector.width):
            pixels[j, i] = center + (i + 0.5 - detector.width / 2) * columns + (j + 0.5 - detector.height / 2) * rows
    if detector.source is not None:
        source = detector.source[view].double().numpy()
        return np.broadcast_to(source, pixels.shape), pixels - source, 0.0, 1.0
    assert detector.direction is not None
    return pixels, np.broadcast_to(detector.direction[view].double().numpy(), pixels.shape), -np.inf, np.inf


def project(values: np.ndarray, bounds: np.ndarray, detector: Detector, view: int, linear: bool) -> np.ndarray:
    """(H, W) integrals of one view: sums over the pieces between all planes that a ray crosses."""
    origins, directions, begin, end = rays_of(detector, view)
    image = np.zeros(origins.shape[:2])
    for place in np.ndindex(image.shape):
        image[place] = integral(values, bounds, origins[place], directions[place], (begin, end), linear)
    return image


def integral(
    values: np.ndarray,
    bounds: np.ndarray,
    origin: np.ndarray,
    direction: np.ndarray,
    ends: tuple[float, float],
    linear: bool,
) -> float:
    counts = np.array(values.shape)
    sides = (bounds[1] - bounds[0]) / counts
    o, d = (origin - bounds[0]) / sides, direction / sides
    with np.errstate(divide="ignore", invalid="ignore"):
        entries = np.sort(np.stack([-o / d, (counts - o) / d]), axis=0)
    for axis in range(3):
        if d[axis] == 0:
            if not 0 <= o[axis] < counts[axis]:
                return 0.0
            entries[:, axis] = -np.inf, np.inf
    near, far = max(entries[0].max(), ends[0]), min(entries[1].min(), ends[1])
    if far <= near:
        return 0.0
    # Faces of voxels, and where values are linear between middles these, too.
    planes = [np.arange(0, n + 0.25, 0.5 if linear else 1.0) for n in counts]
    crossings = [(p - o[a]) / d[a] for a, p in enumerate(planes) if d[a] != 0]
    t = np.unique(np.concatenate([[near, far], *[c[(c > near) & (c < far)] for c in crossings]]))
    length = np.diff(t) * np.linalg.norm(direction)
    if not linear:
        middles = o + 0.5 * (t[1:] + t[:-1])[:, None] * d
        index = np.clip(np.floor(middles).astype(int), 0, counts - 1)
        return float(length @ values[tuple(index.T)])
    # Simpson's rule is exact for cubic polynomials.
    places = [o + s[:, None] * d - 0.5 for s in (t[:-1], 0.5 * (t[1:] + t[:-1]), t[1:])]
    found = [ndimage.map_coordinates(values, p.T, order=1, mode="nearest") for p in places]
    return float(length @ (found[0] + 4 * found[1] + found[2]) / 6)
