"""Choosing many things at once that do not get into each other's way."""

from __future__ import annotations

import math

import torch

from difftetvr.mesh.arrays import chunks, kth_smallest, sort_keys, true_indices

_GOLDEN_RATIO = (5.0**0.5 - 1.0) / 2.0


def best_first(priority: torch.Tensor) -> torch.Tensor:
    """Order from highest to lowest, equal values in a fixed order that looks random.

    Ties in the order of their indices would make chains of neighbours that wait for one another.

    Args:
        priority: (N,) real numbers, none of them NaN.

    Returns:
        (N,) int64 indices into `priority`.
    """
    return _in_order(priority, torch.arange(priority.shape[0], device=priority.device))


class BestFirst:
    """What `best_first` returns, part by part: who needs the head of it only need not have the rest sorted."""

    def __init__(self, priority: torch.Tensor) -> None:
        """Nothing is sorted yet.

        Args:
            priority: (N,) real numbers, none of them NaN.
        """
        self._priority = priority
        self._taken = 0
        self._least: torch.Tensor | None = None

    def __len__(self) -> int:
        """How many are left."""
        return self._priority.shape[0] - self._taken

    def take(self, count: int) -> torch.Tensor:
        """The next ones, in order.

        Args:
            count: How many at least; all that are left where there are fewer. All of equal priority come together.

        Returns:
            (M,) int64 indices into `priority`.
        """
        priority, total = self._priority, self._priority.shape[0]
        wanted = torch.ones_like(priority, dtype=torch.bool) if self._least is None else priority < self._least
        if count < len(self):
            self._least = kth_smallest(priority, total - self._taken - count)
            wanted &= priority >= self._least
        indices = true_indices(wanted)
        self._taken += indices.shape[0]
        return _in_order(priority, indices)


def _in_order(priority: torch.Tensor, indices: torch.Tensor) -> torch.Tensor:
    """Sort indices into `priority`, all different, by what they stand for, from highest to lowest."""
    count = max(priority.shape[0], 1)
    step = max(int(count * _GOLDEN_RATIO), 1)
    while math.gcd(step, count) != 1:
        step += 1
    # Equal values are in the order 0, step, 2 step, ... modulo count; this is the place that an index has in it.
    place = (indices * pow(step, -1, count)) % count
    if priority.dtype == torch.float32:
        # Floats compare like their bits do, once those of negative numbers are reversed; adding 0 makes -0 a 0. With
        # its place in the lower half of the key no permutation needs sorting, which is ten times faster on a CPU.
        bits = (priority.index_select(0, indices) + 0.0).view(torch.int32)
        descending = torch.where(bits < 0, bits & 0x7FFFFFFF, ~bits).long()
        keys = sort_keys((descending << 32) | place)
        return ((keys & 0xFFFFFFFF) * step) % count
    scattered = (sort_keys(place) * step) % count
    return scattered[torch.sort(priority[scattered], descending=True, stable=True).indices]


def independent_set(groups: torch.Tensor, rank: torch.Tensor, count: int) -> torch.Tensor:
    """Choose items such that no two are in one group: what taking them one by one in the order of rank would choose.

    In each round, every item that is first in all its groups is chosen, and all others in these groups are out. The
    result does not depend on the order of the groups, nor on the number of threads.

    Args:
        groups: (G, K) integers, the items of each group; an item may be in many groups.
        rank: (M,) int32 of each item, all different in [0, count), lowest first; `count` for items not to be chosen.
        count: Number of ranks.

    Returns:
        (count,) bool by rank: chosen. Items that are in no group are never chosen.
    """
    # Everything happens in the order of ranks: a rank names its item, `count` names nobody.
    parts = [groups[:0].int()]
    for part in chunks(groups.shape[0], groups.device, width=groups.shape[1]):
        of_group = rank.index_select(0, groups[part].reshape(-1)).view(-1, groups.shape[1])
        parts.append(of_group[true_indices(of_group.amin(1) < count)])
    ranks = torch.cat(parts)
    memberships = torch.bincount(ranks.view(-1), minlength=count + 1)
    chosen = torch.zeros(count + 1, dtype=torch.bool, device=rank.device)
    out = torch.zeros_like(chosen)
    out[count] = True
    while ranks.shape[0]:
        first = ranks.amin(1)
        won = (torch.bincount(first, minlength=count + 1) == memberships) & (memberships > 0) & ~out
        chosen |= won
        out[ranks[true_indices(won.index_select(0, first))].view(-1)] = True
        ranks = ranks.masked_fill_(out.index_select(0, ranks.view(-1)).view(ranks.shape), count)
        ranks = ranks[true_indices(ranks.amin(1) < count)]
    return chosen[:count]
