"""Flat records of channels and one more value, as kernels and PyTorch see them (Dr.Jit).

Radiance with optical depth, colours with density, and the derivatives by each have one layout: C channels, then the
one value, then zeros up to a whole number of packets of four floats, so that one instruction moves a packet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.rendering.traversal.sums import Sums

PACKET = 4


def packets_of(values: int) -> int:
    """Number of packets that hold some values."""
    return -(-values // PACKET)


@dataclass(frozen=True)
class Records:
    """The layout of records of ``channels`` values and one more."""

    channels: int

    @property
    def width(self) -> int:
        """Floats a record; one alone needs no packet."""
        return PACKET * packets_of(self.channels + 1) if self.channels else 1

    @property
    def width_of_sums(self) -> int:
        """Floats a record of sums: on CPUs, adding a single float takes several times as long as adding a pair."""
        return max(self.width, 2)

    def gather(self, backend: Backend, array: Any, index: Any, active: Any = True) -> list[Any]:
        """The channels of a record, and the value behind them."""
        if not self.channels:
            return [dr.gather(backend.Float, array, index, active)]
        return gather_values(backend, array, index * packets_of(self.channels + 1), self.channels + 1, active)

    def scatter(self, backend: Backend, array: Any, values: list[Any], index: Any, active: Any = True) -> None:
        """Store a record."""
        dr.scatter(array, self._whole(backend, values), index, active)

    def add(self, backend: Backend, sums: Sums, values: list[Any], index: Any, active: Any) -> None:
        """Add to a record of sums."""
        sums.add(self._whole(backend, values) if self.channels else backend.Float2(*values, 0.0), index, active)

    def gather_sums(self, backend: Backend, array: Any, index: Any) -> list[Any]:
        """The channels of a record of sums, and the value behind them."""
        if not self.channels:
            return [dr.gather(backend.Float2, array, index)[0]]
        return self.gather(backend, array, index)

    def _whole(self, backend: Backend, values: list[Any]) -> Any:
        # In one piece: several scatters to one array are kernels of their own, each of which computes everything.
        if not self.channels:
            return values[0]
        return backend.Floats(values + [backend.Float(0)] * (self.width - len(values)))

    def pack(self, channels: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
        """(N, width) records from (N, C) channels and (N,) values."""
        padding = channels.new_zeros((channels.shape[0], self.width - self.channels - 1))
        return torch.cat([channels, last[:, None], padding], dim=1)

    def unpack(self, records: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, C) channels and (N,) values of (N, width) records."""
        return records[:, : self.channels], records[:, self.channels]


def gather_values(backend: Backend, array: Any, packet: Any, count: int, active: Any) -> list[Any]:
    """Some values that begin at a packet."""
    values: list[Any] = []
    for k in range(packets_of(count)):
        part = dr.gather(backend.Float4, array, packet + k, active)
        values += [part[i] for i in range(PACKET)]
    return values[:count]
