"""Images of ``render`` against the float64 reference."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from oracle.scenes import (
    EXTREME_SCENES,
    SCENES,
    Scene,
    axis_camera,
    camera_at,
    jittered_grid,
    keep_cells,
    kuhn_grid,
    make_scene,
    random_camera,
    scaled,
    total_error,
)
from rendering.helpers import leaves_of, render_leaves, render_scene

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import RenderedImage, render

FLOAT32_TOLERANCE = 2e-5
FLOAT64_TOLERANCE = 1e-10


def assert_image(image: RenderedImage, scene: Scene, tolerance: float, nudge: tuple[float, float] = (0.0, 0.0)) -> None:
    """Colour and alpha within ``tolerance``; depth within ten times that of the scene's size.

    Expected depth is a quotient, so its error is that of radiance over alpha.
    """
    reference = scene.oracle(nudge)
    assert total_error(image.color, reference.color) < tolerance
    assert total_error(image.alpha, reference.alpha) < tolerance
    error = (image.depth.double() - reference.depth).abs() * reference.alpha.clamp(max=0.1)
    unit = scene.size + float(scene.camera.position.norm())
    assert total_error(error / unit, torch.zeros_like(error)) < tolerance


@pytest.mark.parametrize("name", [*SCENES, *EXTREME_SCENES])
def test_float32_image(name: str) -> None:
    scene = (SCENES | EXTREME_SCENES)[name]()
    image = render_scene(scene)
    height, width = scene.camera.height, scene.camera.width
    assert image.color.shape == (height, width, 3) and image.color.dtype == torch.float32
    assert image.alpha.shape == image.depth.shape == (height, width)
    assert_image(image, scene, FLOAT32_TOLERANCE)
    assert float(image.alpha.min()) >= 0.0 and float(image.alpha.max()) <= 1.0


@pytest.mark.parametrize("name", [*SCENES, *EXTREME_SCENES])
def test_float64_image_agrees_to_rounding(name: str) -> None:
    scene = (SCENES | EXTREME_SCENES)[name]()
    image = render_scene(scene, torch.float64)
    assert image.color.dtype == image.alpha.dtype == image.depth.dtype == torch.float64
    assert_image(image, scene, FLOAT64_TOLERANCE)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
@pytest.mark.parametrize("name", ["delaunay", "porous", "inside", "in-hole-cells"])
def test_unit_of_length_does_not_matter(name: str, scale: float) -> None:
    scene = scaled(SCENES[name](), scale)
    assert_image(render_scene(scene), scene, FLOAT32_TOLERANCE)


@pytest.mark.parametrize("distance", [30.0, 1000.0])
def test_far_camera(distance: float) -> None:
    """In float32 a vertex seen from afar is known to half a unit in the last place of its distance."""
    camera = random_camera(40, distance, (24, 24), fov_y=1.1 / distance)
    scene = make_scene(jittered_grid((4, 4, 4), 0.15, 40), camera, 40)
    spacing = float(torch.finfo(torch.float32).eps) * distance
    tolerance = FLOAT32_TOLERANCE + 4.0 * float(scene.density.max()) * spacing
    assert_image(render_scene(scene), scene, tolerance)
    assert_image(render_scene(scene, torch.float64), scene, 1e-8)


def test_mesh_far_from_the_origin() -> None:
    """World positions of 1000 with a camera at their side: float32 keeps 1e-4 of the scene's size at best."""
    scene = scaled(SCENES["jittered"](), 1.0, (1000.0, -700.0, 300.0))
    assert_image(render_scene(scene), scene, 5e-3)
    assert_image(render_scene(scene, torch.float64), scene, 1e-8)


# -------------------------------------------------------------------------------- cameras in the mesh and on its parts

GRID_POINTS = {
    "vertex": (0.0, 0.0, 0.0),
    "edge": (0.0, 0.0, 0.125),
    "cube-diagonal": (0.125, 0.125, 0.125),
    "face-diagonal": (0.0, 0.125, 0.125),
    "face": (0.0, 0.0625, 0.125),
    "cell": (0.0625, 0.03125, 0.125),
    "boundary-vertex": (0.5, 0.5, 0.5),
    "boundary-edge": (0.5, 0.5, 0.0625),
    "boundary-face": (0.5, 0.0625, 0.03125),
    "just-outside": (0.5000001, 0.0625, 0.03125),
    "just-inside": (0.4999999, 0.0625, 0.03125),
}


@pytest.mark.parametrize("place", GRID_POINTS)
@pytest.mark.parametrize("per_cell", [False, True])
def test_camera_on_a_part_of_the_mesh(place: str, per_cell: bool) -> None:
    """Orientation at random; the position is exact but for the rounding of the float32 extrinsics."""
    scene = make_scene(kuhn_grid((4, 4, 4)), camera_at(GRID_POINTS[place], 41, (24, 20), 2.2), 41, per_cell=per_cell)
    # From a surface, rounding by 3e-8 moves the entry of a ray that grazes the surface a thousand times as far.
    grazing = 10.0 if "boundary" in place else 1.0
    assert_image(render_scene(scene), scene, grazing * FLOAT32_TOLERANCE)
    assert_image(render_scene(scene, torch.float64), scene, 1e-8)


@pytest.mark.parametrize("place", GRID_POINTS)
@pytest.mark.parametrize("center", [(8.25, 6.125), (8.5, 6.5)])
def test_axis_aligned_camera_exactly_on_a_part_of_the_mesh(place: str, center: tuple[float, float]) -> None:
    """No rounding at all; with the second principal point many rays run inside faces and along edges, too."""
    camera = axis_camera(GRID_POINTS[place], 8.0, (17, 13), center)
    scene = make_scene(kuhn_grid((4, 4, 4)), camera, 42)
    # A ray in a boundary face may see the mesh or not: the tie rule moves it to one side, so all sides are asked.
    references = [scene.oracle((x, y)).color for x, y in itertools.product((1e-7, -1e-7), (1e-9, -1e-9))]
    for dtype, tolerance in ((torch.float32, FLOAT32_TOLERANCE), (torch.float64, 1e-6)):
        color = render_scene(scene, dtype).color.double()
        errors = torch.stack([(color - reference).abs().amax(-1) for reference in references])
        assert float(errors.amin(0).max()) < tolerance


@pytest.mark.parametrize("offset", [1e-7, 1e-6, 2e-6])
def test_rays_that_graze_a_face_beside_the_camera(offset: float) -> None:
    """A column of rays runs along a grid plane for a while before it crosses it: what lies before counts, too."""
    camera = axis_camera((offset, 0.03, 0.1), 8.0, (17, 13), (8.501, 6.3))
    scene = make_scene(kuhn_grid((4, 4, 4)), camera, 42, density=10.0)
    assert_image(render_scene(scene), scene, FLOAT32_TOLERANCE)
    assert_image(render_scene(scene, torch.float64), scene, 1e-8)


def test_camera_in_every_cell_of_a_mesh() -> None:
    """One view from near the centre of each of many cells, each a different start of the walk."""
    mesh = jittered_grid((3, 3, 3), 0.15, 43)
    for cell in range(0, len(mesh[1]), 9):
        eye = tuple(mesh[0][mesh[1][cell]].mean(axis=0))
        scene = make_scene(mesh, camera_at(eye, cell, (7, 5), 2.0), 43)
        assert_image(render_scene(scene), scene, FLOAT32_TOLERANCE)


def test_camera_in_one_of_two_meshes_that_touch_at_a_vertex() -> None:
    """Two cubes that share only the vertex on which the camera sits."""
    vertices, cells = kuhn_grid((2, 2, 2))
    kept = [0, 7]
    mesh = keep_cells(vertices, cells, torch.tensor([c // 6 in kept for c in range(len(cells))]).numpy())
    for seed in range(4):
        scene = make_scene(mesh, camera_at((0.0, 0.0, 0.0), seed, (24, 20), 2.4), 44)
        assert_image(render_scene(scene), scene, FLOAT32_TOLERANCE)


# --------------------------------------------------------------------------------------------------- what else counts


def test_constant_density_and_color_need_no_more_than_chords() -> None:
    scene = make_scene(jittered_grid((3, 4, 3), 0.0, 45), random_camera(45), 45)
    vertex = replace(scene, color=torch.full_like(scene.color, 0.7), density=torch.full_like(scene.density, 1.5))
    count = len(scene.tets)
    cell = replace(vertex, color=torch.full((count, 3), 0.7), density=torch.full((count,), 1.5), per_cell=True)
    a, b = render_scene(vertex), render_scene(cell)
    torch.testing.assert_close(a.color, b.color, rtol=0, atol=2e-6)
    torch.testing.assert_close(a.color, 0.7 * a.alpha[..., None].expand_as(a.color), rtol=0, atol=2e-6)


def test_background_shows_through() -> None:
    scene = SCENES["delaunay"]()
    leaves = leaves_of(scene, torch.float32)
    black = render_leaves(scene, leaves)
    leaves["background"] = torch.tensor([0.3, -1.5, 20.0])
    image = render_leaves(scene, leaves)
    expected = black.color + (1.0 - black.alpha)[..., None] * leaves["background"]
    torch.testing.assert_close(image.color, expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(image.alpha, black.alpha, rtol=0, atol=0)
    torch.testing.assert_close(image.depth, black.depth, rtol=0, atol=0)


def test_the_backgrounds_derivative_takes_an_image_in_any_layout() -> None:
    scene = SCENES["delaunay"]()
    leaves = leaves_of(scene, torch.float32)
    leaves["background"] = torch.tensor([0.3, 0.5, 0.7], requires_grad=True)
    image = render_leaves(scene, leaves)
    weights = torch.rand(3, *image.alpha.shape, generator=torch.Generator().manual_seed(0))
    (image.color.permute(2, 0, 1) * weights).sum().backward()  # as of losses that take channels first
    expected = ((1.0 - image.alpha) * weights).sum((1, 2))
    torch.testing.assert_close(leaves["background"].grad, expected, rtol=1e-5, atol=1e-5)


def test_expected_depth_of_a_thin_volume() -> None:
    """Expected depth does not depend on the scale of the densities while next to nothing is absorbed."""
    scene = SCENES["jittered"]()
    thin = replace(scene, density=scene.density * 1e-5)
    reference = thin.oracle()
    image = render_scene(thin)
    interior = reference.alpha > 0.2 * reference.alpha.max()
    assert total_error(image.depth[interior], reference.depth[interior]) < 0.01 * scene.size


def test_colors_outside_the_unit_interval_are_radiance_like_any_other() -> None:
    scene = SCENES["jittered"]()
    scene = replace(scene, color=scene.color * 10.0 - 4.0)
    assert_image(render_scene(scene), scene, 10 * FLOAT32_TOLERANCE)


@pytest.mark.parametrize("name", ["porous", "in-hole", "slabs", "delaunay-cells"])
@pytest.mark.usefixtures("kernel_threads")
def test_forward_is_deterministic(name: str) -> None:
    scene = SCENES[name]()
    first, second = render_scene(scene), render_scene(scene)
    for output in ("color", "alpha", "depth"):
        assert torch.equal(getattr(first, output), getattr(second, output))


def test_order_of_cells_and_vertices_does_not_matter() -> None:
    scene = SCENES["porous"]()
    generator = torch.Generator().manual_seed(0)
    cells = torch.randperm(len(scene.tets), generator=generator)
    to_old = torch.randperm(len(scene.vertices), generator=generator)
    to_new = torch.argsort(to_old).to(torch.int32)
    shuffled = replace(
        scene,
        vertices=scene.vertices[to_old],
        color=scene.color[to_old],
        density=scene.density[to_old],
        tets=to_new[scene.tets[cells][:, [1, 0, 3, 2]].long()],
    )
    a, b = render_scene(scene), render_scene(shuffled)
    assert total_error(a.color, b.color) < FLOAT32_TOLERANCE


def test_inputs_are_not_changed() -> None:
    scene = SCENES["in-hole"]()
    leaves = leaves_of(scene, torch.float32, ("vertices", "color", "density", "pose", "background"))
    copies = {name: leaf.detach().clone() for name, leaf in leaves.items()}
    image = render_leaves(scene, leaves)
    (image.color.sum() + image.depth.sum()).backward()
    for name, leaf in leaves.items():
        assert torch.equal(leaf.detach(), copies[name]), name


def test_images_outlive_later_renderings() -> None:
    """An image is not memory that the next rendering writes into."""
    scene = SCENES["jittered"]()
    first = render_scene(scene)
    copy = first.color.clone(), first.alpha.clone(), first.depth.clone()
    render_scene(replace(scene, color=1.0 - scene.color, density=scene.density * 2.0))
    assert all(torch.equal(a, b) for a, b in zip(copy, (first.color, first.alpha, first.depth), strict=True))


def test_strided_and_float64_fields_are_accepted() -> None:
    scene = SCENES["delaunay"]()
    mesh = TetMesh(scene.vertices, scene.tets)
    wide = torch.cat([scene.color, scene.density[:, None]], dim=1)
    expected = render(mesh, Field(scene.color, scene.density), scene.camera)
    strided = render(mesh, Field(wide[:, :3], wide[:, 3]), scene.camera)
    double = render(mesh, Field(scene.color.double(), scene.density.double()), scene.camera)
    assert torch.equal(strided.color, expected.color)
    assert torch.equal(double.color, expected.color) and double.color.dtype == torch.float32


def test_transmittance_threshold_stops_rays_that_see_nothing_more() -> None:
    scene = SCENES["dense-1e2"]()
    exact = render_scene(scene)
    off = render_scene(scene, transmittance_threshold=0.0)
    assert torch.equal(exact.color, off.color)
    for threshold in (1e-4, 1e-2, 0.2):
        image = render_scene(scene, transmittance_threshold=threshold)
        # What is cut off is at most the threshold's share of colours and of the background, all in [0, 1].
        assert total_error(image.color, exact.color) <= 1.01 * threshold + FLOAT32_TOLERANCE
        assert total_error(image.alpha, exact.alpha) <= 1.01 * threshold + FLOAT32_TOLERANCE
    assert total_error(image.color, exact.color) > 1e-3  # 0.2 must have stopped some ray


def test_threshold_bounds_the_error_in_meshes_with_holes() -> None:
    scene = SCENES["slabs"]()
    scene = replace(scene, density=scene.density * 5.0)
    exact, image = render_scene(scene), render_scene(scene, transmittance_threshold=0.05)
    assert 1e-4 < total_error(image.color, exact.color) <= 0.0505 + FLOAT32_TOLERANCE
