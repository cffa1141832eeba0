"""Camera poses from files: rigid transforms, checked, in OpenCV axes."""

from __future__ import annotations

import numpy as np

from difftetvr.errors import CaptureError

_ROUNDING = 1e-3
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def pose_matrix(values: object, where: str) -> np.ndarray:
    """(4, 4) float64 rigid transform from nested lists or an array; the last row may be missing.

    Rotations are rounded to the nearest exact one, because files hold few digits.

    Args:
        values: (4, 4) or (3, 4) numbers.
        where: What the pose belongs to, for messages.

    Raises:
        CaptureError: It is no such matrix, a value is not finite, or it scales, shears or mirrors.
    """
    try:
        matrix = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # integers of JSON may be larger than any float
        matrix = np.empty(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise CaptureError(f"The pose of {where} is no 4 x 4 matrix of numbers; correct the file.")
    if not np.isfinite(matrix).all():
        raise CaptureError(f"The pose of {where} holds a value that is not finite; correct or remove that view.")
    last_row_is_off = matrix.shape == (4, 4) and np.abs(matrix[3] - (0, 0, 0, 1)).max() > _ROUNDING
    rotation = matrix[:3, :3]
    if last_row_is_off or not _is_rotation(rotation):
        raise CaptureError(
            f"The pose of {where} is not rigid (a rotation without scale or mirror, last row 0 0 0 1); "
            "orthonormalise it first."
        )
    rigid = np.eye(4)
    left, _, right = np.linalg.svd(rotation)
    rigid[:3, :3], rigid[:3, 3] = left @ right, matrix[:3, 3]
    return rigid


def _is_rotation(matrix: np.ndarray) -> bool:
    """Whether a finite matrix is orthonormal and does not mirror, but for rounding."""
    if np.abs(matrix).max() > 1.0 + _ROUNDING:  # squares might overflow
        return False
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= _ROUNDING and np.linalg.det(matrix) > 0)


def inverse(rigid: np.ndarray) -> np.ndarray:
    """(4, 4) inverse of a rigid transform."""
    result = np.eye(4)
    result[:3, :3] = rigid[:3, :3].T
    result[:3, 3] = -rigid[:3, :3].T @ rigid[:3, 3]
    return result


def from_opengl(camera_to_world: object, where: str) -> np.ndarray:
    """(4, 4) world-to-camera in OpenCV axes from camera-to-world in those of OpenGL (+y up, looking along -z).

    Args:
        camera_to_world: (4, 4) or (3, 4) numbers, as NeRF, nerfstudio and instant-ngp store them.
        where: What the pose belongs to, for messages.

    Raises:
        CaptureError: It is no rigid transform.
    """
    return inverse(pose_matrix(camera_to_world, where) @ _OPENGL_TO_OPENCV)


def from_quaternion(quaternion: np.ndarray, translation: np.ndarray, where: str) -> np.ndarray:
    """(4, 4) rigid transform from a unit quaternion (w, x, y, z) and a translation.

    Raises:
        CaptureError: A value is not finite, or the quaternion is not of length 1.
    """
    # No component of a unit quaternion is larger; squares of much larger ones would overflow.
    length = float(np.linalg.norm(quaternion)) if (np.abs(quaternion) < 2.0).all() else np.nan
    if not (abs(length - 1.0) < _ROUNDING and np.isfinite(translation).all()):
        raise CaptureError(f"The pose of {where} is no unit quaternion and finite translation; get the model anew.")
    w, x, y, z = quaternion / length
    rigid = np.eye(4)
    rigid[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rigid[:3, 3] = translation
    return rigid
