"""Grids: around meshes, and along axes of their own."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from sampling.meshes import bent_mesh

from difftetvr import probe, voxelise
from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.sampling import Grid

TURN = ((0.36, 0.48, -0.8), (-0.8, 0.6, 0.0), (0.48, 0.64, 0.6))
EXCHANGES = [
    tuple(map(tuple, (np.eye(3)[list(axes)] * np.array(signs)[:, None]).tolist()))
    for axes in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
]
"""All ways in which axes of a grid can run along the world's, mirrored ones among them."""


def points_of(grid: Grid) -> torch.Tensor:
    """(X, Y, Z, 3) places, by the definition."""
    axes = torch.tensor(grid.directions or np.eye(3).tolist(), dtype=torch.float64)
    indices = torch.stack(torch.meshgrid(*map(torch.arange, grid.shape), indexing="ij"), -1).double()
    return (
        torch.tensor(grid.origin, dtype=torch.float64)
        + (indices * torch.tensor(grid.spacing, dtype=torch.float64)) @ axes
    )


@given(
    box=st.tuples(*[st.floats(0.01, 10.0)] * 3),
    lower=st.floats(-50.0, 50.0),
    spacing=st.one_of(st.floats(0.05, 20.0), st.tuples(*[st.floats(0.1, 20.0)] * 3)),
)
@examples(50)
def test_voxels_fill_the_box_of_a_mesh_and_little_more(
    box: tuple[float, float, float], lower: float, spacing: Any
) -> None:
    mesh = TetMesh.grid((1, 1, 1), (lower,) * 3, tuple(lower + side for side in box), dtype=torch.float64)
    grid = Grid.around(mesh, spacing)
    low, high = mesh.bounds().tolist()
    for axis in range(3):
        step, count = grid.spacing[axis], grid.shape[axis]
        assert step == (spacing if isinstance(spacing, float) else spacing[axis])
        begin, end = grid.origin[axis] - 0.5 * step, grid.origin[axis] + (count - 0.5) * step
        # A side may be longer by a thousandth of a voxel than so many, so that rounding makes none that is empty.
        assert begin <= low[axis] + 5.1e-4 * step and end >= high[axis] - 5.1e-4 * step
        assert end - begin < high[axis] - low[axis] + step
        assert begin + end == pytest.approx(low[axis] + high[axis], abs=1e-9)


def test_sizes() -> None:
    mesh = TetMesh.grid((1, 1, 1), (0, 0, 0), (4, 2, 1), dtype=torch.float64)
    assert Grid.around(mesh).shape == (256, 128, 64)
    assert Grid.around(mesh) == Grid.around(mesh, size=256)
    grid = Grid.around(mesh, size=8)
    assert (grid.shape, grid.spacing, grid.origin) == ((8, 4, 2), (0.5, 0.5, 0.5), (0.25, 0.25, 0.25))
    grid = Grid.around(mesh, size=(8, 2, 1))
    assert (grid.shape, grid.spacing, grid.origin) == ((8, 2, 1), (0.5, 1.0, 1.0), (0.25, 0.5, 0.5))
    assert grid.num_points == 16


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("directions", [*EXCHANGES[::5], TURN, (TURN[1], TURN[0], TURN[2])])
def test_values_along_axes_of_their_own_are_those_of_probes(directions: Any, dtype: torch.dtype) -> None:
    mesh = bent_mesh(dtype=dtype)
    values = torch.rand(mesh.num_vertices, dtype=torch.float64)
    grid = Grid((0.4, 0.3, 0.6), (0.071, 0.083, 0.059), (7, 6, 5), directions)
    turned, straight = grid.seen_by(mesh)
    found = voxelise(turned, values, straight.origin, straight.spacing, straight.shape, outside=-1.0)
    expected = probe(mesh, values, points_of(grid), outside=-1.0)
    assert 0.05 < float((expected >= 0).double().mean()) < 0.95
    differs = (found - expected).abs() > (1e-9 if dtype == torch.float64 else 1e-4)
    # On the boundary itself rounding decides.
    assert int(differs.sum()) <= (0 if dtype == torch.float64 else 1)


def test_meshes_far_away_are_not_rounded() -> None:
    local = bent_mesh()
    shift = torch.tensor([4.2e5, 5.4e6, 300.0], dtype=torch.float64)
    mesh = TetMesh(local.vertices + shift, local.tets).to(dtype=torch.float32)
    values = torch.rand(local.num_vertices, dtype=torch.float64)
    near = Grid((0.4, 0.3, 0.6), (0.071,) * 3, (5, 5, 5), TURN)
    far = Grid(tuple((torch.tensor(near.origin, dtype=torch.float64) + shift).tolist()), near.spacing, near.shape, TURN)
    found = []
    for grid, mesh_seen in ((near, local), (far, mesh)):
        turned, straight = grid.seen_by(mesh_seen)
        found.append(voxelise(turned, values, straight.origin, straight.spacing, straight.shape).double())
    assert float((found[0] - found[1]).abs().max()) < 1e-3


def test_indices_of_a_mesh() -> None:
    mesh = TetMesh.grid((1, 1, 1), (1, 2, 3), (2, 4, 6), dtype=torch.float64)
    first, last = Grid((0, 0, 0), (0.5,) * 3, (4, 4, 4), EXCHANGES[-1]).corner_indices(mesh)
    # The last one: axes z, y, x, all reversed.
    assert first == pytest.approx([-12, -8, -4]) and last == pytest.approx([-6, -4, -2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin": (0, math.nan, 0)}, "origin is .*three finite numbers"),
        ({"spacing": (1, 0, 1)}, "spacing is .*greater than 0"),
        ({"shape": (4, 4)}, "shape is"),
        ({"directions": ((1, 0, 0), (0, 1, 0))}, "three unit vectors"),
        ({"directions": ((1, 0, 0), (0, 2, 0), (0, 0, 1))}, "three unit vectors"),
        ({"directions": ((1, 0, 0), (0, 1, 0), (0.6, 0.8, 0))}, "lie in one plane"),
        ({"space": "a\nb: c"}, "The grid's space is"),
        ({"unit": 3}, "The grid's unit is 3"),
    ],
)
def test_mistakes_get_one_sentence(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"origin": (0, 0, 0), "spacing": 0.1, "shape": (4, 4, 4)}
    with pytest.raises(MeshError, match=message) as error:
        Grid(**{**arguments, **change})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spacing": 0.5, "size": 8}, "leave one of them out"),
        ({"spacing": -1.0}, "spacing is -1.0; pass one or three finite numbers greater than 0"),
        ({"spacing": (1.0, 2.0)}, "pass one or three"),
        ({"spacing": 1e-9}, r"A spacing of 1e-09 makes a grid of 1e\+27 points"),
        ({"spacing": 5e-324}, "choose a coarser one"),
        ({"size": 0}, "size is 0"),
        ({"size": 2.5}, "size is 2.5; pass one or three whole numbers"),
        ({"size": 10**6}, r"A size of 1e\+06 makes a grid of 1e\+18 points"),
        ({"size": (10**6, 10**6, 1)}, r"A size of 1e\+06 x 1e\+06 x 1 makes"),
        ({"size": "all"}, "size is 'all'"),
    ],
)
def test_mistakes_about_grids_around_meshes(options: dict[str, Any], message: str) -> None:
    with pytest.raises(MeshError, match=message) as error:
        Grid.around(TetMesh.grid((1, 1, 1)), **options)
    assert "\n" not in str(error.value)
