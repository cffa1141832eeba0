"""Gradients of ``render`` against the float64 reference and against finite differences."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from oracle.scenes import SCENES, Scene, camera_at, jittered_grid, kuhn_grid, make_scene, random_camera, relative_error
from oracle.scenes import scaled as scaled_scene
from rendering.helpers import (
    LEAVES,
    LossWeights,
    gradients,
    in_double,
    leaves_of,
    oracle_gradients,
    render_leaves,
    render_scene,
    resized,
)
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import OpticalModel, SubSegments
from difftetvr.rendering import render

FLOAT32_TOLERANCE = 1e-3
FLOAT64_TOLERANCE = 1e-8


def assert_gradients(scene: Scene, dtype: torch.dtype, tolerance: float) -> None:
    weights, expected = oracle_gradients(scene)
    actual = gradients(scene, dtype, weights)
    for name in LEAVES:
        assert actual[name].dtype == dtype
        assert relative_error(actual[name], expected[name]) < tolerance, name


@pytest.mark.parametrize("name", SCENES)
def test_float32_gradients(name: str) -> None:
    assert_gradients(SCENES[name](), torch.float32, FLOAT32_TOLERANCE)


@pytest.mark.parametrize(
    "name", ["delaunay", "porous", "inside", "in-hole", "dense-1e2", "porous-cells", "inside-cells", "in-hole-cells"]
)
def test_float64_gradients_agree_to_rounding(name: str) -> None:
    assert_gradients(SCENES[name](), torch.float64, FLOAT64_TOLERANCE)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
@pytest.mark.parametrize("name", ["porous", "inside", "in-hole-cells"])
def test_unit_of_length_does_not_matter(name: str, scale: float) -> None:
    assert_gradients(scaled_scene(SCENES[name](), scale), torch.float32, FLOAT32_TOLERANCE)


def test_colors_outside_the_unit_interval() -> None:
    scene = SCENES["jittered"]()
    assert_gradients(replace(scene, color=scene.color * 10.0 - 4.0), torch.float32, FLOAT32_TOLERANCE)


@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.125), (0.0, 0.0625, 0.125), (0.5, 0.0625, 0.03)])
@pytest.mark.parametrize("per_cell", [False, True])
def test_camera_exactly_on_a_vertex_edge_or_face(eye: tuple[float, float, float], per_cell: bool) -> None:
    """The image has a kink there as a function of positions, so those gradients only have to be finite."""
    scene = make_scene(kuhn_grid((4, 4, 4)), camera_at(eye, 52, (24, 20), 1.5), 52, per_cell=per_cell)
    weights, expected = oracle_gradients(scene)
    actual = gradients(scene, torch.float32, weights)
    for name in ("color", "density"):
        assert relative_error(actual[name], expected[name]) < FLOAT32_TOLERANCE, name
    for name in ("vertices", "pose"):
        assert bool(torch.isfinite(actual[name]).all()), name


def test_empty_space_knows_in_which_direction_density_helps() -> None:
    """At zero density colours and positions are without effect, but densities are not."""
    scene = SCENES["jittered"]()
    scene = replace(scene, density=torch.zeros_like(scene.density), background=torch.tensor([0.2, 0.6, 0.9]))
    weights, expected = oracle_gradients(scene)
    actual = gradients(scene, torch.float32, weights)
    assert relative_error(actual["density"], expected["density"]) < FLOAT32_TOLERANCE
    for name in ("vertices", "color", "pose"):
        assert float(actual[name].abs().max()) == 0.0, name


def test_opaque_front_hides_what_lies_behind() -> None:
    """A million per unit length: gradients stay finite and right."""
    scene = SCENES["dense-1e2"]()
    assert_gradients(replace(scene, density=scene.density * 100.0), torch.float32, 2e-3)


@pytest.mark.parametrize("outputs", [p for n in (1, 2) for p in itertools.combinations(("color", "alpha", "depth"), n)])
@pytest.mark.parametrize("name", ["porous", "inside-cells"])
def test_losses_that_see_some_of_the_outputs(name: str, outputs: tuple[str, ...]) -> None:
    """The adjoint may leave out what the loss does not use, and must not leave out more."""
    scene = SCENES[name]()
    everything = LossWeights.random(scene.oracle(), scene.size)
    zeros = {k: torch.zeros_like(getattr(everything, k)) for k in ("color", "alpha", "depth") if k not in outputs}
    weights = replace(everything, **zeros)
    expected = gradients(scene, torch.float64, weights)
    leaves = leaves_of(scene, torch.float32, LEAVES)
    image = render_leaves(scene, leaves)
    loss = torch.zeros(())
    for output in outputs:
        loss = loss + (getattr(weights, output).float() * getattr(image, output)).sum()
    actual = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    for leaf, gradient in zip(LEAVES, actual, strict=True):
        gradient = torch.zeros_like(expected[leaf]) if gradient is None else gradient
        assert relative_error(gradient, expected[leaf]) < FLOAT32_TOLERANCE, leaf


@pytest.mark.parametrize("wanted", [s for n in (1, 2) for s in itertools.combinations(LEAVES, n)])
def test_only_what_requires_gradients_gets_them(wanted: tuple[str, ...]) -> None:
    scene = SCENES["off-centre"]()
    weights = LossWeights.random(scene.oracle(), scene.size)
    everything = gradients(scene, torch.float32, weights)
    leaves = leaves_of(scene, torch.float32, wanted)
    weights(render_leaves(scene, leaves)).backward()
    for name, leaf in leaves.items():
        if name in wanted:
            assert leaf.grad is not None
            torch.testing.assert_close(leaf.grad, everything[name], rtol=1e-4, atol=1e-5)
        else:
            assert leaf.grad is None


# ------------------------------------------------------------------------------------------------- finite differences


def _tiny(kind: str, per_cell: bool) -> Scene:
    eye = {"outside": None, "inside": (0.05, 0.02, -0.04)}[kind]
    camera = random_camera(50, 1.1, (4, 3)) if eye is None else camera_at(eye, 50, (4, 3), 1.4)
    return make_scene(jittered_grid((2, 1, 1), 0.12, 50), camera, 50, per_cell=per_cell, background=True)


@pytest.mark.parametrize("per_cell", [False, True])
@pytest.mark.parametrize("kind", ["outside", "inside"])
def test_gradcheck_of_the_whole_render(kind: str, per_cell: bool) -> None:
    scene = _tiny(kind, per_cell)
    leaves = leaves_of(scene, torch.float64, LEAVES)
    mesh = TetMesh(leaves["vertices"].detach(), scene.tets)

    def outputs(*tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        image = render_leaves(scene, dict(zip(LEAVES, tensors, strict=True)), mesh)
        # Depth is a quotient that has no derivative where a ray misses.
        return image.color, image.alpha, torch.where(image.alpha > 0.02, image.depth, 0.0)

    assert torch.autograd.gradcheck(outputs, tuple(leaves.values()), eps=1e-7, atol=2e-6, rtol=1e-4, nondet_tol=1e-12)


@pytest.mark.parametrize("model", [SubSegments(3)])
def test_gradcheck_of_other_optical_models(model: OpticalModel) -> None:
    scene = _tiny("outside", per_cell=False)
    leaves = leaves_of(scene, torch.float64, LEAVES)
    mesh = TetMesh(leaves["vertices"].detach(), scene.tets)

    def outputs(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        image = render_leaves(scene, dict(zip(LEAVES, tensors, strict=True)), mesh, optics=model)
        return image.color, image.alpha

    assert torch.autograd.gradcheck(outputs, tuple(leaves.values()), eps=1e-7, atol=2e-6, rtol=1e-4, nondet_tol=1e-12)


def test_float32_directional_derivative_through_a_nonlinear_loss() -> None:
    """What an optimiser sees: the change of an l2 loss along its own gradient."""
    scene = SCENES["porous"]()
    target = torch.full_like(scene.oracle().color, 0.4)
    leaves = leaves_of(scene, torch.float32, ("color", "density"))
    loss = ((render_leaves(scene, leaves).color - target.float()) ** 2).mean()
    loss.backward()
    direction = {name: leaves[name].grad for name in ("color", "density")}
    step = 1e-3 / max(float(g.abs().max()) for g in direction.values() if g is not None)
    predicted, values = 0.0, []
    for sign in (1.0, -1.0):
        moved = dict(leaves_of(scene, torch.float64))
        for name, gradient in direction.items():
            assert gradient is not None
            moved[name] = moved[name] + sign * step * gradient.double()
            predicted += 0.5 * step * float((gradient.double() ** 2).sum())
        values.append(float(((render_leaves(scene, moved).color - target) ** 2).mean()))
    assert (values[0] - values[1]) / 2.0 == pytest.approx(predicted, rel=1e-3)


# ------------------------------------------------------------------------------------------------- autograd's manners


def test_no_graph_when_nothing_requires_gradients() -> None:
    image = render_scene(SCENES["delaunay"]())
    assert not (image.color.requires_grad or image.alpha.requires_grad or image.depth.requires_grad)
    leaves = leaves_of(SCENES["delaunay"](), torch.float32, LEAVES)
    with torch.no_grad():
        image = render_leaves(SCENES["delaunay"](), leaves)
    assert image.color.grad_fn is None


def test_second_derivatives_are_refused_with_a_clear_error() -> None:
    scene = SCENES["delaunay"]()
    leaves = leaves_of(scene, torch.float32, ("density",))
    loss = (render_leaves(scene, leaves).color ** 2).sum()
    (gradient,) = torch.autograd.grad(loss, leaves["density"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_a_retained_graph_gives_the_same_gradients_again() -> None:
    scene = SCENES["in-hole"]()
    leaves = leaves_of(scene, torch.float64, ("vertices", "density"))
    loss = render_leaves(scene, leaves).color.square().sum()
    inputs = [leaves["vertices"], leaves["density"]]
    first = torch.autograd.grad(loss, inputs, retain_graph=True)
    second = torch.autograd.grad(loss, inputs)
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


def test_changing_an_input_in_place_before_backward_is_noticed_or_harmless() -> None:
    """A forward that keeps views of its inputs must not give the gradients of other values."""
    scene = SCENES["delaunay"]()
    expected = gradients(scene, torch.float32, weights := LossWeights.random(scene.oracle(), scene.size))
    leaves = leaves_of(scene, torch.float32, ("vertices", "color", "density"))
    loss = weights(render_leaves(scene, leaves))
    with torch.no_grad():
        for name in ("color", "density"):
            leaves[name].mul_(3.0)
        leaves["vertices"].add_(0.1)
    try:
        loss.backward()
    except RuntimeError as error:
        assert "inplace" in str(error)
        return
    for name in ("vertices", "color", "density"):
        gradient = leaves[name].grad
        assert gradient is not None
        assert relative_error(gradient, expected[name]) < FLOAT32_TOLERANCE, name


def test_two_views_share_a_mesh() -> None:
    """The sum of two views' losses has the sum of their gradients."""
    scene = SCENES["porous"]()
    other = replace(scene, camera=SCENES["jittered"]().camera)
    weights = LossWeights.random(scene.oracle(), scene.size)
    separate = [gradients(s, torch.float64, weights) for s in (scene, other)]
    leaves = leaves_of(scene, torch.float64, ("vertices", "color", "density"))
    mesh, field = TetMesh(leaves["vertices"], scene.tets), Field(leaves["color"], leaves["density"])
    loss = sum((weights(render(mesh, field, in_double(s.camera))) for s in (scene, other)), torch.zeros(()))
    loss.backward()
    for name in ("vertices", "color", "density"):
        gradient = leaves[name].grad
        assert gradient is not None
        assert relative_error(gradient, separate[0][name] + separate[1][name]) < 1e-9, name


def test_gradients_pass_the_threshold_of_transmittance() -> None:
    """Rays that stop early leave out gradients of what they do not see, and little else."""
    scene = SCENES["dense-1e2"]()
    weights = LossWeights.random(scene.oracle(), scene.size)
    exact = gradients(scene, torch.float32, weights)
    leaves = leaves_of(scene, torch.float32, LEAVES)
    weights(render_leaves(scene, leaves, transmittance_threshold=1e-4)).backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        assert relative_error(leaf.grad, exact[name]) < 0.02, name


# ----------------------------------------------------------------------------------------------- pose by optimisation


def _rigid(twist: Tensor) -> Tensor:
    """(4, 4) rigid transform exp(twist) of a rotation vector (3) and a translation velocity (3)."""
    zero = torch.zeros((), dtype=twist.dtype)
    x, y, z, u, v, w = twist.unbind()
    rows = [[zero, -z, y, u], [z, zero, -x, v], [-y, x, zero, w], [zero, zero, zero, zero]]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows]))


def test_a_perturbed_pose_is_found_again_by_gradient_descent() -> None:
    scene = resized(make_scene(kuhn_grid((3, 3, 3)), random_camera(51, 1.6), 51), 32, 32)
    target = render_scene(scene).color
    mesh, field = TetMesh(scene.vertices, scene.tets), Field(scene.color, scene.density)
    start = torch.tensor([0.03, -0.04, 0.05, 0.04, -0.03, 0.02])
    twist = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([twist], lr=0.01)
    losses = []
    for _ in range(40):
        optimizer.zero_grad()
        camera = scene.camera.with_pose(_rigid(twist) @ scene.camera.world_to_camera)
        loss = (render(mesh, field, camera).color - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
    assert float(twist.detach().norm()) < 0.5 * float(start.norm())


@pytest.mark.parametrize("per_cell", [False, True])
def test_directional_colours(per_cell: bool) -> None:
    """Harmonics change the image with the direction, and gradients reach them, the positions and the pose."""
    scene = SCENES["delaunay-cells" if per_cell else "delaunay"]()
    mesh = TetMesh(scene.vertices.double(), scene.tets)
    generator = torch.Generator().manual_seed(4)
    harmonics = 0.1 * torch.randn(scene.color.shape[0], 8, 3, generator=generator, dtype=torch.float64)
    values = {"vertices": mesh.vertices, "color": scene.color.double() + 0.5, "harmonics": harmonics}
    values["pose"] = scene.camera.world_to_camera.double()
    values = {key: value.clone().requires_grad_() for key, value in values.items()}
    weights = torch.randn(scene.camera.height, scene.camera.width, 3, generator=generator, dtype=torch.float64)
    location = "cell" if per_cell else "vertex"

    def loss(v: dict[str, Tensor]) -> Tensor:
        field = Field(v["color"], scene.density.double(), location, v["harmonics"])
        return (
            weights * render(mesh.with_vertices(v["vertices"]), field, scene.camera.with_pose(v["pose"])).color
        ).sum()

    loss(values).backward()
    for key, value in values.items():
        step = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        if key == "pose":
            step[3] = 0.0
        ahead, behind = (loss(values | {key: value.detach() + sign * 1e-6 * step}) for sign in (1, -1))
        assert value.grad is not None
        analytic = float((value.grad * step).sum())
        assert abs(float(ahead.detach() - behind.detach()) / 2e-6 - analytic) < 1e-5 * abs(analytic) + 1e-7, key
