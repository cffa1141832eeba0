"""Which cameras of a capture a film runs through, and in which order."""

from __future__ import annotations

import numpy as np

from difftetvr.capture.camera_set import CameraSet
from difftetvr.capture.viewing import Floats
from difftetvr.rendering.cameras.pinhole import Camera

_FRAMES_EACH = 12  # from one camera to the next, so that these can be seen
_FEWEST = 5
_DETOUR = 1.5  # how much longer the order of the files may be than the one that is found


def key_cameras_of(cameras: CameraSet, frames: int) -> list[Camera]:
    """Some of the cameras of a capture, for a path through them: one for each twelve frames, five at least.

    They lie evenly spread along a tour of all cameras: in the order of the capture where that hardly makes detours, as
    in a film, else from each camera to the nearest that is left.

    Args:
        cameras: All of them.
        frames: How many frames the film has.
    """
    positions = cameras.positions
    given, found = np.arange(len(positions)), _tour(positions)
    order = given if _length(positions[given]) <= _DETOUR * _length(positions[found]) else found
    passed = np.concatenate([[0.0], np.linalg.norm(np.diff(positions[order], axis=0), axis=1).cumsum()])
    count = min(len(order), max(_FEWEST, round(frames / _FRAMES_EACH)))
    nearest = np.abs(passed[None, :] - np.linspace(0.0, passed[-1], count)[:, None]).argmin(1)
    return [cameras.cameras[order[place]] for place in dict.fromkeys(nearest.tolist())]


def _tour(positions: Floats) -> Floats:
    """(N,) order in which each camera is followed by the nearest of the others; it begins with the outermost."""
    left = np.ones(len(positions), dtype=bool)
    order = [int(np.linalg.norm(positions - positions.mean(0), axis=1).argmax())]
    left[order[0]] = False
    while left.any():
        distance = np.where(left, np.linalg.norm(positions - positions[order[-1]], axis=1), np.inf)
        order.append(int(distance.argmin()))
        left[order[-1]] = False
    return np.array(order)


def _length(positions: Floats) -> float:
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
