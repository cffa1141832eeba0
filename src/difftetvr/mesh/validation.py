"""What makes a tetrahedral mesh valid, and the sentence a user reads when it is not."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.arrays import chunks, true_indices
from difftetvr.mesh.limits import MAX_CELLS

_SIGN_CERTAIN = 2.0**-48
"""A determinant above this times the product of its three edges' lengths has a certain sign in float64.

Rounding differences, products and sums costs less than 20 units of 2**-53 of that product.
"""


def as_vertices(vertices: Any, *, unrounded: bool = False) -> torch.Tensor:
    """Vertex positions as a tensor; one that is float32 or float64 already is returned as it is, with its graph.

    Args:
        vertices: (V, 3) array-like of real numbers.
        unrounded: Return lists and numbers of other types as float64; else they become float32.

    Returns:
        (V, 3) float32 or float64.

    Raises:
        MeshError: The shape is not (V, 3), or the values are no real numbers.
    """
    tensor = _as_tensor(vertices, "The vertices")
    if tensor.ndim != 2 or tensor.shape[1] != 3:
        raise MeshError(f"The vertices have shape {tuple(tensor.shape)}; pass positions of shape (V, 3).")
    if tensor.is_complex() or tensor.dtype == torch.bool:
        raise MeshError(f"The vertices are {tensor.dtype}; pass positions as float32 or float64.")
    if is_stored_in_floats(vertices):
        return tensor
    return tensor.to(torch.float64 if unrounded else torch.float32)


def is_stored_in_floats(values: Any) -> bool:
    """Whether an array or a tensor is float32 or float64 already."""
    if isinstance(values, torch.Tensor):
        return values.dtype in (torch.float32, torch.float64)
    return isinstance(values, np.ndarray) and values.dtype.kind == "f" and values.dtype.itemsize in (4, 8)


def as_tets(tets: Any, num_vertices: int, device: torch.device) -> torch.Tensor:
    """Vertex indices of cells as a new int32 tensor, checked to be in range.

    Args:
        tets: (T, 4) array-like of integers.
        num_vertices: Number of vertices V.
        device: Where the result shall lie.

    Returns:
        (T, 4) int32, a copy.

    Raises:
        MeshError: The shape is not (T, 4), there is no cell, there are too many, or an index is no integer in [0, V).
    """
    tensor = _as_tensor(tets, "The cells")
    if tensor.ndim != 2 or tensor.shape[1] != 4:
        raise MeshError(f"The cells have shape {tuple(tensor.shape)}; pass vertex indices of shape (T, 4).")
    if tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool:
        raise MeshError(f"The cells' vertex indices are {tensor.dtype}; pass integers.")
    if not 1 <= tensor.shape[0] <= MAX_CELLS:
        raise MeshError(f"The mesh has {tensor.shape[0]} cells; pass at least 1 and at most {MAX_CELLS}.")
    for part in chunks(tensor.shape[0], tensor.device, width=4):
        outside = (tensor[part] < 0) | (tensor[part] >= num_vertices)
        if outside.any():
            row, column = torch.nonzero(outside)[0].tolist()
            raise MeshError(
                f"Cell {part.start + row}: its vertex index {int(tensor[part][row, column])} is out of range; "
                f"the mesh has {num_vertices} vertices, so indices go from 0 to {num_vertices - 1}."
            )
    return tensor.to(device=device, dtype=torch.int32, copy=True).contiguous()


def check_finite(vertices: torch.Tensor, tets: torch.Tensor) -> None:
    """Refuse NaN and infinite positions.

    Args:
        vertices: (V, 3) positions.
        tets: (T, 4) int32 vertex indices in range.

    Raises:
        MeshError: Names the first cell with such a vertex, or the vertex where no cell uses it.
    """
    finite = torch.isfinite(vertices.detach()).all(1)
    if finite.all():
        return
    bad_cells = torch.nonzero(~finite[tets].all(1)).squeeze(1)
    if bad_cells.numel():
        cell = int(bad_cells[0])
        vertex = next(int(v) for v in tets[cell] if not finite[v])
        where = f"Cell {cell}: its vertex {vertex}"
    else:
        vertex = int(torch.nonzero(~finite)[0, 0])
        where = f"Vertex {vertex}, which no cell uses,"
    position = ", ".join(f"{x:g}" for x in vertices[vertex].tolist())
    raise MeshError(f"{where} is at ({position}); give every vertex a finite position.")


def orientations(vertices: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """Exact signs of the cells' volumes for the positions as stored, whatever the unit of length.

    Determinants are computed in float64; the few whose sign rounding could change are decided in rational arithmetic.

    Args:
        vertices: (V, 3) finite positions, float32 or float64.
        tets: (T, 4) int32 vertex indices in range.

    Returns:
        (T,) int8: 1 positive, -1 inverted, 0 exactly flat.
    """
    # A power of two as the unit of length changes no digit, and keeps cubes of extreme float64 coordinates in range.
    positions = vertices.detach().double()
    _, exponent = torch.frexp(positions.abs().max())
    unit = torch.exp2(-exponent.double().clamp(-1000, 1000))
    axes = (positions * unit).t().contiguous()
    signs = torch.empty(tets.shape[0], dtype=torch.int8, device=tets.device)
    uncertain = []
    for part in chunks(tets.shape[0], tets.device):
        determinant, bound = _determinants(axes, tets[part])
        signs[part] = torch.sign(determinant).to(torch.int8)
        unsure = ~(determinant.square() > bound)
        if unsure.any():
            uncertain.append(true_indices(unsure) + part.start)
    if uncertain:
        cells = torch.cat(uncertain)
        signs[cells] = _exact_signs(positions, tets[cells]).to(signs.device)
    return signs


def check_not_flat(vertices: torch.Tensor, tets: torch.Tensor, signs: torch.Tensor) -> None:
    """Refuse cells without volume.

    A cell passes however thin it is: only a volume of exactly zero, for the positions as stored, is an error.

    Args:
        vertices: (V, 3) finite positions.
        tets: (T, 4) int32 vertex indices in range.
        signs: (T,) int8 from `orientations`.

    Raises:
        MeshError: Names the first flat cell and says whether it repeats a vertex or two of its vertices coincide.
    """
    flat = true_indices(signs == 0)
    if not flat.numel():
        return
    cell = int(flat[0])
    corners = tets[cell].tolist()
    names = "(" + ", ".join(str(v) for v in corners) + ")"
    repeated = next((v for v in corners if corners.count(v) > 1), None)
    if repeated is not None:
        raise MeshError(f"Cell {cell}: it uses vertex {repeated} twice {names}; give it four different vertices.")
    raise MeshError(
        f"Cell {cell}: its volume is zero, as its vertices {names} lie in one plane; remove the cell or move a vertex."
    )


def check_positive(vertices: torch.Tensor, tets: torch.Tensor) -> None:
    """Refuse positions that flatten or invert a cell of an oriented mesh.

    Args:
        vertices: (V, 3) positions.
        tets: (T, 4) int32 vertex indices of cells that were positive once.

    Raises:
        MeshError: Names the first cell that has a vertex that is not finite, is flat or is inverted.
    """
    check_finite(vertices, tets)
    signs = orientations(vertices, tets)
    check_not_flat(vertices, tets, signs)
    inverted = true_indices(signs < 0)
    if inverted.numel():
        raise MeshError(
            f"Cell {int(inverted[0])}: the vertex positions turn it inside out ({inverted.numel()} such cells in all); "
            "move its vertices by less than its smallest altitude."
        )


def _as_tensor(values: Any, what: str) -> torch.Tensor:
    if isinstance(values, torch.Tensor):
        if values.layout != torch.strided or values.device.type == "meta":
            kind = f"{values.layout} tensor on '{values.device}'"
            raise MeshError(f"{what} are a {kind}, which does not hold them one by one; pass a dense tensor.")
        return values
    try:
        array = np.asarray(values)
        if array.dtype.kind == "u":
            array = array.astype(np.int64)
        # Torch takes neither foreign byte orders nor negative strides.
        return torch.from_numpy(np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("=")))
    except (TypeError, ValueError) as error:
        raise MeshError(f"{what} cannot be read as an array of numbers; pass a tensor or a numeric array.") from error


def _determinants(axes: torch.Tensor, tets: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Determinant of the edges from the first vertex, and the bound above which its square makes the sign certain."""
    corners = [column.contiguous() for column in tets.unbind(1)]
    origin = [axis.index_select(0, corners[0]) for axis in axes]
    edges = [[axis.index_select(0, corners[k]).sub_(o) for axis, o in zip(axes, origin)] for k in (1, 2, 3)]
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = edges
    determinant = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    bound = torch.full_like(determinant, _SIGN_CERTAIN**2)
    for x, y, z in edges:
        bound *= x * x + y * y + z * z
    return determinant, bound


def _exact_signs(positions: torch.Tensor, tets: torch.Tensor) -> torch.Tensor:
    """Signs of the determinants in rational arithmetic, (N,) int8 on the CPU."""
    corners = positions[tets].cpu().tolist()
    signs = torch.zeros(len(corners), dtype=torch.int8)
    for i, points in enumerate(corners):
        origin, *others = [[Fraction(x) for x in point] for point in points]
        a, b, c = [[x - o for x, o in zip(point, origin)] for point in others]
        determinant = (
            a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        signs[i] = (determinant > 0) - (determinant < 0)
    return signs
