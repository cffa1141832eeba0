"""How long a host works on a rendering and its backward pass on CUDA: ``python -m cuda_emulation.host_times``.

Each call is made again while the device computes nothing and tells the host what it told it before, so what takes time
is the host. That is without PyTorch's operations, which emulation makes slow: how many of them there are stands
beside it, and each takes a host with a GPU some 5 microseconds. Needs ``src`` and ``tools`` on PYTHONPATH.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

from cuda_emulation import torch_device
from cuda_emulation.host_waits import calls, driver_counts
from cuda_emulation.started import DRIVER

AT_WORK, HEARD, IDLE = range(3)  # states of the driver


class Operations:
    """Counts PyTorch's operations on the device, and the time that they take, that of getting to them included."""

    def __init__(self) -> None:
        self.count, self.seconds, self._way = 0, 0.0, 0.0
        self._run = torch_device._run

    def __enter__(self) -> Operations:
        """Begin to count."""
        torch_device._run = self._timed
        self._way = min(self._way_to_one() for _ in range(5))
        return self

    def __exit__(self, *_: object) -> None:
        """Count no more."""
        torch_device._run = self._run

    def _timed(self, *args: Any) -> Any:
        start = time.perf_counter()
        try:
            return self._run(*args)
        finally:
            self.count += 1
            self.seconds += time.perf_counter() - start

    @property
    def spent(self) -> float:
        """Seconds spent on all of them so far."""
        return self.seconds + self.count * self._way

    def _way_to_one(self) -> float:
        """Seconds from a caller to an operation and back."""
        there, count, seconds = torch.zeros(8, device="cuda"), self.count, self.seconds
        start = time.perf_counter()
        for _ in range(1000):
            there.view(2, 4)
        return (time.perf_counter() - start - (self.seconds - seconds)) / (self.count - count)


def cost_of(call: Callable[[], object], operations: Operations) -> tuple[float, int, int]:
    """A host's seconds besides PyTorch's operations, and the numbers of these and of kernels."""
    kernels, count, seconds = driver_counts()["kernel launches"], operations.count, operations.spent
    start = time.perf_counter()
    call()
    whole = time.perf_counter() - start
    launched = driver_counts()["kernel launches"] - kernels
    return whole - (operations.spent - seconds), operations.count - count, launched


def host_time(call: Callable[[], object], operations: Operations, repetitions: int = 200) -> tuple[float, int, int]:
    """What a call costs whose kernels are there: the median of many.

    Raises:
        RuntimeError: With an idle device it is not what it is with another.
    """
    for _ in range(2):
        call()
    costs = []
    try:
        DRIVER.emulated_cuda_set_state(HEARD)
        _, *amounts = cost_of(call, operations)
        for _ in range(repetitions):
            DRIVER.emulated_cuda_set_state(IDLE)
            costs.append(cost_of(call, operations))
    finally:
        DRIVER.emulated_cuda_set_state(AT_WORK)
    if any(list(cost[1:]) != amounts for cost in costs):
        raise RuntimeError("The call goes another way when the device is idle, so its time is unknown.")
    return sorted(costs)[len(costs) // 2]


def main() -> None:
    """Print a line for each kind of call."""
    with Operations() as operations:
        for name, call in calls().items():
            seconds, count, kernels = host_time(call, operations)
            print(
                f"{name:44} {1e3 * seconds:5.2f} ms, {count:3} operations of PyTorch, {kernels:3} kernels", flush=True
            )


if __name__ == "__main__":
    main()
