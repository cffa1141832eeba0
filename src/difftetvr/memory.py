"""Memory that is freed, and who keeps it.

PyTorch and Dr.Jit both keep the memory of a GPU that is freed, to hand it out again, and neither can take what the
other keeps. So one of them may find a card full of memory that nobody uses: how that shows, and one more try.

On the CPU glibc keeps little. Each large block goes back to the system, which fills the pages of the next one with
zeros: with ten million cells a fifth of a fit's time.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# Torch's and Dr.Jit's allocators raise RuntimeErrors like any others; only their words tell them apart.
# The last of them is what Dr.Jit says where it has no memory left for a kernel that it records.
_ALLOCATION = re.compile(
    r"DefaultCPUAllocator|(?:can't|cannot|could not|unable to|failed to) allocate|out[ _]of[ _]memory|not enough memory"
    r"|bad[_ ]alloc|free the allocation cache while recording",
    re.IGNORECASE,
)

# Parameters of glibc's mallopt: values that keep what is freed, and those that a process comes to by itself. Whoever
# sets one keeps its thresholds from growing with what is freed, so they are left where they had grown to at most.
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -2, -3, -4
_KEEPING = {_TRIM_THRESHOLD: -1, _TOP_PAD: 1 << 26, _MMAP_MAX: 0}
_GIVING_BACK = {_TRIM_THRESHOLD: 1 << 26, _TOP_PAD: 1 << 17, _MMAP_THRESHOLD: 1 << 25, _MMAP_MAX: 1 << 16}


@contextmanager
def kept() -> Iterator[None]:
    """Has glibc keep what is freed, for as long as large arrays come and go; then it goes back to the system.

    Of two that are in each other, or in two threads, the first that ends is the end of both.
    """
    libc = _glibc()
    if libc is None:
        yield
        return
    for parameter, value in _KEEPING.items():
        libc.mallopt(parameter, value)
    try:
        yield
    finally:
        for parameter, value in _GIVING_BACK.items():
            libc.mallopt(parameter, value)
        libc.malloc_trim(0)


def _glibc() -> Any | None:
    """The C library, if it is glibc."""
    if sys.platform != "linux":
        return None
    libc = ctypes.CDLL(None)
    return libc if hasattr(libc, "mallopt") and hasattr(libc, "malloc_trim") else None


def is_out_of_memory(error: BaseException | None) -> bool:
    """Whether an error of Python, NumPy, PyTorch or Dr.Jit means that memory is short, by itself or by its cause."""
    torch = sys.modules.get("torch")  # only what has been imported can have raised
    while error is not None:
        if isinstance(error, MemoryError) or (torch is not None and isinstance(error, torch.OutOfMemoryError)):
            return True
        if isinstance(error, OSError) and error.errno == errno.ENOMEM:
            return True
        if isinstance(error, RuntimeError) and _ALLOCATION.search(str(error)):
            return True
        error = error.__cause__  # Dr.Jit's loops hide what went wrong in them behind an error of their own
    return False


def tried_twice(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A function that is called once more if a GPU's memory does not suffice, behind :func:`give_back`.

    It must not have changed anything that its second call sees.
    """

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        try:
            return function(*args, **kwargs)
        except Exception as error:
            if not (_is_on_a_gpu() and is_out_of_memory(error)):
                raise
        give_back()  # only here, where nothing of the first call lives any longer
        return function(*args, **kwargs)

    return call


def give_back() -> None:
    """Have PyTorch and Dr.Jit return the memory of GPUs that they keep and nobody uses; both must be in use."""
    torch, drjit = sys.modules["torch"], sys.modules["drjit"]
    drjit.sync_thread()
    drjit.flush_malloc_cache()
    torch.cuda.synchronize()  # what Dr.Jit has freed is free once its stream has come so far
    torch.cuda.empty_cache()


def _is_on_a_gpu() -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and "drjit" in sys.modules and torch.cuda.is_initialized()
