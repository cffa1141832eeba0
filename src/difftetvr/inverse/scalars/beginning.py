"""Scalars to begin with, by way of colours and densities.

Images depend on scalars in a way that is far from convex: what is behind a peak of the transfer function can be reached
only through it. Colours and densities have no such hills, so they are fitted first, as in Weiss and Westermann's
"Differentiable Direct Volume Rendering" (2022), and then every vertex gets the scalar that looks most like it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from difftetvr.capture.capture import Capture
from difftetvr.fitting.loop import fit
from difftetvr.fitting.records.result import Progress
from difftetvr.inverse.scalars.config import ScalarConfig
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.optics.transfer_function import TransferFunction

_CANDIDATES = 129
_SWEEPS = 30
_SMOOTHNESS = 0.1
"""Weight of the squared difference from the neighbours' mean, beside that of premultiplied colours and opacities."""
_VERTICES_AT_ONCE = 1 << 16
_CLEAR, _OPAQUE = 1e-3, 0.999  # opacities of the first and the last knot where nothing is known


@dataclass(frozen=True)
class Beginning:
    """Where a reconstruction of scalars begins.

    Attributes:
        mesh: The mesh.
        scalars: (V,) in [0, 1].
        function: The transfer function.
    """

    mesh: TetMesh
    scalars: torch.Tensor
    function: TransferFunction


def beginning_by_colors(
    capture: Capture,
    function: TransferFunction | None,
    attenuation: float,
    config: ScalarConfig,
    mesh: TetMesh | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Beginning:
    """Fits colours and densities, and finds the scalars that look like them.

    Args:
        capture: Cameras and images.
        function: The transfer function; None: unknown, then denser is more, and the function is what that makes of the
            colours.
        attenuation: Density of opacity 1.
        config: Options.
        mesh: Mesh to begin with.
        on_progress: Called after every iteration.
    """
    found = fit(capture, config.of_field(), mesh=mesh, on_progress=on_progress)
    if function is None:
        scalars, function = ranked(found.field, attenuation, config.knots)
    else:
        scalars = matching(found.mesh, found.field, function, attenuation)
    return Beginning(found.mesh, scalars, function)


def matching(mesh: TetMesh, field: Field, function: TransferFunction, attenuation: float) -> torch.Tensor:
    """(V,) scalars in [0, 1] whose colours and opacities are most like a field's, and like their neighbours' scalars.

    A vertex is as opaque as its density makes a way of the mean length of its edges. Sweeps over all vertices alternate
    with means of their neighbours (iterated conditional modes, Besag 1986).

    Args:
        mesh: The mesh.
        field: Colours and densities on its vertices.
        function: The transfer function.
        attenuation: Density of opacity 1.
    """
    edges = mesh.topology.edges.long()
    counts = torch.bincount(edges.reshape(-1), minlength=mesh.num_vertices).clamp(min=1)
    lengths = (mesh.vertices[edges[:, 0]] - mesh.vertices[edges[:, 1]]).norm(dim=1)
    ways = (_gathered(edges, lengths, lengths, mesh.num_vertices) / counts)[:, None]
    places = torch.linspace(0.0, 1.0, _CANDIDATES, device=edges.device)
    colors, opacities = function(places.cpu())
    colors, densities = colors.to(ways), (attenuation * opacities).to(ways)
    found = _looks(field.density[:, None], field.color, ways)[:, 0]
    costs = torch.cat(
        [
            (_looks(densities[None], colors, part) - own[:, None]).square().sum(-1)
            for part, own in zip(ways.split(_VERTICES_AT_ONCE), found.split(_VERTICES_AT_ONCE), strict=True)
        ]
    )
    scalars = places[costs.argmin(1)]
    for _ in range(_SWEEPS):
        means = _gathered(edges, scalars[edges[:, 1]], scalars[edges[:, 0]], mesh.num_vertices) / counts
        scalars = places[(costs + _SMOOTHNESS * (places - means[:, None]).square()).argmin(1)]
    return scalars


def ranked(field: Field, attenuation: float, knots: int) -> tuple[torch.Tensor, TransferFunction]:
    """Scalars that grow with the density, evenly spread over [0, 1], and the function that makes the field of them.

    Args:
        field: Colours and densities on vertices.
        attenuation: Density of opacity 1.
        knots: How many the function is to have.
    """
    count = len(field.density)
    order = field.density.argsort(stable=True)
    scalars = torch.empty_like(field.density)
    scalars[order] = torch.linspace(0.0, 1.0, count, device=order.device, dtype=scalars.dtype)
    nearest = (scalars * (knots - 1)).round().long()
    values = torch.cat((field.color, (field.density / attenuation).clamp(_CLEAR, _OPAQUE)[:, None]), 1)
    sums = values.new_zeros(knots, 4).index_add_(0, nearest, values)
    weights = torch.bincount(nearest, minlength=knots).clamp(min=1)[:, None]
    means = (sums / weights).cpu()
    return scalars, TransferFunction(torch.linspace(0.0, 1.0, knots), means[:, 3], means[:, :3], "ranked")


def _looks(densities: torch.Tensor, colors: torch.Tensor, ways: torch.Tensor) -> torch.Tensor:
    """(N, K, 4) premultiplied colours and opacities of ways (N, 1) through densities and colours."""
    opacity = 1.0 - torch.exp(-densities * ways)[..., None]
    rest = colors[:, None] if densities.shape[1] == 1 else colors[None]
    return torch.cat((opacity * rest, opacity), -1)


def _gathered(edges: torch.Tensor, first: torch.Tensor, second: torch.Tensor, count: int) -> torch.Tensor:
    """(V,) sums over edges: ``first`` at their first ends, ``second`` at their second ones."""
    return first.new_zeros(count).index_add_(0, edges[:, 0], first).index_add_(0, edges[:, 1], second)
