"""Real spherical harmonics: colours that depend on the direction they are seen from."""

from __future__ import annotations

import torch

COUNTS = (0, 3, 8, 15)
"""Number of functions in the bands 1 to each degree."""


def harmonic_basis(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Orthonormal real spherical harmonics of the bands 1 to ``degree``, band 0 left out.

    In each band they are ordered from order -l to l and have the signs that 3-D Gaussian splatting uses (those of
    Condon and Shortley). Differentiable.

    Args:
        directions: (N, 3) unit vectors.
        degree: From 0 to 3.

    Returns:
        (N, 0), (N, 3), (N, 8) or (N, 15).
    """
    x, y, z = directions.unbind(dim=1)
    functions: list[torch.Tensor] = []
    if degree >= 1:
        functions += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        functions += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        functions += [
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4.0 * zz - xx - yy),
            0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570457994644658 * x * (4.0 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ]
    return torch.stack(functions, dim=1) if functions else directions.new_zeros(directions.shape[0], 0)
