"""Whether Dr.Jit finds the CUDA driver that this machine has.

Dr.Jit asks the loader for ``libcuda.so``, a name that only development packages and some drivers install. Containers
and many clusters have ``libcuda.so.1`` alone, and Dr.Jit would take the CPU without a word. This module tells it by
the environment variable ``DRJIT_LIBCUDA_PATH``, which Dr.Jit reads once, when it is first imported.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import cache

PATH_VARIABLE = "DRJIT_LIBCUDA_PATH"
"""Environment variable by which a user, or :func:`tell_drjit`, names the library."""

LINKED_NAME = "libcuda.so"
REAL_NAME = "libcuda.so.1"


def tell_drjit(loads: Callable[[str], bool] | None = None) -> str | None:
    """Name the driver in ``DRJIT_LIBCUDA_PATH`` where Dr.Jit's own name does not load and the driver's does.

    Has no effect after Dr.Jit was imported.

    Args:
        loads: Whether the loader finds a library; for tests.

    Returns:
        The name that was set; None if nothing had to be or could be done.
    """
    if os.environ.get(PATH_VARIABLE) or "drjit" in sys.modules or not sys.platform.startswith("linux"):
        return None
    found = loads or _loads
    if found(LINKED_NAME) or not found(REAL_NAME):
        return None
    os.environ[PATH_VARIABLE] = REAL_NAME
    return REAL_NAME


@cache
def count_gpus() -> int:
    """How many GPUs the CUDA driver offers this process, whether or not PyTorch can use them; 0 without a driver."""
    for name in filter(None, (os.environ.get(PATH_VARIABLE), LINKED_NAME, REAL_NAME)):
        if not _loads(name):
            continue
        driver, count = ctypes.CDLL(name), ctypes.c_int(0)
        is_started = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
        return count.value if is_started else 0
    return 0


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True
