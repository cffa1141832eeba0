"""From images to a tetrahedral volume: losses, optimisation, checkpoints and metrics."""

from difftetvr.fit.config import FitConfig
from difftetvr.fit.errors import FitError
from difftetvr.fit.loop import fit
from difftetvr.fit.positions import StepReport, VertexOptimizer, VertexOptimizerConfig
from difftetvr.fit.regularizers import shape_barrier, softplus_regularizer
from difftetvr.fit.result import FitResult, Progress

__all__ = [
    "FitConfig",
    "FitError",
    "FitResult",
    "Progress",
    "StepReport",
    "VertexOptimizer",
    "VertexOptimizerConfig",
    "fit",
    "shape_barrier",
    "softplus_regularizer",
]
