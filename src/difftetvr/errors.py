"""Every error a user can cause: one sentence that says what is wrong, where, and what to do; warnings; and counts."""

from __future__ import annotations

import builtins
import reprlib
from collections.abc import Sequence
from typing import Any

_MOST_SHOWN, _LONGEST_SHOWN, _LONGEST_NUMBERS, _LARGEST_SHOWN = 8, 100, 60, 10**20


class DiffTetError(Exception):
    """Base of all errors raised for bad input; the command line prints its sentence and exits with code 2.

    The sentence is one line of plain text: control characters, such as names in files may hold, are escapes in it.
    """

    def __str__(self) -> str:
        """The sentence."""
        return "".join(c if c.isprintable() else builtins.repr(c)[1:-1] for c in super().__str__())


class MeshError(DiffTetError):
    """A tetrahedral mesh or the field on it is invalid, or a mesh file cannot be read or written."""


class MeshWarning(UserWarning):
    """Something that a mesh file cannot hold as it was given, and what was written instead."""


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


class _Short(reprlib.Repr):
    """Values as a sentence can show them: numbers and short texts as they are, all else by its kind and size."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = 40
        self.maxlevel = 3
        self.maxlist = self.maxtuple = self.maxset = self.maxdict = _MOST_SHOWN

    def repr_int(self, x: int, level: int) -> str:
        return builtins.repr(x) if abs(x) < _LARGEST_SHOWN else "a huge number"

    def repr_instance(self, x: Any, level: int) -> str:
        # Tensors and arrays are told by what they have: help and option errors must not import what they come from.
        if hasattr(x, "tolist") and hasattr(x, "shape"):
            values = _few_values(x)
            text = "" if values is None else self.repr1(values, level)
            kind = "a tensor" if hasattr(x, "requires_grad") else "an array"
            return text if 0 < len(text) <= _LONGEST_NUMBERS else f"{kind} of shape {tuple(x.shape)}"
        if x is None or isinstance(x, float | complex | bool) or type(x).__module__ in ("torch", "numpy"):
            return builtins.repr(x)
        return f"the class {x.__name__}" if isinstance(x, type) else f"a {type(x).__name__}"


def shown(value: Any) -> str:
    """A value in a few words of one line, as it stands in a sentence.

    Args:
        value: Whatever was given. Tensors and arrays are shown as their numbers, those of many by their shape.
    """
    text = _Short().repr(value)
    return text if len(text) <= _LONGEST_SHOWN else f"a {type(value).__name__} of {len(value)}"


def _few_values(array: Any) -> Any:
    """Numbers of a small tensor or array as lists; None for a large one, and for tensors without values."""
    shape = tuple(array.shape)
    try:
        return array.tolist() if 0 not in shape and sum(shape) <= _MOST_SHOWN else None
    except (RuntimeError, NotImplementedError, ValueError):
        return None


def listed(words: Sequence[str], last: str = "and") -> str:
    """Words as a sentence lists them: a, b and c.

    Args:
        words: At least one.
        last: What stands before the last one.
    """
    return f" {last} ".join((", ".join(words[:-1]), words[-1])) if len(words) > 1 else words[0]


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """A number with what it counts: 1 cell, 1,200 cells.

    Args:
        number: How many.
        noun: What one of them is called.
        plural: What others are called; default: the noun with an s.
    """
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"
