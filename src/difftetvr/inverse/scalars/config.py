"""Options of a reconstruction of scalars."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

from difftetvr.declared import require_declared
from difftetvr.errors import FitError
from difftetvr.fitting.config import FitConfig
from difftetvr.fitting.motion import Motion
from difftetvr.fitting.options import LARGEST_COUNT, Schedule, require
from difftetvr.fitting.refinement import Exchange, Grow, Strategy
from difftetvr.mesh.limits import MAX_CELLS

Unknown = Literal["scalar", "both"]
"""What is looked for: the scalars behind a known transfer function, or both."""

Refine = Literal["exchange", "grow", "none"]
"""Names of refinement strategies: each but the last is also that of a field of `ScalarConfig`, with its options."""

_START = 0.1
"""Part of their best surplus that new vertices start with: models are true of small steps."""

_RANGES = {
    "cells": (1, MAX_CELLS),
    "iterations": (1, LARGEST_COUNT),
    "colors_first": (0, LARGEST_COUNT),
    "batch_views": (1, LARGEST_COUNT),
    "knots": (2, LARGEST_COUNT),
    "evaluate_every": (0, LARGEST_COUNT),
    "seed": (0, LARGEST_COUNT),
}


@dataclass(frozen=True)
class ScalarConfig(Schedule):
    """How scalars and vertex positions are optimised from images while the mesh refines itself.

    Scalars live in [0, 1], the range of transfer functions, and are projected to it after each step.
    """

    free: ClassVar[frozenset[str]] = frozenset({"device", "evaluate_every", "checkpoint_seconds", "iterations"})

    unknown: Unknown = "scalar"
    """What is looked for: the scalars behind the known transfer function (scalar), or the function, too (both); then
    scalars are found but for a change that rises, or falls, all along, which a function can undo."""
    cells: int = 20_000
    """Budget of tetrahedra: the run begins with about as many, and refinement ends within it."""
    iterations: int = 1800
    """Number of optimisation steps."""
    colors_first: int | None = None
    """Iterations before these, in which colours and densities are fitted, to which scalars are found that look like
    them; 0: begin with the same scalar everywhere. Default: two thirds of --iterations."""
    batch_views: int = 1
    """Training views per step."""
    rate: float = 0.015
    """Learning rate of scalars in the first step."""
    final_rate: float = 0.001
    """Learning rate in the last step; in between it falls log-linearly."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay of Adam's first and second moments."""
    total_variation: float = 1e-5
    """Weight of the total variation of scalars, in ranges of the function and faces of a cube of the box's volume: what
    images do not tell, such as where a function shows next to nothing, becomes flat."""
    knots: int = 32
    """Knots of a transfer function that is looked for."""
    function_rate: float = 1.0
    """Learning rate of its values, in units of that of scalars; values are logarithms of odds."""
    move: bool = True
    """Whether vertices move."""
    refine: Refine = "exchange"
    """How the mesh refines itself: exchange cells at their full number, grow from a coarse mesh, or not at all."""
    seed: int = 0
    """Seed of the order of views, and of those that refinements are judged on."""
    deterministic: bool = True
    """Repeatable to the last bit on one machine, also across --resume."""
    device: str | None = None
    """Where to run, such as cpu or cuda; default: the best that works."""
    evaluate_every: int = 100
    """Iterations between glances at a few held-out views, for the curves only; 0: never."""
    checkpoint_seconds: float = 30.0
    """Seconds between checkpoints."""
    motion: Motion = field(default_factory=lambda: Motion(rate=0.8, final_rate=0.08))
    """How vertices move."""
    exchange: Exchange = field(default_factory=lambda: Exchange(start=_START))
    """Options of --refine exchange."""
    grow: Grow = field(default_factory=lambda: Grow(start=_START))
    """Options of --refine grow."""

    def __post_init__(self) -> None:
        require_declared(self, FitError, "option ")
        self._require_counts(_RANGES)
        for name in ("rate", "final_rate", "function_rate"):
            value = getattr(self, name)
            require(value > 0 and math.isfinite(value), name, value, "greater than 0 and finite")
        require(0 <= self.total_variation < math.inf, "total_variation", self.total_variation, "at least 0 and finite")
        require(0 <= self.checkpoint_seconds < math.inf, "checkpoint_seconds", self.checkpoint_seconds, "at least 0")
        require(all(0 <= b < 1 for b in self.betas), "betas", self.betas, "at least 0 and less than 1")
        for name, kind in (("unknown", Unknown), ("refine", Refine)):
            value = getattr(self, name)
            require(value in get_args(kind), name, value, f"one of {', '.join(get_args(kind))}")

    @property
    def steps(self) -> int:
        """Number of optimisation steps."""
        return self.iterations

    @property
    def batch(self) -> int:
        """Training views per step."""
        return self.batch_views

    @property
    def color_steps(self) -> int:
        """Iterations in which colours and densities are fitted first."""
        return 2 * self.iterations // 3 if self.colors_first is None else self.colors_first

    def strategy(self) -> Strategy | None:
        """How the mesh is refined, in rounds between which scalars can settle; None if it is not."""
        if self.refine == "none":
            return None
        chosen: Exchange = getattr(self, self.refine)
        return chosen.settling(self.steps)

    def of_field(self) -> FitConfig:
        """Options of a fit of colours and densities that the scalars begin with."""
        steps = max(1, self.color_steps)
        return FitConfig(
            cells=self.cells,
            start="grid",
            averaging=0.0,
            move=self.move,
            refine=self.refine,
            iterations=steps,
            batch_views=self.batch_views,
            seed=self.seed,
            deterministic=self.deterministic,
            device=self.device,
            evaluate_every=0,
            exchange=Exchange().settling(steps),
            grow=Grow().settling(steps),
        )
