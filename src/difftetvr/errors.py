"""Every error a user can cause: one sentence that says what is wrong, where, and what to do; warnings; and counts."""

from __future__ import annotations

import reprlib
from typing import Any

_MOST_SHOWN = 16


class DiffTetError(Exception):
    """Base of all errors raised for bad input; the command line prints its sentence and exits with code 2."""


class MeshError(DiffTetError):
    """A tetrahedral mesh or the field on it is invalid, or a mesh file cannot be read or written."""


class CaptureError(DiffTetError):
    """Images, cameras, volumes or transfer functions that a reconstruction starts from are invalid."""


class CaptureWarning(UserWarning):
    """Something about a capture that was passed over, chosen or changed, and that its owner should know."""


class CameraError(DiffTetError):
    """A camera's pose, intrinsics or image size is invalid."""


class FitError(DiffTetError):
    """The options, the checkpoint or the output folder of a reconstruction is invalid."""


class BackendError(DiffTetError):
    """No Dr.Jit back end can run the kernels on this machine or on the device of the given tensors."""


def shown(value: Any) -> str:
    """A value as it stands in a sentence: tensors and arrays as their numbers, those of many by their shape.

    Args:
        value: Whatever was given.
    """
    if hasattr(value, "tolist") and hasattr(value, "shape"):
        shape = tuple(value.shape)
        try:
            few = value.tolist() if 0 not in shape and sum(shape) <= _MOST_SHOWN else None
        except (RuntimeError, NotImplementedError, ValueError):  # there are tensors without values
            few = None
        return f"an array of shape {shape}" if few is None else shown(few)
    if isinstance(value, list | tuple) and len(value) <= _MOST_SHOWN:
        parts = ", ".join(shown(part) for part in value)
        return f"[{parts}]" if isinstance(value, list) else f"({parts}{',' if len(value) == 1 else ''})"
    return reprlib.repr(value)


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """A number with what it counts: 1 cell, 1,200 cells.

    Args:
        number: How many.
        noun: What one of them is called.
        plural: What others are called; default: the noun with an s.
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"
