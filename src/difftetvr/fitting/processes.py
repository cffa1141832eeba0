"""Several processes that fit together: who does what, sums over all of them, and proof that they agree.

They are started by ``torchrun``, which tells each by variables of its environment who it is. Every one holds the whole
reconstruction and takes its share of the views; what they find is summed up, so that all of them make the same step.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist

from difftetvr.errors import FitError, shown

_VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")  # of torchrun
_GPUS = "CUDA_VISIBLE_DEVICES"
_LONGEST_WAIT = timedelta(minutes=30)
"""For a process that neither ends nor answers: reading many photographs may take one of them longer than another."""

_Item = TypeVar("_Item")
_Summed = TypeVar("_Summed")


@dataclass(frozen=True)
class Processes:
    """The processes that fit together, seen from one of them; by default that one alone.

    All of them make the same calls in the same order. What is summed up or gathered is the same to the last bit in all.

    Attributes:
        rank: Number of this one, from 0.
        count: How many there are.
    """

    rank: int = 0
    count: int = 1

    @staticmethod
    @contextmanager
    def joined() -> Iterator[Processes]:
        """Context manager for the processes that ``torchrun`` has started; this one alone where it has not.

        Enter it before anything renders: of several processes on a machine each takes the GPU of its number, and its
        share of the cores.

        Raises:
            FitError: The environment makes no sense, a GPU is in use already, or the processes do not find each other.
        """
        here = _told()
        if here is None or here["WORLD_SIZE"] == 1:
            yield ALONE
            return
        if not (dist.is_available() and dist.is_gloo_available()):
            raise FitError("This PyTorch knows nothing of other processes; install another, or use one process.")
        _take_own_share(here["LOCAL_RANK"], here["LOCAL_WORLD_SIZE"])
        backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and dist.is_nccl_available() else "gloo"
        try:
            dist.init_process_group(backend, timeout=_LONGEST_WAIT)
        except (RuntimeError, ValueError) as error:
            raise FitError(
                f"The processes do not find each other ({_first_line(error)}); start them with torchrun."
            ) from error
        yield Processes(here["RANK"], here["WORLD_SIZE"])
        # Not after an error: others may have ended, and what they still owe would be waited for.
        dist.destroy_process_group()

    @property
    def is_first(self) -> bool:
        """Whether this is the one that writes and talks."""
        return self.rank == 0

    def share(self, items: Sequence[_Item]) -> list[_Item]:
        """Those of some items that this process takes."""
        return list(items[self.rank :: self.count])

    def shares(self, items: Sequence[_Item], count: int) -> list[list[_Item]]:
        """Those shares that this process takes, where items are dealt out to ``count`` shares, and they to processes.

        However many processes there are, the shares are the same: so are the sums over each.
        """
        return self.share([list(items[first::count]) for first in range(min(count, len(items)))])

    def sum(self, value: _Summed) -> _Summed:
        """The sum over all processes.

        Args:
            value: A tensor, a number, None, or a list or a dataclass of these; alike in all but its values.

        Raises:
            FitError: Another process has ended.
        """
        if self.count == 1:
            return value
        tensors = list(_tensors_of(value))
        total: dict[int, torch.Tensor] = {}
        # One message for all of a kind: on the way each costs as much as a million numbers.
        for kind in dict.fromkeys((tensor.device, tensor.dtype) for tensor in tensors):
            places = [place for place, tensor in enumerate(tensors) if (tensor.device, tensor.dtype) == kind]
            flat = self._reduced(torch.cat([tensors[place].detach().reshape(-1) for place in places]))
            sizes = [tensors[place].numel() for place in places]
            total |= {place: part.view_as(tensors[place]) for place, part in zip(places, flat.split(sizes))}
        return _with_tensors(value, (total[place] for place in range(len(tensors))))

    def gathered(self, rows: Sequence[Sequence[float]], count: int, width: int) -> list[list[float]]:
        """The rows of numbers that all processes have found for the items of their :meth:`share`, in order.

        Args:
            rows: Those of this process.
            count: Items in all.
            width: Numbers of a row.
        """
        if self.count == 1:
            return [list(row) for row in rows]
        table = torch.zeros(count, width, dtype=torch.float64)
        table[self.rank :: self.count] = torch.tensor(rows, dtype=torch.float64).view(-1, width)
        found: list[list[float]] = self.sum(table).tolist()
        return found

    def any(self, flag: bool) -> bool:
        """Whether a flag is raised in any process; all wait here for each other."""
        return flag if self.count == 1 else bool(self.sum(float(flag)))

    def require_same(self, text: str, sentence: str) -> None:
        """Checks that all processes have come to the same, by its SHA-256.

        Args:
            text: What they have come to.
            sentence: What to say where they have not.

        Raises:
            FitError: They have not; all of them raise it.
        """
        digest = list(hashlib.sha256(text.encode()).digest())
        digests = torch.tensor(self.gathered([digest], self.count, len(digest)))
        if bool((digests != digests[0]).any()):
            raise FitError(sentence)

    @contextmanager
    def in_order(self) -> Iterator[None]:
        """Context in which PyTorch adds up in a certain order on GPUs, too, so that processes come to the same bits."""
        if self.count == 1:
            yield
            return
        before = torch.are_deterministic_algorithms_enabled(), torch.is_deterministic_algorithms_warn_only_enabled()
        with warnings.catch_warnings():
            # Of operations that have no such order on principle, but none for what they are used for here.
            warnings.filterwarnings("ignore", ".*eterministic")
            torch.use_deterministic_algorithms(True, warn_only=True)
            try:
                yield
            finally:
                torch.use_deterministic_algorithms(before[0], warn_only=before[1])

    def speaks_first(self) -> bool:
        """Whether no other process has asked this before: so one sentence is said once, and by whom it befell."""
        if self.count == 1:
            return True
        try:
            return int(dist.distributed_c10d._get_default_store().add("difftetvr/said", 1)) == 1
        except RuntimeError:
            return True  # who could tell that it has been said is gone

    def _reduced(self, flat: torch.Tensor) -> torch.Tensor:
        there = flat if flat.device.type in ("cpu", "cuda") else flat.cpu()
        try:
            dist.all_reduce(there)
        except RuntimeError as error:
            raise FitError(
                f"Another of the {self.count} processes of this run has ended or does not answer; go on from the last "
                "checkpoint with --resume (resume=True), in any number of processes."
            ) from error
        return there.to(flat.device)


ALONE = Processes()
"""This process, where no others take part."""


def _told() -> dict[str, int] | None:
    """What the environment says of this process and others; None where it says nothing.

    Raises:
        FitError: It makes no sense.
    """
    texts = {name: os.environ.get(name, "") for name in _VARIABLES}
    if not all(texts.values()):
        return None
    try:
        told = {name: int(text) for name, text in texts.items()}
    except ValueError:
        told = {}
    if not told or not (0 <= told["RANK"] < told["WORLD_SIZE"] and 0 <= told["LOCAL_RANK"] < told["LOCAL_WORLD_SIZE"]):
        said = ", ".join(f"{name}={shown(text)}" for name, text in texts.items())
        raise FitError(f"The environment says {said}, which is no place among processes; unset them, or use torchrun.")
    return told


def _take_own_share(rank: int, count: int) -> None:
    """Leaves to this process its GPU, and its share of the cores, of a machine with ``count`` processes of a run."""
    if "drjit" in sys.modules and torch.cuda.is_available() and torch.cuda.device_count() > 1:
        raise FitError("A GPU has been chosen already; call Processes.joined() before anything is loaded or rendered.")
    if _GPUS not in os.environ:
        os.environ[_GPUS] = str(rank)
    elif os.environ[_GPUS]:
        gpus = os.environ[_GPUS].split(",")
        os.environ[_GPUS] = gpus[rank] if rank < len(gpus) else ""
    from difftetvr.backend import dr  # Late: it looks for GPUs.

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    dr.set_thread_count(min(dr.thread_count(), max(1, cores // count)))


def _tensors_of(value: Any) -> Iterator[torch.Tensor]:
    """All tensors and numbers in a value, these as tensors."""
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, float):
        yield torch.tensor(value, dtype=torch.float64)
    elif value is not None:
        for part in value if isinstance(value, list) else _fields(value).values():
            yield from _tensors_of(part)


def _with_tensors(value: Any, tensors: Iterator[torch.Tensor]) -> Any:
    """The value with others in place of its tensors and numbers."""
    if isinstance(value, torch.Tensor):
        return next(tensors)
    if isinstance(value, float):
        return float(next(tensors))
    if isinstance(value, list):
        return [_with_tensors(part, tensors) for part in value]
    if value is None:
        return None
    return dataclasses.replace(value, **{name: _with_tensors(part, tensors) for name, part in _fields(value).items()})


def _fields(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}


def _first_line(error: Exception) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[0].strip().rstrip(".") if lines else type(error).__name__
