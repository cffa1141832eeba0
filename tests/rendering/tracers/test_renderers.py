"""The three renderers against the float64 reference and against each other."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import pytest
import torch
from oracle.oracle import render_oracle
from oracle.scenes import SCENES, Scene, camera_at, kuhn_grid, make_scene, random_camera, relative_error, total_error
from rendering.helpers import LEAVES, leaves_of, oracle_gradients, render_leaves, render_scene, resized

from difftetvr.backend import backend_for
from difftetvr.errors import DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, OrderWarning, render
from difftetvr.rendering.inspection import inspect_rays
from difftetvr.rendering.search.plan import Counts
from difftetvr.rendering.search.scene import Scene as CellScene
from difftetvr.rendering.tracers import linked_list, projected
from difftetvr.rendering.tracers.bands import bands_of
from difftetvr.rendering.tracers.fragments import Fragments
from difftetvr.rendering.tracers.tiles import tiles_of

RENDERERS = ("marching", "linked-list", "projected")
CONVEX = ("delaunay", "grid", "inside", "single", "delaunay-cells", "grid-cells")
NOT_CONVEX = ("porous", "in-hole", "components", "porous-cells", "in-hole-cells", "components-cells")


@pytest.fixture(autouse=True)
def _exact_orders_only() -> Iterator[None]:
    """A test that renders in an uncertain order has to expect the warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", OrderWarning)
        yield


@pytest.fixture
def one_list_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets all scenes share kernels, which otherwise depend on their longest lists and take long to compile."""
    monkeypatch.setattr(linked_list, "LOCAL_SIZES", (64,))


def assert_agrees(scene: Scene, dtype: torch.dtype, image_tolerance: float, tolerance: float, **options: str) -> None:
    """The image within a tolerance of the reference, and gradients within another, relative one."""
    weights, expected = oracle_gradients(scene)
    leaves = leaves_of(scene, dtype, LEAVES)
    image = render_leaves(scene, leaves, **options)
    assert total_error(image.color.detach(), scene.oracle().color) < image_tolerance
    weights(image).backward()
    for name in LEAVES:
        gradient = leaves[name].grad
        assert gradient is not None
        assert relative_error(gradient, expected[name]) < tolerance, name


@pytest.mark.parametrize("renderer", RENDERERS[1:])
@pytest.mark.parametrize("name", CONVEX)
@pytest.mark.usefixtures("one_list_size")
def test_convex_meshes(name: str, renderer: str) -> None:
    scene = SCENES[name]()
    assert_agrees(scene, torch.float32, 2e-5, 1e-3, renderer=renderer)
    assert_agrees(scene, torch.float64, 1e-10, 1e-8, renderer=renderer)


def assert_lists_agree(name: str) -> None:
    scene = SCENES[name]()
    assert_agrees(scene, torch.float32, 2e-5, 1e-3, renderer="linked-list")
    assert_agrees(scene, torch.float64, 1e-10, 1e-8, renderer="linked-list")


@pytest.mark.parametrize("name", NOT_CONVEX)
@pytest.mark.usefixtures("one_list_size")
def test_linked_lists_of_any_mesh(name: str) -> None:
    assert_lists_agree(name)


@pytest.mark.parametrize("name", ["single", "slabs", "speck", "wide-fov", "beside"])
def test_lists_of_any_length(name: str) -> None:
    assert_lists_agree(name)


@pytest.mark.parametrize("name", [pytest.param("delaunay", marks=pytest.mark.slow), "porous", "inside-cells"])
def test_lists_longer_than_local_memory_in_many_bands(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays take their nearest fragments in batches, and the image is made in parts: nothing is dropped."""
    monkeypatch.setattr(linked_list, "LOCAL_SIZES", (4,))
    monkeypatch.setattr(linked_list, "FRAGMENT_BUDGET", 200)
    assert_agrees(SCENES[name](), torch.float64, 1e-10, 1e-8, renderer="linked-list")


def test_many_bands_are_not_replayed_but_waited_for_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Launched from a recording, kernels of all bands are queued at once, with the lists of all of them."""
    scene, made, of = SCENES["inside"](), [], linked_list.FragmentLists.of
    monkeypatch.setattr(linked_list, "FRAGMENT_BUDGET", 200)
    monkeypatch.setattr(linked_list.FragmentLists, "of", lambda *given: made.append(0) or of(*given))
    counts = []
    for _ in range(2):
        made.clear()
        render_scene(scene, torch.float32, renderer="linked-list")
        counts.append(len(made))
    assert counts[0] > 1 and counts[1] == counts[0]


def test_more_fragments_than_32_bits_count_are_held_in_bands() -> None:
    backend = backend_for(torch.zeros(1))
    counts = Counts.of(dr.full(backend.UInt, 1 << 30, 4), None)
    assert int(counts.total[0]) == 0
    found = Fragments(None, counts.count, 1 << 30, 0, False)
    view = SimpleNamespace(backend=backend, rays=SimpleNamespace(lane_count=4))
    tracer = linked_list.LinkedList.of(SimpleNamespace(view=view, found=found))
    bands = list(tracer.bands.each(backend))
    assert [band.size for band in bands] == [1 << 30] * 4
    assert [band.lane.numpy().tolist() for band in bands] == [[0], [1], [2], [3]]


def test_bands_hold_all_lanes_within_the_budget() -> None:
    counts = torch.tensor([3, 0, 5, 9, 0, 0, 1, 1, 2])
    bands = bands_of(counts, 6)
    assert [(band.first, band.last) for band in bands] == [(0, 2), (2, 3), (3, 4), (4, 9)]
    assert [band.total for band in bands] == [3, 5, 9, 4]


@pytest.mark.parametrize("name", ["delaunay", "inside"])
def test_projected_cells_in_many_parts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(projected, "PAIR_BUDGET", 100)
    assert_agrees(SCENES[name](), torch.float64, 1e-10, 1e-8, renderer="projected")


@pytest.mark.parametrize("name", ["porous", "porous-cells"])
def test_projected_warns_where_no_order_is_certain(name: str) -> None:
    scene = SCENES[name]()
    with pytest.warns(OrderWarning, match="marching"):
        image = render_scene(scene, torch.float64, renderer="projected")
    # Transmittance does not depend on the order.
    assert total_error(image.alpha, scene.oracle().alpha) < 1e-10


@pytest.mark.parametrize("renderer", RENDERERS)
def test_rays_along_edges_and_through_vertices(renderer: str) -> None:
    """A camera on a grid's axis sees its edges as points and its faces as lines."""
    scene = make_scene(kuhn_grid((4, 4, 4)), camera_at((0.0, 0.0, 2.0), 3, (33, 33), 0.5), 3)
    marched = render_scene(scene, torch.float64)
    image = render_scene(scene, torch.float64, renderer=renderer)
    assert float((image.color - marched.color).abs().max()) < 1e-12
    assert float((image.alpha - marched.alpha).abs().max()) < 1e-12


@pytest.mark.parametrize("renderer", RENDERERS[1:])
def test_stopping_early(renderer: str) -> None:
    scene = replace(SCENES["delaunay"](), density=SCENES["delaunay"]().density * 50)
    full = render_scene(scene, torch.float64, renderer=renderer)
    stopped = render_scene(scene, torch.float64, renderer=renderer, transmittance_threshold=1e-3)
    error = float((full.color - stopped.color).abs().max())
    assert 0.0 < error < 2e-3 * float(scene.color.max())


@pytest.mark.parametrize("renderer", RENDERERS[1:])
@pytest.mark.usefixtures("kernel_threads")
def test_deterministic_gradients_repeat_to_the_bit(renderer: str) -> None:
    def gradient() -> torch.Tensor:
        leaves = leaves_of(scene, torch.float32, LEAVES)
        image = render_leaves(scene, leaves, renderer=renderer, deterministic=True)
        image.color.square().sum().backward()
        assert leaves["vertices"].grad is not None
        return leaves["vertices"].grad

    scene = resized(SCENES["delaunay"](), 96, 80)
    assert torch.equal(gradient(), gradient())


@pytest.mark.parametrize("renderer", ["projected", "linked-list"])
def test_loose_cells(renderer: str) -> None:
    """Cells that share no vertices render like the mesh they make up, which adjacency could not tell."""
    scene = SCENES["delaunay"]()
    vertices, tets = scene.vertices[scene.tets.long()].reshape(-1, 3), torch.arange(scene.tets.numel()).reshape(-1, 4)
    loose = TetMesh(vertices, tets, conforming=False)
    field = Field(scene.color[scene.tets.long()].reshape(-1, 3), scene.density[scene.tets.long()].reshape(-1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OrderWarning)
        image = render(loose, field, scene.camera, scene.background, renderer=renderer)
    reference = scene.oracle()
    assert total_error(image.alpha, reference.alpha) < 2e-5
    if renderer == "linked-list":
        assert total_error(image.color, reference.color) < 2e-5
    with pytest.raises(MeshError, match=r"linked-list.*projected"):
        render(loose, field, scene.camera)


def test_unknown_renderer() -> None:
    with pytest.raises(DiffTetError, match="marching, linked-list, projected"):
        render_scene(SCENES["grid"](), renderer="rasterised")


@pytest.mark.parametrize("name", ["delaunay", "inside", "grid"])
def test_all_renderers_meet_the_same_cells(name: str) -> None:
    scene = SCENES[name]()
    mesh = TetMesh(scene.vertices, scene.tets)
    marched, *others = (inspect_rays(mesh, scene.camera, renderer) for renderer in RENDERERS)
    assert int(marched.depth_complexity.max()) > 5
    for other in others:
        assert torch.equal(other.depth_complexity, marched.depth_complexity)
        assert torch.equal(other.worst_quality.nan_to_num(2.0), marched.worst_quality.nan_to_num(2.0))
    seen = marched.depth_complexity > 0
    assert torch.equal(seen, ~marched.worst_quality.isnan())
    assert float(marched.worst_quality[seen].min()) >= float(mesh.quality().min())


def test_depth_complexity_of_a_single_cell() -> None:
    mesh = TetMesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [[0, 1, 2, 3]])
    camera = Camera.look_at((0.2, 0.2, 3.0), (0.2, 0.2, 0.0), (0.0, 1.0, 0.0), 0.8, 32, 32)
    statistics = inspect_rays(mesh, camera)
    assert set(statistics.depth_complexity.unique().tolist()) == {0, 1}
    assert torch.allclose(statistics.worst_quality[statistics.depth_complexity == 1], mesh.quality())


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("eye", "forward"),
    [
        ((0.0, -1.0, 0.1), (0.0, 1.0, 0.0)),  # on a boundary edge, looking in
        ((0.0, -1.0, 0.1), (0.13, 0.0, -1.0)),  # ... and along the boundary
        ((0.5, 0.0, 0.1), (1.0, 0.0, 0.0)),  # on an edge inside, its faces in the camera's plane
    ],
)
def test_camera_on_an_edge(
    eye: tuple[float, float, float], forward: tuple[float, float, float], dtype: torch.dtype, renderer: str
) -> None:
    """Rounding says on which side of the camera's plane the faces around it lie; no ray may be lost or seen twice."""
    mesh = TetMesh.grid((4, 4, 4), (-1, -1, -1), (1, 1, 1))
    mesh = mesh.with_vertices(mesh.vertices.to(dtype))
    field = Field(mesh.vertices.abs(), 1.0 + mesh.vertices[:, 0] * mesh.vertices[:, 2])
    up = (0.0, 0.0, 1.0) if forward[2] == 0 else (0.0, 1.0, 0.0)
    target = tuple(a + b for a, b in zip(eye, forward, strict=True))
    camera = Camera.look_at(eye, target, up, 1.2, 32, 32)
    image = render(mesh, field, camera, renderer=renderer)
    values = (part.double() for part in (mesh.vertices, field.color, field.density))
    vertices, color, density = values
    reference = render_oracle(vertices, mesh.tets, color, density, camera, torch.zeros(3, dtype=torch.float64), False)
    assert float((image.alpha.double() - reference.alpha).abs().max()) < 1e-5
    assert float((image.color.double() - reference.color).abs().max()) < 1e-5


def test_faces_beside_the_camera_are_not_sought_in_the_whole_image() -> None:
    """Where a camera is inside, many faces reach behind it; few of them can be seen."""
    mesh = TetMesh.grid((8, 8, 8), (-1, -1, -1), (1, 1, 1))
    camera = Camera.look_at((0.05, 0.03, 0.01), (0.5, 1.0, 0.2), (0.0, 0.0, 1.0), 1.2, 64, 64)
    backend = backend_for(mesh.vertices)
    records = torch.nn.functional.pad(camera.to_camera_space(mesh.vertices), (0, 1))
    scene = CellScene(backend, backend.floats(records), backend.uints(mesh.tets), 1, camera.kernel_rays(backend))
    cells = mesh.vertices[mesh.tets.long()]
    depth = camera.to_camera_space(cells.reshape(-1, 3)).reshape(-1, 4, 3)[..., 2]
    crossing = (depth.amin(1) < 0) & (depth.amax(1) > 0)
    pairs = backend.tensor(tiles_of(scene, backend.lanes(mesh.num_cells)).pairs)
    assert int(pairs[crossing].sum()) < 0.2 * int(crossing.sum()) * 64


# ------------------------------------------------------------------------------------------------------ clip planes

PLANE = (0.6, -1.0, 1.6, 0.1)


@pytest.mark.parametrize("renderer", RENDERERS)
def test_clipping_a_box_equals_a_smaller_box(renderer: str) -> None:
    """With constant colour and density, what is left of the plane x >= 0 is half of the box."""
    whole, half = TetMesh.grid((4, 4, 4), (-1, -1, -1), (1, 1, 1)), TetMesh.grid((2, 4, 4), (0, -1, -1), (1, 1, 1))
    camera = Camera.look_at((2.0, 1.5, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.9, 40, 32)

    def constant(mesh: TetMesh) -> Field:
        return Field(torch.tensor([0.2, 0.5, 0.9]).expand(mesh.num_vertices, 3), torch.full((mesh.num_vertices,), 0.8))

    clipped = render(whole, constant(whole), camera, renderer=renderer, clip_plane=(1.0, 0.0, 0.0, 0.0))
    expected = render(half, constant(half), camera)
    for name in ("color", "alpha", "depth"):
        assert torch.allclose(getattr(clipped, name), getattr(expected, name), atol=3e-6), name


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("name", ["delaunay", "inside", "inside-cells"])
def test_gradients_of_a_clipped_image(name: str, renderer: str) -> None:
    """Against finite differences in a random direction of each tensor, the plane and the pose among them."""
    scene = SCENES[name]()
    leaves = leaves_of(scene, torch.float64, LEAVES) | {"plane": torch.tensor(PLANE, dtype=torch.float64)}
    leaves["plane"].requires_grad_()
    generator = torch.Generator().manual_seed(5)
    weights = torch.randn(scene.camera.height, scene.camera.width, 4, generator=generator, dtype=torch.float64)

    def loss(values: dict[str, torch.Tensor]) -> torch.Tensor:
        image = render_leaves(scene, values, renderer=renderer, clip_plane=values["plane"])
        return (weights[..., :3] * image.color).sum() + (weights[..., 3] * image.depth * image.alpha).sum()

    loss(leaves).backward()
    for key, leaf in leaves.items():
        step = torch.randn(leaf.shape, generator=generator, dtype=torch.float64)
        if key == "pose":
            step[3] = 0.0
        ahead, behind = (loss(leaves | {key: leaf.detach() + sign * 1e-6 * step}) for sign in (1, -1))
        assert leaf.grad is not None
        analytic = float((leaf.grad * step).sum())
        assert abs(float(ahead.detach() - behind.detach()) / 2e-6 - analytic) < 2e-6 * abs(analytic) + 1e-7, key


def test_inspection_of_what_a_plane_leaves() -> None:
    """Half of a grid is half as deep, whichever renderer looks."""
    mesh = TetMesh.grid((2, 2, 8), (-1, -1, -1), (1, 1, 1))
    camera = Camera.look_at((0.3, 0.2, 4.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.3, 16, 16)
    whole = inspect_rays(mesh, camera).depth_complexity
    marched, *others = (inspect_rays(mesh, camera, name, (0.0, 0.0, 1.0, 0.1)) for name in RENDERERS)
    for other in others:
        assert torch.equal(other.depth_complexity, marched.depth_complexity)
    assert 0.4 < float(marched.depth_complexity.sum()) / float(whole.sum()) < 0.7


def test_clipping_everything_leaves_the_background() -> None:
    scene = SCENES["delaunay"]()
    image = render_scene(scene, clip_plane=(1.0, 0.0, 0.0, -10.0))
    assert float(image.alpha.max()) == 0.0


@pytest.mark.parametrize("factor", [1e-300, 1e-50, 3.0, 1e40, 1e300])
@pytest.mark.parametrize("as_rays", [False, True])
def test_planes_in_any_unit(factor: float, as_rays: bool) -> None:
    """Four numbers and their multiples are one plane, whatever float32 holds of them."""
    scene = SCENES["delaunay"]()
    mesh, field = TetMesh(scene.vertices, scene.tets), Field(scene.color, scene.density)
    camera = scene.camera.rays() if as_rays else scene.camera
    expected, found = (
        render(mesh, field, camera, clip_plane=[part * unit for part in PLANE]) for unit in (1.0, factor)
    )
    assert torch.allclose(found.color, expected.color, atol=2e-6) and bool(expected.color.any())
    assert not bool(render(mesh, field, camera, clip_plane=(0.0, 0.0, factor, -1e308)).alpha.any())


@pytest.mark.parametrize("plane", [(0, 0, 0, 1), (1, 2, 3), (float("nan"), 0, 1, 0), "up"])
def test_bad_planes(plane: object) -> None:
    with pytest.raises(DiffTetError, match="clip_plane"):
        render_scene(SCENES["grid"](), clip_plane=plane)


@pytest.mark.parametrize("seed", range(6))
def test_random_cameras_agree(seed: int) -> None:
    scene = SCENES["delaunay"]()
    scene = replace(scene, camera=random_camera(seed, 0.4 + 0.3 * seed, (40, 30)))
    images = [render_scene(scene, torch.float64, renderer=name) for name in RENDERERS]
    for image in images[1:]:
        assert float((image.color - images[0].color).abs().max()) < 1e-12
