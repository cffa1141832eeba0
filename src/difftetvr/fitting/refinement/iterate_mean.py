"""Means over the iterations from one refinement to the next."""

from __future__ import annotations

import torch

_COUNT = "mean_count"
_MEAN = "mean."


class IterateMean:
    """Means of what a run optimises, over iterations that share one mesh.

    Steps follow the gradients of single views, which pull to and fro; the mean of some iterates lies closer to where
    they lead than the last one does. Of n iterates the k-th weighs about in proportion to k^(1/s - 1), so that the last
    share s of them, however many there are, makes up the most of the mean (polynomial-decay averaging: Shamir and
    Zhang, Stochastic gradient descent for non-smooth optimization, 2013, section 4).
    """

    def __init__(self, share: float) -> None:
        """Knows of no iteration.

        Args:
            share: In [0, 1]; 1: all iterates weigh the same; 0: means are the last iterates, and nothing is kept.
        """
        self._share = share
        self._count = 0
        self._means: dict[str, torch.Tensor] = {}

    @torch.no_grad()
    def add(self, iterate: dict[str, torch.Tensor]) -> None:
        """Takes an iterate into account.

        Args:
            iterate: Floating-point tensors by name; names and shapes stay the same until :meth:`begin_anew`.
        """
        if not self._share:
            return
        if not self._count:
            self._means = {name: tensor.detach().clone() for name, tensor in iterate.items()}
        weight = 1.0 / (1.0 + self._share * self._count)
        for name, mean in self._means.items():
            mean.lerp_(iterate[name].detach(), weight)
        self._count += 1

    @property
    def means(self) -> dict[str, torch.Tensor]:
        """The means by name; none where there were no iterates."""
        return dict(self._means)

    def begin_anew(self) -> None:
        """Forgets all iterates."""
        self._means, self._count = {}, 0

    def state(self, iterate: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """All that the next means depend on, by name.

        Args:
            iterate: The latest iterate, whose shapes those of no means have.
        """
        if not self._share:
            return {}
        means = self._means or {name: torch.zeros_like(tensor.detach()) for name, tensor in iterate.items()}
        return {_COUNT: torch.tensor(self._count), **{_MEAN + name: tensor for name, tensor in means.items()}}

    def restore(self, tensors: dict[str, torch.Tensor], iterate: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`.

        Args:
            tensors: Of the names, shapes and types of :meth:`state`; others are ignored.
            iterate: The latest iterate, on the device of those to come.
        """
        if self._share and int(tensors[_COUNT]) > 0:
            self._count = int(tensors[_COUNT])
            self._means = {name: tensors[_MEAN + name].to(like.device, copy=True) for name, like in iterate.items()}
