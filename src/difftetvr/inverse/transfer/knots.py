"""The unknowns of a transfer function: numbers without bounds that stand for knots within theirs."""

from __future__ import annotations

from collections.abc import Callable

import torch

from difftetvr.inverse.transfer.config import TransferConfig
from difftetvr.optics.transfer_function import TransferFunction

_NAMES = ("color", "opacity", "gaps")
_MOMENTS = ("exp_avg", "exp_avg_sq", "step")
_FAINT = -2.0  # added to random opacities: behind opaque knots nothing would be seen
_INSIDE = 1e-3  # how near to their bounds values of a given function may begin


class Knots:
    """Colours, opacities and distances of knots with their Adam optimiser.

    Colours and opacities are sigmoids, distances of neighbouring knots a softmax: whatever the optimiser does, values
    lie in [0, 1], places ascend, and the first and the last knot stay at 0 and 1.

    Attributes:
        color: (K, 3) leaf tensor.
        opacity: (K,) leaf tensor.
        gaps: (K - 1,) leaf tensor.
    """

    def __init__(self, config: TransferConfig, start: TransferFunction | None = None) -> None:
        """Random normal values at even distances, or those of a function.

        Args:
            config: Options.
            start: Function to begin with, sampled at even distances.
        """
        random = torch.Generator().manual_seed(config.seed)
        count = config.knots
        color = torch.randn(count, 3, generator=random)
        opacity = torch.randn(count, generator=random) + _FAINT
        if start is not None:
            colors, opacities = start(torch.linspace(0.0, 1.0, count))
            color = torch.logit(colors.clamp(_INSIDE, 1.0 - _INSIDE))
            opacity = torch.logit(opacities.clamp(_INSIDE, 1.0 - _INSIDE))
        self.color, self.opacity = color.detach().requires_grad_(), opacity.detach().requires_grad_()
        self.gaps = torch.zeros(count - 1).requires_grad_()
        self._shares = {"color": 1.0, "opacity": 1.0, "gaps": config.position_rate if config.move_knots else 0.0}
        groups = [{"params": [getattr(self, name)], "name": name} for name in _NAMES]
        self._optimizer = torch.optim.Adam(groups, lr=config.rate, betas=(0.9, 0.99), eps=1e-15)
        for name in _NAMES:
            parameter = getattr(self, name)
            zeros = torch.zeros_like(parameter, requires_grad=False)
            self._optimizer.state[parameter] = {
                "exp_avg": zeros,
                "exp_avg_sq": zeros.clone(),
                "step": torch.zeros(()),
            }

    def function(self, name: str = "fitted") -> TransferFunction:
        """The transfer function that the knots make; differentiable.

        Args:
            name: What to call it.
        """
        places = torch.cumsum(torch.softmax(self.gaps, dim=0), dim=0)
        scalar = torch.cat((places.new_zeros(1), places[:-1].clamp(max=1.0), places.new_ones(1)))
        return TransferFunction(scalar, torch.sigmoid(self.opacity), torch.sigmoid(self.color), name)

    def opened(self) -> tuple[TransferFunction, Callable[[torch.Tensor | None], None]]:
        """The function for several views, whose gradients meet at its numbers: behind these there is one graph.

        Returns:
            The function, of leaf tensors; and what hands the gradients on that have gathered in them, together with
            those of a scalar that depends on the knots themselves, if there is one.
        """
        function = self.function()
        parts = (function.scalar, function.opacity, function.color)
        scalar, opacity, color = leaves = [part.detach().requires_grad_() for part in parts]

        def hand_on(rest: torch.Tensor | None = None) -> None:
            pulled = [(part, leaf.grad) for part, leaf in zip(parts, leaves, strict=True) if leaf.grad is not None]
            ends: list[tuple[torch.Tensor, torch.Tensor | None]] = [*pulled, *([] if rest is None else [(rest, None)])]
            torch.autograd.backward([end for end, _ in ends], [gradient for _, gradient in ends])

        return TransferFunction(scalar, opacity, color), hand_on

    def roughness(self) -> torch.Tensor:
        """Mean squared difference of neighbouring knots' colours and opacities."""
        values = torch.cat((torch.sigmoid(self.color), torch.sigmoid(self.opacity)[:, None]), dim=1)
        return values.diff(dim=0).square().mean()

    def zero_grad(self) -> None:
        """Forgets the gradients before the views of a step are accumulated."""
        self._optimizer.zero_grad(set_to_none=True)

    def step(self, rate: float) -> None:
        """One step of Adam.

        Args:
            rate: Learning rate.
        """
        for group in self._optimizer.param_groups:
            group["lr"] = rate * self._shares[group["name"]]
        self._optimizer.step()

    def state(self) -> dict[str, torch.Tensor]:
        """Values and moments by name: all that the next step depends on."""
        tensors = {}
        for name in _NAMES:
            parameter = getattr(self, name)
            tensors[name] = parameter.detach()
            tensors |= {f"{name}.{key}": self._optimizer.state[parameter][key] for key in _MOMENTS}
        return tensors

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """The inverse of :meth:`state`."""
        with torch.no_grad():
            for name, tensor in self.state().items():
                tensor.copy_(tensors[name])
