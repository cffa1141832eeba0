"""From images to a tetrahedral volume: losses, optimisation, checkpoints and metrics."""

from difftetvr.fit.config import FitConfig, Motion
from difftetvr.fit.errors import FitError
from difftetvr.fit.loop import fit
from difftetvr.fit.positions import StepReport, VertexOptimizer, VertexOptimizerConfig
from difftetvr.fit.refinement import Exchange, Grow, Moment, Refinement, Situation, Star, Strategy
from difftetvr.fit.regularizers import shape_barrier, softplus_regularizer
from difftetvr.fit.result import FitResult, Progress

__all__ = [
    "Exchange",
    "FitConfig",
    "FitError",
    "FitResult",
    "Grow",
    "Moment",
    "Motion",
    "Progress",
    "Refinement",
    "Situation",
    "Star",
    "StepReport",
    "Strategy",
    "VertexOptimizer",
    "VertexOptimizerConfig",
    "fit",
    "shape_barrier",
    "softplus_regularizer",
]
