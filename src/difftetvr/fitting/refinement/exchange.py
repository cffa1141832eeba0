"""Refinement by predicted gain: cells go from where they are worth least to where they win most."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from difftetvr.fitting.options import LARGEST_COUNT, OptionGroup
from difftetvr.fitting.refinement.strategy import Moment, Refinement, Situation

_Own = TypeVar("_Own", bound="Exchange")

_LEAST_ROUNDS, _ITERATIONS_PER_ROUND = 40, 60
_ITERATIONS_TO_SETTLE = 20
_LEAST_ROUNDS_ON_SURFACES, _ITERATIONS_PER_ROUND_ON_SURFACES, _PIXELS_ON_SURFACES = 10, 150, 36.0


@dataclass(frozen=True)
class Exchange(OptionGroup):
    """Collapse what predicts the least loss, bisect what predicts the most gain, at a constant number of cells.

    A prediction is that of the quadratic model of the squared error (see `difftetvr.rendering.gauss_newton`) for one
    change alone: g^2 / 2h in one dimension, here in the four of colour and density.
    """

    prefix = "exchange."

    rounds: int | None = None
    """How often the mesh is refined, evenly spread; default: 40 times, or a sixtieth of the iterations if more; for
    photographs that begin with a visual hull 10 times, or a 150th."""
    until: float = 0.85
    """Share of the run after which it is not refined any more."""
    share: float = 0.08
    """Share of the cells that one round takes away."""
    views: int | None = None
    """Random training views on which gains and losses are predicted; default: 36."""
    pixels: float | None = None
    """Pixels of these that are looked at, at most, in units of a view's; default: 12, for projections and for
    photographs that begin with a visual hull 36."""
    start: float = 0.6
    """New vertices start at this part of their best surplus over the interpolated values."""
    long: float = 0.6
    """Edges that are at least this long in each of their cells, in units of the longest one, may be bisected."""
    min_quality: float = 0.1
    """Least quality Q of cells that a collapse or a flip leaves."""
    initial: float = 1.0
    """Cells to begin with, as a share of the budget."""
    flips: bool = True
    """Whether to flip faces and edges where that predicts a gain, before anything else."""
    boundary: Literal["fixed", "slide"] = "slide"
    """Whether vertices on the boundary may be taken away where its shape does not need them; whether they move is for
    --motion.boundary to say."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rounds", "views"):
            value = getattr(self, name)
            valid = value is None or 1 <= value <= LARGEST_COUNT
            self._require(valid, name, f"at least 1 and at most {LARGEST_COUNT}")
        self._require(self.pixels is None or 0 < self.pixels < math.inf, "pixels", "greater than 0 and finite")
        self._require(0 <= self.share < 1, "share", "at least 0 and below 1")
        self._require(0 < self.initial <= 1, "initial", "greater than 0 and at most 1")
        for name in ("until", "start", "long", "min_quality"):
            self._require(0 <= getattr(self, name) <= 1, name, "between 0 and 1")

    def settling(self: _Own, iterations: int) -> _Own:
        """The same with so many rounds, where that is left open, that values which models are true of can settle.

        Args:
            iterations: Of the run.
        """
        rounds = max(1, min(_LEAST_ROUNDS, iterations // _ITERATIONS_TO_SETTLE))
        return replace(self, rounds=self.rounds or rounds)

    def on_surfaces(self: _Own, iterations: int) -> _Own:
        """The same, where that is left open, with as many rounds as suffice where cells begin where they are needed.

        Each of them looks at more pixels instead: what changes win on opaque surfaces differs from view to view.

        Args:
            iterations: Of the run.
        """
        rounds = max(_LEAST_ROUNDS_ON_SURFACES, iterations // _ITERATIONS_PER_ROUND_ON_SURFACES)
        return replace(self, rounds=self.rounds or rounds, pixels=self.pixels or _PIXELS_ON_SURFACES)

    def initial_cells(self, budget: int) -> int:
        """See `Strategy.initial_cells`."""
        return max(1, round(self.initial * budget))

    def is_due(self, moment: Moment) -> bool:
        """See `Strategy.is_due`: at the ends of equal parts of the time until the last refinement."""
        return self._rounds_done(moment.iteration, moment) > self._rounds_done(moment.iteration - 1, moment)

    def lets_move(self, moment: Moment) -> bool:
        """See `Strategy.lets_move`: always."""
        return True

    def target(self, moment: Moment) -> int:
        """Cells after the refinement at a moment: they grow by equal factors, up to the budget, and never shrink."""
        left = 1.0 - self._rounds_done(moment.iteration, moment) / self._rounds_of(moment)
        return max(round(moment.budget * self.initial**left), min(moment.cells, moment.budget))

    def refine(self, situation: Situation) -> Refinement | None:
        """See `Strategy.refine`."""
        from difftetvr.fitting.refinement.exchange_round import exchange_cells  # late: options need no PyTorch

        return exchange_cells(situation, self.target(situation.moment), self)

    def _rounds_done(self, iteration: int, moment: Moment) -> int:
        last = min(self.until * moment.iterations, moment.iterations - 1.0)
        done = max(iteration, 0) / last if last >= 1.0 else 0.0
        rounds = self._rounds_of(moment)
        return min(rounds, int(rounds * done))

    def _rounds_of(self, moment: Moment) -> int:
        return self.rounds or max(_LEAST_ROUNDS, moment.iterations // _ITERATIONS_PER_ROUND)


@dataclass(frozen=True)
class Grow(Exchange):
    """Growth from a coarse mesh to the budget, by the same predictions; each round also collapses some cells."""

    prefix = "grow."

    share: float = 0.04
    """Share of the cells that one round takes away."""
    initial: float = 0.1
    """Cells to begin with, as a share of the budget."""
