"""Pencils of rays: what is looked for once for neighbours is what each would find for itself, to the last bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st
from rendering.bundles import flat

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, LensCamera, PanoramicCamera, ParallelCamera, Rays, render
from difftetvr.rendering.search import pencils
from difftetvr.rendering.search.pencils import Pencils

POSE = Camera.look_at((2.0, 1.7, 1.4), (0.5, 0.5, 0.5)).world_to_camera


@contextmanager
def found_by(change: Callable[[Pencils], Pencils]) -> Iterator[None]:
    """What pencils met is changed, in kernels that are traced anew."""
    original = Pencils.through
    with pytest.MonkeyPatch.context() as patch, dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        patch.setattr(Pencils, "through", staticmethod(lambda *given: change(original(*given))))
        yield


def each_for_itself(found: Pencils) -> Pencils:
    """As if all pencils had met too much."""
    return Pencils(found.items, dr.full(type(found.count), pencils.ROOM + 1, dr.width(found.count)))


def image_of(mesh: TetMesh, rays: Rays, change: Callable[[Pencils], Pencils]) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    color, density = (torch.rand(mesh.num_vertices, count, generator=generator) for count in (3, 1))
    field = Field(color, density[:, 0]).to(dtype=mesh.vertices.dtype)
    with found_by(change):
        return flat(render(mesh, field, rays))


def checked(mesh: TetMesh, rays: Rays) -> np.ndarray:
    """(pencils,) how many half-faces each of them met, of rays that see the same with and without them."""
    counts: list[np.ndarray] = []

    def noted(found: Pencils) -> Pencils:
        counts.append(np.array(found.count))
        return found

    image = image_of(mesh, rays, noted)
    assert torch.equal(image, image_of(mesh, rays, each_for_itself))
    return counts[0]


def carved(size: int = 12, dtype: torch.dtype = torch.float32) -> TetMesh:
    """A grid without the cells in some balls and beyond a plane, so that there are many ways in."""
    mesh = TetMesh.grid((size,) * 3, dtype=dtype)
    centers = mesh.vertices[mesh.tets.long()].mean(1)
    balls = torch.tensor([[0.2, 0.3, 0.4], [0.7, 0.6, 0.5], [0.4, 0.8, 0.2], [0.9, 0.1, 0.8]], dtype=dtype)
    kept = (torch.cdist(centers, balls) > 0.22).all(1) & (centers.sum(1) < 2.3)
    return TetMesh(mesh.vertices, mesh.tets[kept]).without_unused_vertices()[0]


def squashed(scale: tuple[float, float, float], offset: float = 0.0) -> TetMesh:
    mesh = carved()
    return mesh.with_vertices((mesh.vertices - 0.5) * torch.tensor(scale) + 0.5 + offset)


MESHES = {
    "cube": TetMesh.grid((6, 6, 6)),
    "one cell": TetMesh(torch.eye(4)[:, :3].contiguous(), torch.tensor([[3, 0, 1, 2]])),
    "carved": carved(),
    "carved, float64": carved(dtype=torch.float64),
    "slivers": squashed((1.0, 1.0, 1e-4)),
    "needles": squashed((1e-3, 1e-3, 1.0)),
    "far away": squashed((1.0, 1.0, 1.0), 300.0),
}
# Rays of the first run within planes of the grids, through their edges and vertices.
ALONG_Z = torch.tensor([[1.0, 0, 0, -0.5], [0, 1.0, 0, -0.5], [0, 0, 1.0, 3.0], [0, 0, 0, 1.0]])
VIEWS = {
    "along planes": ParallelCamera(ALONG_Z, [1 / 24, 1 / 24], 36, 36).rays(),
    "parallel": ParallelCamera(POSE, [0.05, 0.06], 40, 30).rays(),
    "pinhole": Camera(POSE, 60.0, 55.0, 20.3, 17.1, 40, 36).rays(),
    "fisheye": LensCamera(POSE, 20.0, 21.0, 20.3, 17.1, 40, 36, model="fisheye", coefficients=[0.1, -0.02]).rays(),
    "panorama from inside": PanoramicCamera.look_at((0.5, 0.5, 0.45), (1.0, 0.6, 0.55), width=48, height=24).rays(),
    "panorama from a vertex": PanoramicCamera.look_at((0.5, 0.5, 0.5), (1.0, 0.5, 0.5), width=48, height=24).rays(),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("mesh", MESHES)
def test_neighbours_find_what_each_finds_for_itself(mesh: str, view: str) -> None:
    rays, it = VIEWS[view], MESHES[mesh]
    if mesh == "far away":
        rays = Rays(rays.origins.double() + 300.0, rays.directions, rays.near, rays.far)
    met = checked(it, rays)
    assert len(met) == -(-rays.shape.numel() // pencils.RAYS)
    if it.num_cells > 1:
        assert met.max() > 0
    if "planes" not in view:
        assert (met <= pencils.ROOM).mean() > 0.1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@given(
    seed=st.integers(0, 1 << 20),
    origin_spread=st.integers(-9, 1),
    direction_spread=st.integers(-9, 1),
    at_vertex=st.booleans(),
    limits=st.sampled_from([None, (0.0, 1.0), (0.5, 0.9)]),
)
@examples(40)
def test_rays_that_lie_as_close_as_can_be(
    dtype: torch.dtype, seed: int, origin_spread: int, direction_spread: int, at_vertex: bool, limits: Any
) -> None:
    mesh, generator = (
        MESHES["carved" if dtype == torch.float32 else "carved, float64"],
        torch.Generator().manual_seed(seed),
    )
    origin, target = (3.0 * torch.rand(3, generator=generator, dtype=torch.float64) - 1.0 for _ in range(2))
    if at_vertex:
        target = mesh.vertices[seed % mesh.num_vertices].double()
    origins, directions = (
        middle + 10.0**spread * (torch.rand(64, 3, generator=generator, dtype=torch.float64) - 0.5)
        for middle, spread in ((origin, origin_spread), (target - origin, direction_spread))
    )
    checked(mesh, Rays(origins, directions, *(limits or (-torch.inf, torch.inf))))


def test_pencils_of_rays_with_nothing_in_common_leave_them_to_themselves() -> None:
    generator = torch.Generator().manual_seed(0)
    rays = Rays(torch.rand(256, 3, generator=generator), torch.randn(256, 3, generator=generator))
    assert bool((checked(TetMesh.grid((8, 8, 8)), rays) > pencils.ROOM).all())


def test_what_is_not_looked_at_widens_no_pencil() -> None:
    """Pixels that a lens cannot have made end before they begin, in whichever direction."""
    rays = VIEWS["pinhole"]
    origins, directions = rays.origins.expand(*rays.shape, 3).reshape(-1, 3), rays.directions.reshape(-1, 3).clone()
    alone = checked(MESHES["cube"], Rays(origins, directions))
    far = torch.full((len(directions),), torch.inf)
    directions[::5], far[::5] = -directions[::5], 0.0
    met = checked(MESHES["cube"], Rays(origins, directions, 0.0, far))
    assert 0 < met.sum() <= alone.sum()


@pytest.mark.parametrize("mesh", ["cube", "carved", "carved, float64", "slivers", "far away"])
def test_rays_through_vertices_and_edges(mesh: str) -> None:
    """Which face holds such a ray is rounding's to say, and no pencil knows better, however thin it is."""
    it, generator = MESHES[mesh], torch.Generator().manual_seed(1)
    ends = it.vertices[it.tets[::3].long()].double()
    targets = torch.cat([ends[:, 0], 0.5 * (ends[:, 1] + ends[:, 2]), 0.3 * ends[:, 2] + 0.7 * ends[:, 3]])
    middle = it.vertices.double().mean(0)
    origins = middle + 2.0 * torch.randn(len(targets), 3, generator=generator, dtype=torch.float64)
    origins, directions = (part.repeat_interleave(pencils.RAYS, 0) for part in (origins, targets - origins))
    assert checked(it, Rays(origins, directions)).any()


@pytest.mark.parametrize(
    ("dtype", "scale", "far"),
    [
        (torch.float32, 1.0, 1e20),
        (torch.float32, 1.0, 1e38),
        (torch.float32, 1e-20, 1.0),
        (torch.float64, 1.0, 1e160),
        (torch.float64, 1.0, 1e300),
    ],
)
def test_a_ray_that_passes_far_away_takes_no_other_with_it(dtype: torch.dtype, scale: float, far: float) -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=dtype)
    mesh = mesh.with_vertices(scale * mesh.vertices)
    field = Field(torch.ones(27, 3, dtype=dtype), torch.ones(27, dtype=dtype) / scale)
    origins = scale * torch.tensor([[0.3, 0.4, -2.0]], dtype=torch.float64).repeat(16, 1)
    directions = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).repeat(16, 1)
    origins[3, :2] = far
    image = render(mesh, field, Rays(origins, directions)).color
    alone = render(mesh, field, Rays(origins[:1], directions[:1])).color
    assert bool((image[3] == 0).all()) and bool((alone > 0.5).all())
    assert torch.equal(image[torch.arange(16) != 3], alone.expand(15, 3))
