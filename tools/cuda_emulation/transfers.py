"""What is copied between the memories of host and device, by PyTorch and by Dr.Jit.

A copy of at most 512 bytes counts as numbers, a greater one as an array. What PyTorch finds out for itself, such as how
many elements of a mask are true, is a wait (:mod:`cuda_emulation.host_waits`), but no copy of anybody's data.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from cuda_emulation import torch_device
from cuda_emulation.host_waits import driver_counts


def copies_of(call: Callable[[], object]) -> Counter[str]:
    """Copies of a call and their bytes, by what they are, where they go and whose they are.

    The names are ``PyTorch: arrays to the host``, ``Dr.Jit: numbers to the device``, ``PyTorch: bytes to the host`` and
    so on; those that do not occur are missing.
    """
    before = _copies()
    call()
    return _copies() - before


def _copies() -> Counter[str]:
    of_drjit = {name: count for name, count in driver_counts().items() if " to the " in name}
    counts = {f"Dr.Jit: {name}": count for name, count in of_drjit.items()}
    return Counter(counts | {f"PyTorch: {name}": count for name, count in torch_device.TRANSFERS.items()})
