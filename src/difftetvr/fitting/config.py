"""Options of a reconstruction, and the schedules that follow from them."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from difftetvr.declared import require_declared
from difftetvr.errors import FitError
from difftetvr.fitting.cameras.options import CameraRefinement
from difftetvr.fitting.motion import Motion
from difftetvr.fitting.options import LARGEST_COUNT, Schedule, require
from difftetvr.fitting.refinement import Exchange, Grow, Star, Strategy
from difftetvr.mesh.limits import CELLS_PER_CUBE, MAX_CELLS, MAX_DEGREE

if TYPE_CHECKING:
    from difftetvr.capture.capture import Capture

LossName = Literal["l2", "l1", "l1-ssim"]
"""Names of `difftetvr.fitting.losses`."""

Refine = Literal["exchange", "grow", "star", "none"]
"""Names of refinement strategies: each but the last is also that of the field of `FitConfig` with its options."""

Background = Literal["black", "white", "random"] | tuple[float, float, float]

BACKGROUND_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
"""R G B of the backgrounds that have names."""

# Least and greatest value of options that count something.
_RANGES = {
    "cells": (1, MAX_CELLS),
    "iterations": (1, LARGEST_COUNT),
    "batch_views": (1, LARGEST_COUNT),
    "evaluate_every": (0, LARGEST_COUNT),
    "seed": (0, LARGEST_COUNT),
}
_BACKGROUNDS = ("black", "white", "random")
_STARTS = ("grid", "hull", "points")
_DEFAULT_CELLS, _DEFAULT_ITERATIONS = 20_000, 2400
_PHOTO_BANDS, _PHOTO_ITERATIONS = 2, 4800
_CUT_OUT_DENSITY_RATE = 5.0  # what stands before a background would be put where it is seen first, and stay
_PHOTO_PIXELS_PER_CELL = 12
_FREE_BEFORE_POINTS, _FREE_BEFORE_BOUNDS = 0.8, 0.5
_MOST_PHOTO_CELLS = 1_000_000
_BAND_SHARE = 0.05  # of the run, from one band of harmonics to the next
_CHOICES_FOR_VOLUMES: dict[str, Any] = {
    "cells": _DEFAULT_CELLS,
    "start": "grid",
    "iterations": _DEFAULT_ITERATIONS,
    "background": "black",
    "harmonics": 0,
    "density_rate": 1.0,
    "free_space": 0.0,
    "averaging": 0.25,
}
CHOSEN_FOR_CAPTURE = tuple(_CHOICES_FOR_VOLUMES)
"""Options whose default depends on the images."""


@dataclass(frozen=True)
class FitConfig(Schedule):
    """How colours, densities and vertex positions are optimised while the mesh refines itself.

    The defaults reconstruct the Tooth benchmark. Rates are steps of Adam per iteration in units of the quantity:
    colours live in [0, 1], densities are counted in units of the capture's density (that of opacity 1 in a volume).
    No function keeps them in range: after each step they are projected, colours to [0, 1] and densities to [0, inf).
    Unlike the image of an exponential or a softplus, that range includes 0, so empty space becomes exactly empty.
    """

    free: ClassVar[frozenset[str]] = frozenset({"device", "evaluate_every", "checkpoint_seconds", "iterations"})

    cells: int | None = None
    """Budget of tetrahedra: the run begins with about as many, and refinement ends within it. Default: 20 000; for
    photographs one for every 12 pixels to learn from, up to a million."""
    start: Literal["grid", "hull", "points"] | None = None
    """Mesh to begin with: a grid of near-cubic cubes over the capture's bounds, those of them that no silhouette rules
    out, or the Delaunay mesh of its sparse points and a coarse lattice. Around the bounds of captures without
    silhouettes comes a shell of growing cells. Default: for photographs hull where they have silhouettes, else points
    where there are some; else grid."""
    grid: tuple[int, int, int] | None = None
    """Cubes of the grid along x, y and z, 6 tetrahedra each, without those of a shell; overrides --cells, unless the
    mesh is to grow."""
    initial_mesh: str | None = None
    """Mesh file to begin with instead of a grid; its colours and densities, if it has any, are the initial ones (but
    for free space). It is its own budget; only where it is to grow does --cells say how far."""
    repair: bool = False
    """Mend an initial mesh that has flat cells or repeated vertices or cells; without it such a mesh is refused."""
    move: bool = True
    """Whether vertices move."""
    pace: float = 8.0
    """Length of the vertices' steps, in units of that of --motion.rate and its schedule. Gradients of single views
    agree so little that few steps come to that length."""
    refine: Refine = "exchange"
    """How the mesh refines itself: exchange cells at their full number, grow from a coarse mesh, subdivide stars as in
    the article, or not at all."""
    averaging: float | None = None
    """A refinement begins with the means of values and vertices over about this share of the iterations since the last
    one, in which it evens out that gradients of single views pull to and fro; 0: with what the last iteration left.
    Default: 0.25, for photographs and with --refine star 0."""
    location: Literal["vertex", "cell"] = "vertex"
    """Whether colour and density belong to vertices, linear in between, or to cells, constant inside."""
    iterations: int | None = None
    """Number of optimisation steps; default: 4800 for photographs, else 2400."""
    batch_views: int | None = None
    """Training views per step; their gradients are averaged. Default: one for each process."""
    loss: LossName = "l2"
    """Mean squared (l2) or mean absolute (l1) difference of the images; l1-ssim has a fifth of 1 - SSIM in it."""
    harmonics: int | None = None
    """Bands of spherical harmonics, from 0 to 3, by which colours depend on the direction; default: 2 for photographs,
    else 0."""
    harmonics_rate: float = 0.2
    """Learning rate of their coefficients, in units of that of colours."""
    density_rate: float | None = None
    """Learning rate of densities, in units of that of colours; default: 5 for photographs that alpha cuts out,
    whose surfaces are many times denser than fog that a picture could show, else 1."""
    rate: float = 0.03
    """Learning rate of the first step."""
    final_rate: float = 0.001
    """Learning rate of the last step; in between it falls log-linearly."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay of Adam's first and second moments."""
    background: Background | None = None
    """Behind the volume: black, white, random in every step (white where images are compared), or R G B. All but black
    need images with alpha. Default: random for photographs that alpha cuts out, else black."""
    haze_penalty: float = 0.01
    """Pull towards zero density, in mean absolute density gradients; removes fog that no training view can refute."""
    free_space: float | None = None
    """Share of the way from each training camera to the scene that is kept empty, in a cone wider than its view: to the
    capture's bounds, or to sparse points that are nearer. Default: for photographs with a background 0.8 where there
    are sparse points, else 0.5; for all else 0."""
    sparsity: float = 0.0
    """Weight of a loss that favours few opaque places over much fog: the mean over vertices of log(1 + 2 density^2)."""
    initial_color: float = 0.5
    """Colour that all vertices start with, in [0, 1]."""
    initial_density: float = 0.05
    """Density that all vertices start with, in units of the capture's density."""
    seed: int = 0
    """Seed of the order of the views, of those that refinements are judged on, and of random backgrounds."""
    deterministic: bool = True
    """Repeatable to the last bit on one machine, also across --resume; on CPUs at most four threads then go backward.
    False is faster on many cores."""
    device: str | None = None
    """Where to run, such as cpu, cuda or mps; default: the best that works."""
    evaluate_every: int = 100
    """Iterations between glances at a few held-out views, for the curves only; 0: never."""
    checkpoint_seconds: float = 30.0
    """Seconds between checkpoints."""
    refine_poses: bool = False
    """Whether the cameras' poses are unknowns, too: for photographs whose poses are off by a pixel or more."""
    refine_intrinsics: bool = False
    """Whether the focal length and the principal point are, one change for all views."""
    cameras: CameraRefinement = field(default_factory=CameraRefinement)
    """How they move."""
    motion: Motion = field(default_factory=Motion)
    """How vertices move."""
    exchange: Exchange = field(default_factory=Exchange)
    """Options of --refine exchange."""
    grow: Grow = field(default_factory=Grow)
    """Options of --refine grow."""
    star: Star = field(default_factory=Star)
    """Options of --refine star."""

    def __post_init__(self) -> None:
        require_declared(self, FitError, "option ")
        self._require_counts(_RANGES)
        for name in ("rate", "final_rate", "harmonics_rate", "density_rate", "pace"):
            value = getattr(self, name)
            require(value is None or _positive(value), name, value, "greater than 0 and finite")
        for name in ("haze_penalty", "sparsity", "initial_density", "checkpoint_seconds"):
            value = getattr(self, name)
            require(value >= 0 and math.isfinite(value), name, value, "at least 0 and finite")
        require(0 <= self.initial_color <= 1, "initial_color", self.initial_color, "between 0 and 1")
        require(all(0 <= b < 1 for b in self.betas), "betas", self.betas, "at least 0 and less than 1")
        share = self.free_space
        require(share is None or 0 <= share < 1, "free_space", share, "at least 0 and below 1")
        share = self.averaging
        require(share is None or 0 <= share <= 1, "averaging", share, "between 0 and 1")
        require(self.location in ("vertex", "cell"), "location", self.location, "vertex or cell")
        require(self.loss in get_args(LossName), "loss", self.loss, f"one of {', '.join(get_args(LossName))}")
        bands = self.harmonics
        require(bands is None or 0 <= bands <= MAX_DEGREE, "harmonics", bands, f"between 0 and {MAX_DEGREE}")
        require(self.refine in get_args(Refine), "refine", self.refine, f"one of {', '.join(get_args(Refine))}")
        on_cells = self.location == "cell" and self.refine != "none"
        require(not on_cells, "refine", self.refine, "none where colours belong to cells (location cell)")
        require(self.start in (None, *_STARTS), "start", self.start, f"one of {', '.join(_STARTS)}")
        if self.grid is not None:
            require(self.start != "points", "grid", self.grid, "left out where the mesh starts from points")
            require(min(self.grid) >= 1, "grid", self.grid, "at least 1 cube along each axis")
            fits = math.prod(self.grid) <= MAX_CELLS // CELLS_PER_CUBE
            require(fits, "grid", self.grid, f"at most {MAX_CELLS // CELLS_PER_CUBE} cubes in all")
        require(self.initial_mesh is None or self.grid is None, "grid", self.grid, "left out with an initial mesh")
        require(self.initial_mesh is not None or not self.repair, "repair", self.repair, "given with an initial mesh")
        named = self.background is None or isinstance(self.background, str)
        valid = self.background in (None, *_BACKGROUNDS) if named else _is_color(self.background)
        require(valid, "background", self.background, "black, white, random or three values in [0, 1]")

    @property
    def budget(self) -> int:
        """Cells that the mesh may have, where the options do not leave it open."""
        return self.cells or _DEFAULT_CELLS

    @property
    def steps(self) -> int:
        """Number of optimisation steps, where the options do not leave it open."""
        return self.iterations or _DEFAULT_ITERATIONS

    @property
    def batch(self) -> int:
        """Training views per step, where the options do not leave it open."""
        return self.batch_views or 1

    @property
    def averaged(self) -> float:
        """Share of the iterations that means are of; 0 where it was left open, by runs of before there were means."""
        return self.averaging or 0.0

    @property
    def needs_alpha(self) -> bool:
        """Whether training images must be composited over something that is not black."""
        return self.background not in (None, "black", (0.0, 0.0, 0.0))

    def for_capture(self, capture: Capture) -> FitConfig:
        """These options with those that are left open chosen as suits the images.

        Args:
            capture: Images and cameras.
        """
        choices = self._choices_for_photos(capture) if capture.encoding == "srgb" else _CHOICES_FOR_VOLUMES
        if self.refine == "star":
            choices = choices | {"averaging": 0.0}  # as in the article
        left_open = {name: choices[name] for name in CHOSEN_FOR_CAPTURE if getattr(self, name) is None}
        return dataclasses.replace(self, **left_open)

    def _comparable(self) -> FitConfig:
        return dataclasses.replace(self, averaging=self.averaged)

    def for_processes(self, count: int) -> FitConfig:
        """These options with so many views per step, if that was left open."""
        return self if self.batch_views is not None else dataclasses.replace(self, batch_views=count)

    def _choices_for_photos(self, capture: Capture) -> dict[str, Any]:
        pixels = sum(math.prod(capture.image_sizes[view]) for view in capture.train_indices.tolist())
        without_silhouettes = "grid" if capture.scene_points is None or self.grid is not None else "points"
        # Bounds alone do not say what else may stand before them.
        free_space = _FREE_BEFORE_BOUNDS if capture.scene_points is None else _FREE_BEFORE_POINTS
        return {
            "cells": max(_DEFAULT_CELLS, min(pixels // _PHOTO_PIXELS_PER_CELL, _MOST_PHOTO_CELLS)),
            "start": without_silhouettes if capture.silhouettes is None else "hull",
            "iterations": _PHOTO_ITERATIONS,
            "background": "random" if capture.is_cut_out else "black",
            "harmonics": _PHOTO_BANDS,
            "density_rate": _CUT_OUT_DENSITY_RATE if capture.is_cut_out else 1.0,
            "free_space": free_space if capture.surroundings > 1.0 else 0.0,
            "averaging": 0.0,
        }

    @property
    def refines_cameras(self) -> bool:
        """Whether any part of the cameras is unknown."""
        return self.refine_poses or self.refine_intrinsics

    def bands_at(self, iteration: int) -> int:
        """Bands of the harmonics that take part in a step: they are switched on one after the other."""
        return min(self.harmonics or 0, int(iteration / (_BAND_SHARE * self.steps)))

    def strategy(self) -> Strategy | None:
        """How the mesh is refined; None if it is not."""
        if self.refine == "exchange" and self.start == "hull" and self.initial_mesh is None:
            return self.exchange.on_surfaces(self.steps)
        return None if self.refine == "none" else getattr(self, self.refine)

    def motion_rate_at(self, iteration: int) -> float | None:
        """Length of the vertices' steps, in altitudes; None where they stay."""
        rate = super().motion_rate_at(iteration)
        return None if rate is None else self.pace * rate

    def background_at(self, iteration: int) -> tuple[float, float, float]:
        """Linear RGB background of a step; like the views a function of seed and iteration alone."""
        if self.background != "random":
            return self.evaluation_background()
        r, g, b = self.step_random(iteration).random(3)
        return float(r), float(g), float(b)

    def evaluation_background(self) -> tuple[float, float, float]:
        """Background of held-out images: the given one, white where training uses random ones."""
        if self.background is None or isinstance(self.background, str):
            return BACKGROUND_COLORS["black" if self.background in (None, "black") else "white"]
        return self.background


def _positive(value: float) -> bool:
    return value > 0 and math.isfinite(value)


def _is_color(value: object) -> bool:
    return isinstance(value, tuple) and len(value) == 3 and all(0.0 <= v <= 1.0 for v in value)
