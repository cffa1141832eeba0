"""Scalars through transfer functions: exactness, gradients, errors."""

from __future__ import annotations

import pytest
import torch
from oracle.scenes import SCENES, Scene
from rendering.helpers import LEAVES, leaves_of

from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.rendering import Camera, RenderedImage, ScalarField, render

RENDERERS = ("marching", "linked-list", "projected")
CLIP = (0.3, -0.5, 0.8, 0.05)


def transfer_function(seed: int = 3, requires_grad: bool = False) -> TransferFunction:
    generator = torch.Generator().manual_seed(seed)
    knots = torch.tensor([0.05, 0.2, 0.22, 0.5, 0.6, 0.83, 0.97], dtype=torch.float64)
    opacity = torch.rand(7, generator=generator, dtype=torch.float64)
    color = torch.rand(7, 3, generator=generator, dtype=torch.float64)
    tensors = [tensor.requires_grad_(requires_grad) for tensor in (knots, opacity, color)]
    return TransferFunction(*tensors)


def scalars_of(mesh: TetMesh, seed: int = 0) -> torch.Tensor:
    return torch.rand(mesh.num_vertices, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def mesh_of(scene: Scene, dtype: torch.dtype = torch.float64) -> TetMesh:
    return TetMesh(scene.vertices.to(dtype), scene.tets)


def image_of(scene: Scene, field: Field | ScalarField, **options: object) -> RenderedImage:
    return render(mesh_of(scene), field, scene.camera, **options)  # type: ignore[arg-type]


def sliced(mesh: TetMesh, field: ScalarField, camera: Camera, pieces: int) -> torch.Tensor:
    """(H, W, 3) reference: the scalar is sampled at the middle of many short pieces of every crossing.

    Cells are intersected by clipping the ray against the planes of their faces.
    """
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    directions = torch.nn.functional.normalize(torch.stack((columns, rows, torch.ones_like(rows)), -1), dim=-1)
    points = camera.to_camera_space(mesh.vertices)[mesh.tets.long()]
    # Barycentric coordinates along a ray are linear in its distance: rate * t + offset.
    matrix = torch.linalg.inv(torch.cat((points, torch.ones(*points.shape[:2], 1, dtype=torch.float64)), 2))
    scalar = field.normalised()[mesh.tets.long()]
    image = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    for i in range(camera.height):
        for j in range(camera.width):
            rate, offset = directions[i, j] @ matrix[:, :3], matrix[:, 3]
            limit = -offset / rate
            near = torch.where(rate > 0, limit, -torch.inf).amax(1).clamp(min=0)
            far = torch.where(rate < 0, limit, torch.inf).amin(1)
            cells = torch.nonzero(far > near).flatten()
            cells = cells[near[cells].argsort()]
            step = (far - near)[cells, None] / pieces
            t = near[cells, None] + (torch.arange(pieces) + 0.5) * step
            s = (scalar[cells][:, None] * (rate[cells][:, None] * t[..., None] + offset[cells][:, None])).sum(-1)
            color, opacity = field.transfer_function(s)
            depth = field.attenuation * opacity * step
            before = depth.flatten().cumsum(0) - depth.flatten()
            weight = torch.exp(-before) * -torch.expm1(-depth.flatten())
            image[i, j] = (weight[:, None] * color.reshape(-1, 3)).sum(0)
    return image


def test_against_fine_sampling() -> None:
    scene = SCENES["delaunay"]()
    camera = scene.camera.with_size(8, 7)
    mesh = mesh_of(scene)
    field = ScalarField(scalars_of(mesh), transfer_function(), 5.0, (0.0, 1.0))
    reference = sliced(mesh, field, camera, 400)
    assert float(reference.max()) > 0.3
    for renderer in RENDERERS:
        image = render(mesh, field, camera, renderer=renderer)
        assert float((image.color - reference).abs().max()) < 2e-4, renderer


def test_linear_transfer_function_is_an_ordinary_field() -> None:
    scene = SCENES["delaunay"]()
    mesh = mesh_of(scene)
    linear = TransferFunction([0.0, 1.0], [0.2, 0.9], [[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]])
    field = ScalarField(scalars_of(mesh), linear, 4.0, (0.0, 1.0))
    assert torch.allclose(image_of(scene, field).color, image_of(scene, field.as_field()).color, atol=1e-13)


def test_knots_on_a_straight_line_change_nothing() -> None:
    scene = SCENES["delaunay"]()
    mesh = mesh_of(scene)
    places = torch.tensor([0.0, 0.3, 0.3, 0.71, 1.0], dtype=torch.float64)
    ends = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]], dtype=torch.float64)
    few = TransferFunction(places[[0, -1]], places[[0, -1]], ends)
    many = TransferFunction(places, places, torch.lerp(ends[0], ends[1], places[:, None]))
    images = [image_of(scene, ScalarField(scalars_of(mesh), f, 4.0, (0.0, 1.0))).color for f in (few, many)]
    assert torch.allclose(*images, atol=1e-13)


def test_a_jump_is_a_surface() -> None:
    """A step of the opacity at 1/2 shows exactly the half of the cube where the scalar is greater."""
    mesh = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    step = TransferFunction([0.0, 0.5, 0.5, 1.0], [0.0, 0.0, 1.0, 1.0], [[0.3, 0.6, 0.9]] * 4)
    camera = Camera.look_at((0.4, 0.6, 4.0), (0.5, 0.5, 0.5), (0.0, 1.0, 0.0), 0.05, 8, 8)
    image = render(mesh, ScalarField(mesh.vertices[:, 2], step, 3.0, (0.0, 1.0)), camera)
    # The rays are slanted by up to three degrees.
    assert torch.allclose(image.optical_depth / 3.0, torch.full_like(image.optical_depth, 0.5), rtol=3e-3)


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_region_whose_scalar_is_at_a_jump(dtype: torch.dtype, renderer: str) -> None:
    """Rounding must not carry the scalar across the jump: at it, the later knot counts."""
    scene = SCENES["delaunay"]()
    mesh = mesh_of(scene, dtype)
    opacity, color = torch.tensor([0.0, 0.0, 0.5, 0.5]), torch.tensor([0.0, 0.0, 1.0, 1.0])[:, None].expand(4, 3)
    function = TransferFunction(torch.tensor([0.0, 0.4, 0.4, 1.0], dtype=dtype), opacity, color)
    constant = torch.full((mesh.num_vertices,), 0.4, dtype=dtype)
    image = render(mesh, ScalarField(constant, function, 2.0, (0.0, 1.0)), scene.camera, renderer=renderer)
    field = Field(torch.ones(mesh.num_vertices, 3, dtype=dtype), torch.ones(mesh.num_vertices, dtype=dtype))
    assert torch.allclose(image.color, render(mesh, field, scene.camera).color, atol=1e-5)


def test_knots_that_change_before_the_backward_pass() -> None:
    """Gradients are those of the image that was seen."""
    scene = SCENES["delaunay"]()
    mesh = mesh_of(scene)
    function = transfer_function(requires_grad=True)
    loss = render(mesh, ScalarField(scalars_of(mesh), function, 2.0), scene.camera).color.sum()
    (before,) = torch.autograd.grad(loss, function.scalar, retain_graph=True)
    with torch.no_grad():
        function.scalar.add_(0.01)
    assert torch.equal(torch.autograd.grad(loss, function.scalar)[0], before)


@pytest.mark.parametrize("renderer", RENDERERS)
@pytest.mark.parametrize(
    ("name", "clip"),
    [
        ("delaunay", None),
        ("inside", CLIP),
        pytest.param("delaunay", CLIP, marks=pytest.mark.slow),  # kernels of their own, which take long to compile
        pytest.param("inside", None, marks=pytest.mark.slow),
    ],
)
def test_gradients(name: str, renderer: str, clip: tuple[float, ...] | None) -> None:
    """By vertices, pose, scalars, and the knots' places, opacities and colours, against finite differences."""
    scene = SCENES[name]()
    mesh, function = mesh_of(scene), transfer_function()
    start = leaves_of(scene, torch.float64, LEAVES)
    values = {"vertices": start["vertices"], "pose": start["pose"], "scalar": scalars_of(mesh)}
    values |= {"knots": function.scalar, "opacity": function.opacity, "color": function.color}
    values = {key: value.detach().clone().requires_grad_() for key, value in values.items()}
    generator = torch.Generator().manual_seed(11)
    weights = torch.randn(scene.camera.height, scene.camera.width, 5, generator=generator, dtype=torch.float64)

    def loss(v: dict[str, torch.Tensor]) -> torch.Tensor:
        field = ScalarField(v["scalar"], TransferFunction(v["knots"], v["opacity"], v["color"]), 5.0, (0.0, 1.0))
        camera = scene.camera.with_pose(v["pose"])
        image = render(mesh.with_vertices(v["vertices"]), field, camera, renderer=renderer, clip_plane=clip)
        outputs = torch.cat((image.color, image.optical_depth[..., None], (image.depth * image.alpha)[..., None]), 2)
        return (weights * outputs).sum()

    loss(values).backward()
    for key, value in values.items():
        step = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        if key == "pose":
            step[3] = 0.0
        ahead, behind = (loss(values | {key: value.detach() + sign * 1e-7 * step}) for sign in (1, -1))
        assert value.grad is not None
        analytic = float((value.grad * step).sum())
        assert abs(float(ahead.detach() - behind.detach()) / 2e-7 - analytic) < 2e-6 * abs(analytic) + 1e-6, key


def test_float32_agrees() -> None:
    scene = SCENES["porous"]()
    mesh = mesh_of(scene, torch.float32)
    scalar = scalars_of(mesh)
    single = render(mesh, ScalarField(scalar.float(), transfer_function(), 5.0, (0.0, 1.0)), scene.camera)
    double = image_of(scene, ScalarField(scalar.float().double(), transfer_function(), 5.0, (0.0, 1.0)))
    assert single.color.dtype == torch.float32
    assert float((single.color - double.color).abs().max()) < 2e-5


def test_scalars_per_cell_are_a_field_per_cell() -> None:
    scene = SCENES["delaunay"]()
    mesh = mesh_of(scene)
    scalar = torch.rand(mesh.num_cells, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    field = ScalarField(scalar, transfer_function(), 5.0)
    color, opacity = field.transfer_function(field.normalised())
    assert torch.equal(image_of(scene, field).color, image_of(scene, Field(color, 5.0 * opacity, "cell")).color)


def test_unit_of_length_does_not_matter() -> None:
    scene = SCENES["delaunay"]()
    mesh, function = mesh_of(scene), transfer_function()
    image = image_of(scene, ScalarField(scalars_of(mesh), function, 5.0))
    scale = 2.0**40
    pose = scene.camera.world_to_camera.double().clone()
    pose[:3, 3] *= scale
    large = mesh.with_vertices(mesh.vertices * scale)
    scaled = render(large, ScalarField(scalars_of(mesh), function, 5.0 / scale), scene.camera.with_pose(pose))
    assert torch.allclose(scaled.color, image.color, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scalar": torch.zeros(3, 2)}, "shape"),
        ({"scalar": torch.tensor([0.0, float("nan")])}, "Scalar 1 is not finite"),
        ({"scalar": torch.zeros(4), "attenuation": -1.0}, "attenuation"),
        ({"scalar": torch.zeros(4), "value_range": (1.0, 1.0)}, "range"),
        ({"scalar": torch.zeros(4), "value_range": 5}, "range"),
        ({"scalar": torch.zeros(4), "location": "edge"}, "location"),
    ],
)
def test_bad_scalars(options: dict[str, object], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        ScalarField(transfer_function=transfer_function(), **options)  # type: ignore[arg-type]


def test_wrong_number_of_scalars() -> None:
    scene = SCENES["grid"]()
    with pytest.raises(MeshError, match="There are 3 scalars"):
        image_of(scene, ScalarField(torch.zeros(3), transfer_function()))


@pytest.mark.parametrize(
    ("dtype", "size"),
    [(torch.float32, 3.3e38), (torch.float32, 1e300), (torch.float64, 1.7e308), (torch.float32, 1e-50)],
)
def test_ranges_that_no_number_spans(dtype: torch.dtype, size: float) -> None:
    expected = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)
    scalar = ((2.0 * expected - 1.0) * min(size, torch.finfo(dtype).max)).to(dtype)
    found = ScalarField(scalar, transfer_function(), value_range=(-size, size)).normalised()
    if 1e-40 < size < 1e39 or dtype == torch.float64:
        assert torch.allclose(found.double(), expected)
        assert torch.equal(ScalarField(scalar, transfer_function()).normalised(), found)
    elif size > 1.0:
        assert torch.allclose(found, torch.tensor(0.5))
    assert found.isfinite().all()
    assert ScalarField(scalar, transfer_function(), value_range=(0.0, 1e-30)).normalised().isfinite().all()
