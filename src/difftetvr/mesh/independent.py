"""Choosing many things at once that do not get into each other's way."""

from __future__ import annotations

import math

import torch

from difftetvr.mesh.arrays import chunks, sort_keys, true_indices

_GOLDEN_RATIO = (5.0**0.5 - 1.0) / 2.0


def best_first(priority: torch.Tensor) -> torch.Tensor:
    """Order from highest to lowest, equal values in a fixed order that looks random.

    Ties in the order of their indices would make chains of neighbours that wait for one another.

    Args:
        priority: (N,) real numbers, none of them NaN.

    Returns:
        (N,) int64 indices into `priority`.
    """
    count = priority.shape[0]
    step = max(int(count * _GOLDEN_RATIO), 1)
    while math.gcd(step, max(count, 1)) != 1:
        step += 1
    scattered = (torch.arange(count, device=priority.device) * step) % max(count, 1)
    if priority.dtype == torch.float32:
        # Floats compare like their bits do, once those of negative numbers are reversed; adding 0 makes -0 a 0. With
        # its place in the lower half of the key no permutation needs sorting, which is ten times faster on a CPU.
        bits = (priority[scattered] + 0.0).view(torch.int32)
        descending = torch.where(bits < 0, bits & 0x7FFFFFFF, ~bits).long()
        keys = sort_keys((descending << 32) | torch.arange(count, device=priority.device))
        return scattered[keys & 0xFFFFFFFF]
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
