"""Shape terms for a loss, differentiable in the vertex positions."""

from __future__ import annotations

import math

import torch

from difftetvr.errors import FitError
from difftetvr.mesh.tetmesh import TetMesh


def softplus_regularizer(mesh: TetMesh, beta: float = 100.0) -> torch.Tensor:
    """The article's regulariser: the mean of Softplus(-Q) = log(1 + exp(-beta Q)) / beta over all cells.

    Small for well-shaped cells, and close to -Q for inverted ones. It discourages inversion, but does not prevent it:
    that is what `VertexOptimizer` is for. Mended here (article section 6): eq. (17) misses the 1/6 of the volume,
    eq. (21) the minus sign. The mean in place of the sum makes the weight independent of the number of cells.

    Args:
        mesh: Mesh whose vertices require grad; cells may be inverted.
        beta: Steepness, > 0: cells with Q well above 1 / beta are left alone.

    Returns:
        () in the precision of the mesh; it has no unit.

    Raises:
        FitError: `beta` is not greater than 0 and finite.
    """
    if not (beta > 0 and math.isfinite(beta)):
        raise FitError(f"The softplus parameter beta is {beta}; it must be greater than 0 and finite.")
    # Not torch's own beta: beyond a threshold that replaces the function by another.
    exponent = -beta * mesh.quality()
    return torch.logaddexp(exponent, torch.zeros_like(exponent)).mean() / beta


def shape_barrier(mesh: TetMesh) -> torch.Tensor:
    """The sum of -log Q over all cells: 0 for regular tetrahedra, infinite where a cell is about to become flat.

    `VertexOptimizer` has it built in, with its gradient in closed form and in units of each vertex's own altitude.

    Args:
        mesh: Mesh of positive cells whose vertices require grad.

    Returns:
        () in the precision of the mesh; it has no unit.
    """
    return -mesh.quality().log().sum()
