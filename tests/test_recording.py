"""Recorded kernels: results as of traced ones, and nothing traced or compiled for what differs in arrays alone."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import pytest
import torch

from difftetvr.backend import Backend, get_backend
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.changes.bisection import bisect_edges
from difftetvr.mesh.changes.collapse import collapse_edges
from difftetvr.recording import few_lengths, replayed
from difftetvr.rendering import Camera, Rays, render


@dataclass
class Line:
    """Coefficients of a straight line, one for all lanes or one each, and whether to go up it or down."""

    backend: Backend
    slope: Any
    offset: Any
    is_rising: bool


def at(line: Line, places: list[Any], traces: Callable[[], None] | None = None) -> tuple[Any, Any]:
    rise = line.slope * places[0]
    value = line.offset + rise if line.is_rising else line.offset - rise
    dr.eval(value)
    return value, line.backend.Float(2) * value


def test_replays_give_what_traces_give() -> None:
    backend = get_backend("cpu", torch.float64)
    for seed, count in ((0, 50), (1, 50), (2, 7), (3, 4000)):
        slope, offset, x = torch.rand(3, count, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        for is_rising in (True, False):
            line = Line(backend, backend.floats(slope), backend.floats(offset), is_rising)
            value, twice = replayed(at, line, [backend.floats(x)])
            expected = offset + slope * x if is_rising else offset - slope * x
            assert torch.allclose(backend.tensor(value), expected, rtol=1e-15)
            assert torch.allclose(backend.tensor(twice), 2 * expected, rtol=1e-15)


def test_what_may_hold_anything_is_called_as_it_is() -> None:
    backend, calls = get_backend("cpu"), []

    def double(x: Any, note: Any) -> Any:
        calls.append(note)
        return 2.0 * x

    for k in range(3):
        note = [object()]  # no plain value: a model of the user's, for example
        assert replayed(double, backend.Float([float(k)]), note)[0] == 2.0 * k
    assert len(calls) == 3


def test_lengths_are_few_and_long_enough() -> None:
    lengths = {few_lengths(count) for count in range(1, 1 << 12)}
    assert all(count <= few_lengths(count) <= 1.25 * count + 1 for count in range(1 << 12))
    assert len(lengths) <= 4 * 12 + 1


def launches(run: Callable[[], object]) -> tuple[int, int, int]:
    """How many kernels a function has launched, how many of them it has traced, and how many compiled."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        run()
    kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    assert kernels
    replays = sum(entry["recording_mode"] == dr.KernelRecordingMode.Replayed for entry in kernels)
    return len(kernels), len(kernels) - replays, sum(not entry["cache_hit"] for entry in kernels)


def exchanged(mesh: TetMesh, seed: int) -> TetMesh:
    """A mesh with some edges halved and others collapsed."""
    generator = torch.Generator().manual_seed(seed)
    mesh = bisect_edges(mesh, torch.randperm(len(mesh.topology.edges), generator=generator)[:12]).mesh
    edges = torch.randperm(len(mesh.topology.edges), generator=generator)
    cost = torch.rand(len(edges), generator=generator)
    return collapse_edges(mesh, edges, torch.zeros_like(edges), cost, limit=60).mesh


def camera_at(eye: tuple[float, float, float]) -> Camera:
    return Camera.look_at(eye, (0, 0, 0), width=24, height=16)


def rays_from_many_places() -> Rays:
    origins, directions = torch.randn(2, 300, 3, generator=torch.Generator().manual_seed(0))
    return Rays(0.5 * origins, directions)


OUTSIDE, INSIDE = (2.5, 2.0, 1.5), (0.1, 0.05, 0.2)
VIEWS: dict[str, tuple[Callable[[], Camera | Rays], str]] = {
    "outside": (lambda: camera_at(OUTSIDE), "marching"),
    "inside": (lambda: camera_at(INSIDE), "marching"),
    "rays-outside": (lambda: camera_at(OUTSIDE).rays(), "marching"),
    "rays-inside": (lambda: camera_at(INSIDE).rays(), "marching"),
    "rays-anywhere": (rays_from_many_places, "marching"),
    "lists-outside": (lambda: camera_at(OUTSIDE), "linked-list"),
    "lists-inside": (lambda: camera_at(INSIDE), "linked-list"),
    "lists-of-rays": (rays_from_many_places, "linked-list"),
    "projected": (lambda: camera_at(OUTSIDE), "projected"),
}


def looked_at(mesh: TetMesh, view: str, requires_grad: bool) -> list[torch.Tensor]:
    """Random colours and densities seen, and derivatives."""
    rays, renderer = VIEWS[view][0](), VIEWS[view][1]
    values = torch.rand(mesh.num_vertices, 4, generator=torch.Generator().manual_seed(mesh.num_vertices))
    vertices = mesh.vertices.clone()
    for leaf in (values, vertices):
        leaf.requires_grad_(requires_grad)
    image = render(mesh.with_vertices(vertices), Field(values[:, :3], values[:, 3]), rays, renderer=renderer)
    if not requires_grad:
        return [image.color, image.optical_depth]
    image.color.square().sum().backward()
    assert values.grad is not None and vertices.grad is not None and bool(vertices.grad.any())
    return [image.color.detach(), values.grad, vertices.grad]


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.filterwarnings("ignore:The cells of this mesh have no certain")
def test_exchanges_of_cells_compile_nothing(view: str) -> None:
    mesh = TetMesh.grid((6, 6, 6), (-1, -1, -1), (1, 1, 1))
    launches(lambda: looked_at(mesh, view, True))  # recordings are made anew where the history is kept
    sizes, launched, traced, compiled = set(), 0, 0, 0
    for seed in range(40):
        mesh = exchanged(mesh, seed)
        sizes.add((mesh.num_vertices, mesh.num_cells))
        new = launches(lambda mesh=mesh: looked_at(mesh, view, True))
        launched, traced, compiled = launched + new[0], traced + new[1], compiled + new[2]
    assert len(sizes) > 30
    # The sizes pass a few of the lengths that buffers have; only then anything is traced, but for tiles.
    assert compiled <= 10 and traced < 0.4 * launched, (compiled, traced, launched)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.filterwarnings("ignore:The cells of this mesh have no certain")
def test_views_of_other_meshes_are_as_if_traced(view: str) -> None:
    """A recording holds nothing of the mesh that it was made with."""
    generator = torch.Generator().manual_seed(1)
    for cubes in ((3, 3, 3), (2, 4, 3), (5, 3, 4), (3, 3, 3), (7, 6, 8), (1, 1, 1)):
        mesh = TetMesh.grid(cubes, (-1, -1, -1), (1, 1, 1))
        mesh = mesh.with_vertices(mesh.vertices + 0.02 * torch.rand(mesh.vertices.shape, generator=generator))
        seen = looked_at(mesh, view, False)
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            expected = looked_at(mesh, view, False)
        for part, truth in zip(seen, expected, strict=True):
            assert bool(truth.any()) and torch.equal(part, truth)


def test_rendered_meshes_are_copied_and_pickled() -> None:
    mesh = TetMesh.grid((3, 3, 3))
    camera = Camera.look_at((3, 2, 2), (0.5, 0.5, 0.5), width=8, height=8)
    field = Field(torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices))
    image = render(mesh, field, camera)
    for other in (copy.deepcopy(mesh), pickle.loads(pickle.dumps(mesh))):
        assert torch.equal(other.topology.cell_adjacency, mesh.topology.cell_adjacency)
        assert torch.equal(render(other, field, camera).color, image.color)
