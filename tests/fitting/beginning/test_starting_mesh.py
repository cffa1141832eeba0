"""Meshes that a reconstruction begins with, made for what the images show."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import difftetvr as dtv
from difftetvr.capture.orbit import fibonacci_orbit
from difftetvr.errors import FitError
from difftetvr.fitting.beginning.starting_mesh import starting_mesh
from difftetvr.mesh import MeshChange, TetMesh

RADIUS = 0.6


@pytest.fixture(scope="module")
def ball() -> dtv.Capture:
    """Views of a ball in the middle of a box, with alpha."""
    cameras = fibonacci_orbit(20, torch.zeros(3), 4.0, 0.7, 40, 40)
    y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    camera = cameras[0]
    rays = torch.stack(((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)), -1)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    hit = (1.0 - rays[..., 2] ** 2).sqrt() * 4.0 < RADIUS
    alphas = hit.float().expand(20, -1, -1).contiguous()
    return dtv.Capture(
        list(cameras),
        (0.5 * alphas)[..., None].expand(-1, -1, -1, 3).contiguous(),
        alphas,
        torch.arange(20) % 8 == 0,
        torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
        "ball",
        encoding="srgb",
    )


@pytest.fixture(scope="module")
def room(ball: dtv.Capture) -> dtv.Capture:
    """Views without alpha of a ball with points on it, in a room."""
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=1) * RADIUS
    walls = torch.rand(40, 3, generator=generator) * 18.0 - 9.0
    return dataclasses.replace(
        ball,
        images=ball.images + 0.2,
        alphas=None,
        points=torch.cat((points, walls, points[:5])),
        surroundings=9.0,
    )


def start(capture: dtv.Capture, **options: object) -> TetMesh:
    config = dtv.FitConfig(**options).for_capture(capture)
    return starting_mesh(capture, config, config.strategy())


def test_the_hull_is_kept_and_what_silhouettes_rule_out_is_not(ball: dtv.Capture) -> None:
    mesh = start(ball, cells=20_000)
    mesh.validate()
    assert abs(mesh.num_cells - 20_000) < 1000
    volume = float(mesh.volumes().sum())
    assert 4.18879 * RADIUS**3 < volume < 0.5 * 8.0
    # Cells are of one size, so those that are saved make the others finer.
    assert float(mesh.volumes().mean()) < 0.6 * 8.0 / 20_000
    field = dtv.Field(torch.zeros(mesh.num_vertices, 3), torch.full((mesh.num_vertices,), 1e3))
    eye = torch.tensor([0.0, 0.0, 4.0])
    camera = dtv.Camera.look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), fov_y=0.7, width=40, height=40)
    assert (dtv.render(mesh, field, camera).alpha[ball.alphas[0] > 0] > 0.99).all()
    # Twenty silhouettes leave corners between them, but none that reaches far.
    assert float(mesh.vertices.norm(dim=1).max()) < 1.5


def test_cubes_that_are_given_are_carved(ball: dtv.Capture) -> None:
    coarse, full = start(ball, grid=(10, 10, 10)), start(ball, grid=(10, 10, 10), start="grid")
    assert full.num_cells == 6000 and 1000 < coarse.num_cells < 5000
    corners = {tuple(v) for v in full.vertices.tolist()}
    assert all(tuple(v) in corners for v in coarse.vertices.tolist())


def test_hulls_of_next_to_nothing(ball: dtv.Capture) -> None:
    dot = torch.zeros_like(ball.alphas)
    dot[:, 19:21, 19:21] = 1.0
    mesh = start(dataclasses.replace(ball, alphas=dot), cells=5_000)
    mesh.validate()
    assert 500 < mesh.num_cells <= 5_500 and float(mesh.vertices.norm(dim=1).max()) < 0.6
    with pytest.raises(FitError, match="No place in the bounds of 'ball' lies within the silhouettes"):
        start(dataclasses.replace(ball, alphas=torch.zeros_like(dot)), cells=5_000)


def test_a_shell_surrounds_the_grid_where_there_are_surroundings(room: dtv.Capture) -> None:
    mesh = start(room, cells=30_000, start="grid")
    mesh.validate()
    assert abs(mesh.num_cells - 30_000) < 3000
    torch.testing.assert_close(mesh.bounds(), torch.tensor([[-9.0] * 3, [9.0] * 3]))
    inside = (mesh.vertices.abs() <= 1.0 + 1e-5).all(1)
    assert int(inside.sum()) > mesh.num_vertices / 15


@pytest.mark.parametrize("cells", [2_000, 20_000])
def test_points_become_vertices_and_a_lattice_fills_the_rest(room: dtv.Capture, cells: int) -> None:
    mesh = start(room, cells=cells, start="points")
    mesh.validate()
    assert 0.6 * cells < mesh.num_cells < 1.3 * cells
    torch.testing.assert_close(mesh.bounds(), torch.tensor([[-9.0] * 3, [9.0] * 3]))
    points = room.points[:300]
    taken = (torch.cdist(points, mesh.vertices).amin(1) < 1e-6).sum()
    # Points nearer to each other than cells are large are thinned.
    assert taken > (80 if cells == 20_000 else 20)
    assert float(mesh.volumes().sum()) == pytest.approx(18.0**3, rel=1e-4)


@pytest.mark.parametrize("cells", [1, 10, 100])
@pytest.mark.parametrize("kind", ["grid", "hull", "points"])
def test_small_budgets(ball: dtv.Capture, room: dtv.Capture, kind: str, cells: int) -> None:
    mesh = start(ball if kind == "hull" else room, cells=cells, start=kind)
    mesh.validate()
    assert 1 <= mesh.num_cells < 400


def test_surroundings_thinner_than_a_cube_belong_to_the_grid(room: dtv.Capture) -> None:
    tight = dataclasses.replace(room, surroundings=1.1)
    mesh = start(tight, cells=1000, start="grid")
    torch.testing.assert_close(mesh.bounds(), torch.tensor([[-1.1] * 3, [1.1] * 3]))
    assert float(mesh.volumes().max() / mesh.volumes().min()) < 1.01


def test_what_the_images_lack_is_said(ball: dtv.Capture, room: dtv.Capture) -> None:
    with pytest.raises(FitError, match="has no points within its bounds to start from; use --start grid"):
        start(ball, start="points")
    with pytest.raises(FitError, match="has no points within its bounds"):
        start(dataclasses.replace(room, points=room.points + 100.0), start="points")
    with pytest.raises(FitError, match="Nothing tells the object of 'ball' from its background"):
        start(room, start="hull")
    with pytest.raises(FitError, match=r"grid is .* left out where the mesh starts from points"):
        dtv.FitConfig(grid=(2, 2, 2), start="points")


def test_starts_and_cells_are_chosen_for_the_images(ball: dtv.Capture, room: dtv.Capture) -> None:
    assert dtv.FitConfig().for_capture(ball).start == "hull"
    assert dtv.FitConfig().for_capture(room).start == "points"
    assert dtv.FitConfig().for_capture(dataclasses.replace(room, points=None)).start == "grid"
    assert dtv.FitConfig(grid=(2, 2, 2)).for_capture(room).start == "grid"
    assert dtv.FitConfig().for_capture(dataclasses.replace(room, points=room.points + 100.0)).start == "grid"
    large = dataclasses.replace(
        ball,
        cameras=[dataclasses.replace(c, width=400, height=400) for c in ball.cameras],
        images=torch.full((20, 400, 400, 3), 0.5),
        alphas=None,
    )
    assert dtv.FitConfig().for_capture(large).cells == 17 * 400 * 400 // 12
    assert dtv.FitConfig().for_capture(ball).cells == 20_000
    volume = dataclasses.replace(large, encoding="linear")
    assert dtv.FitConfig().for_capture(volume).cells == 20_000
    assert [dtv.FitConfig().for_capture(seen).averaging for seen in (volume, ball, room)] == [0.25, 0.0, 0.0]


def test_densities_are_counted_in_smaller_units_far_away(room: dtv.Capture) -> None:
    places = torch.tensor([[0.0, 0.0, 0.0], [0.9, -0.9, 0.0], [3.0, 0.0, 1.0], [0.0, -9.0, 9.0]])
    units = room.density_units_at(places) / room.density_unit
    torch.testing.assert_close(units, torch.tensor([1.0, 1.0, 1 / 3, 1 / 9]))
    assert room.density_unit == 12.5


def test_bisecting_where_units_differ_changes_nothing(room: dtv.Capture) -> None:
    from difftetvr.fitting.parameters import FieldParameters
    from difftetvr.mesh.changes.bisection import bisect_edges, independent_edges

    mesh = start(room, cells=3_000, start="grid")
    config = dtv.FitConfig(harmonics=0)
    parameters = FieldParameters(mesh, config, room.density_units_at(mesh.vertices))
    with torch.no_grad():
        parameters.density.copy_(torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(1)))
    parameters.keep_free(mesh.vertices[:, 0] > 0.5)
    before = parameters.detached_field()
    count = mesh.topology.edges.shape[0]
    chosen = independent_edges(mesh, torch.arange(count).float(), torch.ones(count, dtype=torch.bool), 500)
    change: MeshChange = bisect_edges(mesh, chosen)
    parameters.carry(change)
    torch.testing.assert_close(parameters.detached_field().density, change.carry(before.density))
    assert torch.equal(parameters.is_free, ~change.is_new & (change.mesh.vertices[:, 0] > 0.5))
    camera = room.cameras[3]
    with torch.no_grad():
        images = [dtv.render(mesh, before, camera), dtv.render(change.mesh, parameters.detached_field(), camera)]
    torch.testing.assert_close(images[0].color, images[1].color, atol=1e-4, rtol=0)


def test_a_few_transparent_pixels_are_no_silhouette(ball: dtv.Capture) -> None:
    corner = torch.ones_like(ball.alphas)
    corner[:, :4, :4] = 0.0  # as undistorted photographs have
    photo = dataclasses.replace(ball, alphas=corner)
    assert photo.silhouettes is None and dtv.FitConfig().for_capture(photo).background == "black"
    # Held-out views have no say.
    held_out = torch.where(ball.test[:, None, None], torch.zeros(()), torch.ones_like(ball.alphas))
    assert dataclasses.replace(ball, alphas=held_out).silhouettes is None
    assert ball.silhouettes is not None and len(ball.silhouettes) == len(ball.train_indices)


def test_a_blank_image_rules_nothing_out(ball: dtv.Capture) -> None:
    alphas = ball.alphas.clone()
    alphas[1] = 0.0
    options = {"grid": (10, 10, 10)}
    blank, whole = start(dataclasses.replace(ball, alphas=alphas), **options), start(ball, **options)
    assert whole.num_cells <= blank.num_cells < 1.2 * whole.num_cells


def test_refinement_predicts_nothing_where_nothing_would_change(room: dtv.Capture) -> None:
    """Colours and densities are the same everywhere, so flips and collapses are worth nothing, also in the shell."""
    from difftetvr.fitting.refinement.gains import collapse_costs, flip_gains
    from difftetvr.fitting.trainer import Trainer
    from difftetvr.mesh.boundary import removable_vertices
    from difftetvr.mesh.changes.flip_search import find_flips

    trainer = Trainer(room, dtv.FitConfig(cells=3_000, start="grid", harmonics=0, device="cpu"))
    with torch.no_grad():
        trainer.parameters.density.copy_(0.05 * room.density_unit / trainer.parameters.density_unit)
    values = trainer.parameters.values(room.density_unit)
    torch.testing.assert_close(values[:, 3], torch.full_like(values[:, 3], 0.05))
    mesh = trainer.mesh
    model = trainer._judgement(2, 2.0).model(mesh, trainer.parameters.detached_field(), True)
    model = model.with_density_unit(room.density_unit)
    bisections = model.edges.gradient.abs().max()
    flips = find_flips(mesh, min_quality=0.0)
    gains = flip_gains(flips, flips.surplus(values), model)
    costs = collapse_costs(mesh, values, model.vertices, removable_vertices(mesh, slide=True), 1.0)
    assert float(bisections) > 1e-5
    assert float(gains.abs().max()) < 1e-9 and float(costs.cost.abs().max()) < 1e-9
