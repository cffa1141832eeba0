"""Parts of a view that fit into bounded memory."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Band:
    """Items from ``first`` to before ``last``, which count ``total``."""

    first: int
    last: int
    total: int


def bands_of(counts: torch.Tensor, budget: int) -> list[Band]:
    """Cut a sequence into bands that count at most ``budget`` each, or are one item that counts more.

    Args:
        counts: (N,) int64, what each item counts.
        budget: What may be held at a time.
    """
    ends = counts.cumsum(0).cpu()
    bands, first, before = [], 0, 0
    while first < counts.shape[0]:
        last = int(torch.searchsorted(ends, before + budget, right=True))
        last = min(max(last, first + 1), counts.shape[0])
        total = int(ends[last - 1]) - before
        bands.append(Band(first, last, total))
        first, before = last, before + total
    return bands
