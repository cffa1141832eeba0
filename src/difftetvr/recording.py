"""Kernels that are traced once for each kind of call and launched from a recording ever after.

Tracing a kernel takes Python a millisecond, launching it microseconds. So functions that trace kernels are frozen
(:func:`drjit.freeze`) together with everything that decides what they trace: of their arguments only the Dr.Jit arrays
may differ from call to call, and all else is part of the *kind* of the call.
"""

from __future__ import annotations

import enum
import functools
import gc
import sys
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any, ParamSpec, TypeVar

import drjit as dr
import torch

from difftetvr.backend import Backend

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

_KINDS = 256  # recordings are small, but each also keeps alive what its kind holds
_RECORDINGS = 16  # of one kind: Dr.Jit records anew where arrays that had one size have several, or the reverse
_SEQUENCES = (tuple, list)
_STATIC = (type(None), bool, int, float, str, type, enum.Enum, Backend)


class _Unknown(TypeError):
    """An argument may hold anything."""


def replayed(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns that traces and evaluates kernels; traced only at the first call of its kind.

    The function must not look at the contents of arrays, must evaluate what it computes, and must return Dr.Jit arrays
    in tuples, lists or dataclasses. Sizes that it bakes into kernels, those of buffers that it makes for example, must
    be arguments; each kernel must read one of the arrays lane by lane, so that its size is that array's.

    Where an argument is not made of dataclasses, tuples, lists, arrays and plain values, nothing is known of what it
    decides, and the function is called as it is.

    Args:
        function: Defined once, not a closure.
        arguments: What it takes.
    """
    arrays: list[Any] = []
    try:
        kind = _split(arguments, arrays)
    except _Unknown:
        return function(*arguments)
    frozen, call = _frozen(function, kind, dr.thread_count())
    with _no_garbage_collected():
        return frozen(call, arrays)


def eager(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function that ``torch.compile`` leaves alone and calls, instead of tracing it down to the kernels.

    :func:`torch.compiler.disable` does that, but imports the compiler, which takes longer than most renderings; so it
    is called once somebody else has.
    """
    hidden: list[Callable[Parameters, Result]] = []

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        if "torch._dynamo" not in sys.modules:
            return function(*args, **kwargs)
        if not hidden:
            hidden.append(torch.compiler.disable(function))
        return hidden[0](*args, **kwargs)

    return call


@contextmanager
def _no_garbage_collected() -> Iterator[None]:
    """Where Python frees nothing that it finds by chance: Dr.Jit aborts when a recording sees foreign arrays go."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def few_lengths(count: int) -> int:
    """A length of at least ``count`` out of few, four an octave: recordings bake the lengths of buffers in."""
    step = 1 << max(0, count.bit_length() - 3)
    return max(-(-count // step) * step, 1)


class _Call:
    """A function with all of its arguments but the arrays; to Dr.Jit a value that it need not look into."""

    def __init__(self, function: Callable[..., Any], kind: Hashable) -> None:
        self.function, self.kind = function, kind

    def run(self, arrays: list[Any]) -> Any:
        """Call the function."""
        return self.function(*_joined(self.kind, iter(arrays)))


def _run(call: _Call, arrays: list[Any]) -> Any:
    return call.run(arrays)


@lru_cache(maxsize=_KINDS)
def _frozen(function: Callable[..., Any], kind: Hashable, threads: int) -> tuple[Callable[..., Any], _Call]:
    """A function of its own for each kind, for Dr.Jit searches all recordings of one; per-thread sums are baked in."""
    return dr.freeze(_run, limit=_RECORDINGS, warn_after=1 << 30), _Call(function, kind)


def _split(value: Any, arrays: list[Any]) -> Hashable:
    """A sequence or dataclass without its arrays, which are appended to a list."""
    kind: Any = type(value)
    contents = [kind]
    for part in _parts(kind)(value):
        # Here, and not in a call for each: there are a hundred of them in a rendering.
        kind = type(part)
        parts = _parts(kind)
        if parts is None:
            contents.append(part)
        elif parts is _Array:
            arrays.append(part)
            contents.append(_Array)
        else:
            contents.append(_split(part, arrays))
    return tuple(contents)


@cache
def _parts(kind: Any) -> Any:
    """What takes a value of some type apart; None where it need not be, `_Array` where it is an array."""
    if issubclass(kind, dr.ArrayBase):
        return _Array
    if issubclass(kind, _STATIC):
        return None
    if kind in _SEQUENCES:
        return iter
    names = getattr(kind, "__match_args__", ())  # of dataclasses: what makes one anew
    if len(names) != len(getattr(kind, "__dataclass_fields__", (*names, ""))):
        raise _Unknown
    return attrgetter(*names) if len(names) > 1 else lambda value: [getattr(value, name) for name in names]


def _joined(part: Any, arrays: Iterator[Any]) -> Any:
    """The value that was split."""
    if part is _Array:
        return next(arrays)
    if not isinstance(part, tuple):
        return part
    kind, *parts = part
    values = [_joined(item, arrays) for item in parts]
    return kind(values) if kind in _SEQUENCES else kind(*values)


class _Array:
    """Stands for an array."""
