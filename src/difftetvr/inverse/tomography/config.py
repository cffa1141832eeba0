"""Options of a tomographic reconstruction."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

from difftetvr.declared import require_declared
from difftetvr.errors import FitError
from difftetvr.fitting.motion import Motion
from difftetvr.fitting.options import LARGEST_COUNT, Schedule, require
from difftetvr.fitting.refinement import Exchange, Grow, Strategy
from difftetvr.mesh.limits import MAX_CELLS

if TYPE_CHECKING:
    from difftetvr.capture.projections.projection_capture import ProjectionCapture

Likelihood = Literal["gaussian", "poisson", "l1"]
"""How residuals of line integrals count, see `difftetvr.inverse.tomography.likelihoods`."""

Refined = Literal["none", "axis", "views"]
"""What of the geometry is corrected: nothing; the place and the tilt of the axis in all views alike; or each view's
shift besides."""

Refine = Literal["exchange", "grow", "none"]
"""Names of refinement strategies: each but the last is also that of a field of `TomographyConfig`, with its options."""

_START = 0.1
"""Part of their best surplus that new vertices start with: a ray passes many of them, and each one's best step would
mend the same residual."""

_LEAST_CELLS, _MOST_CELLS, _PIXELS_PER_CELL = 20_000, 300_000, 40
_FEWEST_VIEWS, _MOST_VIEWS, _JUDGED_PIXELS = 6, 10, 36.0

_RANGES = {
    "cells": (1, MAX_CELLS),
    "iterations": (1, LARGEST_COUNT),
    "batch_views": (1, LARGEST_COUNT),
    "rays": (1, LARGEST_COUNT),
    "solve_steps": (0, LARGEST_COUNT),
    "solve_rays": (1, LARGEST_COUNT),
    "evaluate_every": (0, LARGEST_COUNT),
    "seed": (0, LARGEST_COUNT),
}


@dataclass(frozen=True)
class TomographyConfig(Schedule):
    """How densities and vertex positions are optimised from line integrals while the mesh refines itself.

    Rates are steps of Adam per iteration in units of the mean density that the scan shows. Steps of vertices are
    counted in altitudes of their cells.
    """

    free: ClassVar[frozenset[str]] = frozenset(
        {"device", "evaluate_every", "checkpoint_seconds", "iterations", "solve_steps", "solve_rays"}
    )

    cells: int | None = None
    """Budget of tetrahedra: the run begins with about as many, and refinement ends within it. Default: one for every 40
    pixels to learn from, between 20 000 and 300 000."""
    iterations: int = 1200
    """Number of optimisation steps; after the last one, densities are solved for once more by themselves."""
    batch_views: int | None = None
    """Training views per step. Default: 6, or up to 10 where views have so few pixels that these are within --rays."""
    rays: int = 32_768
    """Rays per step, at most: pixels of each view in equal steps, beginning with another one each time."""
    likelihood: Likelihood = "gaussian"
    """How residuals count: squared and weighed by the variance of each line integral where the scan tells one
    (gaussian), by as many counts as one over the variance (poisson), or by their magnitudes (l1)."""
    total_variation: float = 0.02
    """Weight of the total variation of the density, in units in which noise and total variation are about 1."""
    tikhonov: float = 0.0
    """Weight of the squared gradient of the density, likewise."""
    rate: float = 0.2
    """Learning rate of densities in the first step."""
    final_rate: float = 0.005
    """Learning rate in the last step; in between it falls log-linearly."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay of Adam's first and second moments."""
    support: str | None = None
    """Where the object may be, all else being empty: cylinder, the largest one around the axis in the box, or the file
    of a volume over the box, which exceeds its least value there. Default: the whole box."""
    move: bool = True
    """Whether vertices move."""
    refine: Refine = "exchange"
    """How the mesh refines itself: exchange cells at their full number, grow from a coarse mesh, or not at all."""
    align: Refined = "none"
    """Corrections of the geometry that are learned along: the place of the axis and, with an eighth as many rows as
    columns or more, its tilt, the same in all views (axis), or each view's shift besides (views)."""
    align_rate: float = 0.1
    """Their rate in the first step, in pixels; it falls as that of densities does."""
    solve_steps: int = 10
    """Steps of conjugate gradients after the last iteration, for densities alone; 0: none."""
    solve_rays: int = 3_000_000
    """Rays that these take into account, at most: pixels of all training views in equal steps."""
    seed: int = 0
    """Seed of the order of views and pixels, and of those that refinements are judged on."""
    deterministic: bool = True
    """Repeatable to the last bit on one machine, also across --resume."""
    device: str | None = None
    """Where to run, such as cpu or cuda; default: the best that works."""
    evaluate_every: int = 100
    """Iterations between glances at a few held-out views, for the curves only; 0: never."""
    checkpoint_seconds: float = 60.0
    """Seconds between checkpoints."""
    motion: Motion = field(default_factory=lambda: Motion(rate=0.8, final_rate=0.04, barrier=0.01))
    """How vertices move."""
    exchange: Exchange = field(default_factory=lambda: Exchange(start=_START, pixels=_JUDGED_PIXELS))
    """Options of --refine exchange."""
    grow: Grow = field(default_factory=lambda: Grow(start=_START, pixels=_JUDGED_PIXELS))
    """Options of --refine grow."""

    def __post_init__(self) -> None:
        require_declared(self, FitError, "option ")
        self._require_counts(_RANGES)
        for name in ("rate", "final_rate", "align_rate"):
            value = getattr(self, name)
            require(value > 0 and math.isfinite(value), name, value, "greater than 0 and finite")
        for name in ("total_variation", "tikhonov", "checkpoint_seconds"):
            value = getattr(self, name)
            require(value >= 0 and math.isfinite(value), name, value, "at least 0 and finite")
        require(all(0 <= b < 1 for b in self.betas), "betas", self.betas, "at least 0 and less than 1")
        for name, kind in (("likelihood", Likelihood), ("refine", Refine), ("align", Refined)):
            value = getattr(self, name)
            require(value in get_args(kind), name, value, f"one of {', '.join(get_args(kind))}")

    @property
    def budget(self) -> int:
        """Cells that the mesh may have, where the options do not leave it open."""
        return self.cells or _LEAST_CELLS

    def for_scan(self, capture: ProjectionCapture) -> TomographyConfig:
        """These options with those that are left open chosen for a scan."""
        pixels = len(capture.train_indices) * math.prod(capture.geometry.shape[1:])
        cells = self.cells or max(_LEAST_CELLS, min(pixels // _PIXELS_PER_CELL, _MOST_CELLS))
        fitting = self.rays // math.prod(capture.geometry.shape[1:])
        batch = min(max(_FEWEST_VIEWS, min(fitting, _MOST_VIEWS)), max(1, len(capture.train_indices)))
        return dataclasses.replace(self, cells=cells, batch_views=self.batch_views or batch)

    @property
    def steps(self) -> int:
        """Number of optimisation steps."""
        return self.iterations

    @property
    def batch(self) -> int:
        """Training views per step."""
        return self.batch_views or _FEWEST_VIEWS

    def strategy(self) -> Strategy | None:
        """How the mesh is refined, in rounds between which densities can settle; None if it is not."""
        if self.refine == "none":
            return None
        chosen: Exchange = getattr(self, self.refine)
        return chosen.settling(self.steps)
