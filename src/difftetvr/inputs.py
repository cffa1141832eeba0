"""What callers pass: tensors, numbers and objects of the right kind, or one sentence that names what came instead."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import torch

from difftetvr.errors import DiffTetError, shown

_CONVERSION_FAILS = (TypeError, ValueError, RuntimeError, OverflowError, AssertionError, ImportError)
"""What torch raises for values that make no tensor, and for devices that it was not built for."""

_MOST_AT_ONCE = 1 << 16
"""Bytes that CUDA takes out of common memory at once."""


def require_type(value: Any, kind: type | tuple[type, ...], name: str, advice: str, error: type[DiffTetError]) -> None:
    """Refuse what is no instance of a class.

    Args:
        value: What was passed.
        kind: What it must be an instance of.
        name: What it was passed as.
        advice: What to do instead: "pass ...".
        error: What to raise.
    """
    if not isinstance(value, kind):
        raise error(f"{name} is {shown(value)}; {advice}.")


def as_number(value: Any, name: str, error: type[DiffTetError], advice: str = "give a number") -> float:
    """A Python number from a number, or a tensor or array of one.

    Args:
        value: What was passed.
        name: What it was passed as.
        error: What to raise where it is none.
        advice: What to do then.
    """
    try:
        if isinstance(value, (str, bytes)):
            raise TypeError
        return float(value.detach() if isinstance(value, torch.Tensor) else value)
    except _CONVERSION_FAILS as reason:
        raise error(f"{name} is {shown(value)}; {advice}.") from reason


def as_whole(value: Any, name: str, error: type[DiffTetError], advice: str = "give a whole number") -> int:
    """A Python integer from an integer, or a tensor or array of one; see :func:`as_number`."""
    try:
        return operator.index(value)
    except _CONVERSION_FAILS as reason:
        raise error(f"{name} is {shown(value)}; {advice}.") from reason


def as_reals(
    value: Any, name: str, error: type[DiffTetError], dtype: torch.dtype | None = None, advice: str = "pass a tensor"
) -> torch.Tensor:
    """A tensor of float32 or float64 from anything that holds real numbers.

    Args:
        value: A tensor, which stays what it is, autograd graph included, where it is of these; an array, a list.
        name: What it was passed as.
        error: What to raise where it holds none.
        dtype: Precision of what is no tensor of these yet; None: its own if it is one of these, else float32.
        advice: What to do then.
    """
    try:
        tensor = value if isinstance(value, torch.Tensor) else torch.as_tensor(value, dtype=dtype)
        is_real = not (tensor.is_complex() or tensor.is_quantized or tensor.dtype == torch.bool)
        if not is_real or tensor.layout != torch.strided or tensor.device.type == "meta":
            raise TypeError
        return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.to(dtype or torch.float32)
    except _CONVERSION_FAILS as reason:
        raise error(f"{name} is {shown(value)}{_kind(value)}; {advice} of real numbers.") from reason


def _kind(value: Any) -> str:
    """What may keep a tensor or an array from being one of real numbers in memory."""
    if isinstance(value, torch.Tensor):
        return f" ({value.dtype}, {value.layout}, on '{value.device}')"
    return f" ({value.dtype})" if isinstance(value, np.ndarray) else ""


def moved(
    tensor: torch.Tensor, device: torch.device | str | None, dtype: torch.dtype | None, error: type[DiffTetError]
) -> torch.Tensor:
    """A tensor on another device or in another precision, None for its own; torch's errors may be kilobytes long."""
    try:
        return tensor.to(device=device, dtype=dtype)
    except _CONVERSION_FAILS as reason:
        target = " and ".join(shown(place) for place in (device, dtype) if place is not None)
        raise error(f"Tensors cannot be brought to {target} on this machine; choose another device.") from reason


def handed_over(tensor: torch.Tensor, like: torch.Tensor, dtype: torch.dtype | None = None) -> torch.Tensor:
    """A tensor on the device of another, without a wait of the host for a GPU; autograd follows it.

    CUDA has read a few numbers in common memory of the host once the call returns. More it would wait for, so they go
    through memory that is locked, which PyTorch keeps until it has been read.

    Args:
        tensor: What is handed over.
        like: Says where to, and at which precision where none is given.
        dtype: The precision.
    """
    dtype = like.dtype if dtype is None else dtype
    if tensor.device.type != "cpu" or like.device.type != "cuda":
        return tensor.to(dtype).to(like.device)  # in this order: not all devices know float64
    is_large = tensor.numel() * dtype.itemsize > _MOST_AT_ONCE
    copy = torch.empty(tensor.shape, dtype=dtype, pin_memory=is_large).copy_(tensor)
    return copy.to(like.device, non_blocking=True)
