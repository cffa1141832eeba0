"""Array primitives for tables of millions of rows, for tensors of any device.

On the CPU they work on one core, slice by slice in its cache. Torch would start its threads for many of these small
operations, and waiting for threads costs a thousand times the work where other processes use the cores too.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
import torch


def chunks(count: int, device: torch.device, width: int = 1) -> Iterator[slice]:
    """Slices that cover range(count), small enough for a CPU's cache and for temporaries not to matter.

    Args:
        count: Number of rows.
        device: Where the rows are; accelerators get larger slices.
        width: Elements of a row in the largest temporary.

    Yields:
        Consecutive slices.
    """
    # 30 000 is just below torch's usual threshold for threads, 2**15 elements.
    size = max((30_000 if device.type == "cpu" else 2**25) // width, 1)
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


@lru_cache(maxsize=64)
def constant(values: tuple[Any, ...], device: torch.device) -> torch.Tensor:
    """A small table of integers, copied to a device once: the host waits for every copy.

    Args:
        values: Integers, or tuples of them.
        device: Where it is wanted.

    Returns:
        int64 of the shape of the values; shared, so it must not be changed.
    """
    with torch.inference_mode(False):  # for callers who are not in this mode, too
        return torch.tensor(values, device=device)


def sort_keys(keys: torch.Tensor) -> torch.Tensor:
    """Sort keys ascending; on the CPU in place.

    Args:
        keys: (N,) int64, contiguous.

    Returns:
        (N,) int64 sorted keys.
    """
    if keys.device.type != "cpu":
        return torch.sort(keys).values
    # numpy sorts keys alone with SIMD, ten times faster than torch, which always carries the permutation along.
    keys.numpy().sort()
    return keys


def kth_smallest(values: torch.Tensor, k: int) -> torch.Tensor:
    """What would be at position k if values were sorted ascending.

    Args:
        values: (N,) real numbers, none of them NaN.
        k: In [0, N).

    Returns:
        () of the same dtype.
    """
    if values.device.type != "cpu" or values.dtype == torch.bfloat16:
        return torch.kthvalue(values, k + 1).values
    # numpy looks for it with SIMD.
    return torch.from_numpy(np.partition(values.numpy(), k))[k]


def true_indices(mask: torch.Tensor) -> torch.Tensor:
    """Positions of the true elements of a mask.

    Args:
        mask: (N,) bool.

    Returns:
        (M,) int64, ascending.
    """
    if mask.device.type != "cpu":
        return torch.nonzero(mask).squeeze(1)
    return torch.from_numpy(np.flatnonzero(mask.numpy()))


def all_of_three(mask: torch.Tensor) -> torch.Tensor:
    """Which rows are true throughout.

    Args:
        mask: (N, 3) bool.

    Returns:
        (N,) bool.
    """
    first, second, third = mask.unbind(1)  # torch takes ten times as long to look through rows of three
    return first & second & third


def put(target: torch.Tensor, indices: torch.Tensor, values: torch.Tensor) -> None:
    """Write target[indices] = values in place, outside autograd.

    Args:
        target: (N,) contiguous.
        indices: (M,) int64, all different.
        values: (M,) of target's dtype.
    """
    if target.device.type != "cpu":
        target[indices] = values
    else:
        target.numpy()[indices.numpy()] = values.numpy()
