"""The quadratic models by hat functions, against autograd, finite differences and real refinements."""

import math

import pytest
import torch
from scipy.optimize import minimize

import difftetvr as dtv
from difftetvr.errors import DiffTetError, MeshError
from difftetvr.fitting.refinement.gains import face_steps, flip_gains
from difftetvr.mesh import Field, TetMesh, bisect_edges
from difftetvr.mesh.changes.flip_search import find_flips
from difftetvr.mesh.changes.flips import TWO_TO_THREE, apply_flips
from difftetvr.rendering import Camera, LensCamera, render
from difftetvr.rendering.gauss_newton import HatChoice, HatDerivatives, model_image, model_line_integrals

BACKGROUND = (0.3, 0.6, 0.1)
OUTSIDE = {"eye": (0.4, -1.5, 0.9), "target": (0.5, 0.5, 0.5)}
INSIDE = {"eye": (0.41, 0.33, 0.57), "target": (0.9, 0.8, 0.4)}


def camera_at(where, size=48, scale=1.0):
    eye, target = ([scale * x for x in where[name]] for name in ("eye", "target"))
    return Camera.look_at(eye=eye, target=target, up=(0, 0, 1), width=size, height=size)


def random_scene(dtype=torch.float64, density=4.0, seed=0, scale=1.0):
    """A jittered grid with random colours and densities, and a random image to compare with."""
    generator = torch.Generator().manual_seed(seed)
    mesh = TetMesh.grid((3, 3, 3), dtype=torch.float64)
    jitter = 0.06 * (torch.rand(mesh.vertices.shape, generator=generator, dtype=torch.float64) - 0.5)
    mesh = mesh.with_vertices((scale * (mesh.vertices + jitter)).to(dtype))
    mesh.validate()
    color = torch.rand(mesh.num_vertices, 3, generator=generator, dtype=torch.float64).to(dtype)
    values = torch.rand(mesh.num_vertices, generator=generator, dtype=torch.float64)
    truth = torch.rand(48, 48, 3, generator=generator, dtype=torch.float64).to(dtype)
    return mesh, Field(color, (density / scale * values).to(dtype)), truth


def matrix_of(hats, row):
    """The (4, 4) Gauss-Newton matrix of one hat."""
    matrix = torch.zeros(4, 4, dtype=hats.gradient.dtype)
    matrix[:3, :3] = torch.eye(3, dtype=matrix.dtype) * hats.emission[row]
    matrix[:3, 3] = matrix[3, :3] = hats.coupling[row]
    matrix[3, 3] = hats.absorption[row]
    return matrix


def derivatives(mesh, field, rows, camera, truth):
    """Gradient and Gauss-Newton matrix of the squared error, by four values that some vertices are raised by."""

    def image_of(step):
        return render(mesh, with_values(field, rows, step), camera, BACKGROUND).color

    step = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    error = (image_of(step) - truth).square().mean()
    (gradient,) = torch.autograd.grad(error, step)
    h = 1e-4
    with torch.no_grad():
        moves = h * torch.eye(4, dtype=torch.float64)
        columns = [(image_of(move) - image_of(-move)).flatten() / (2 * h) for move in moves]
    jacobian = torch.stack(columns, 1)
    return gradient, 2.0 / len(jacobian) * jacobian.T @ jacobian


def with_values(field, rows, step):
    """A field whose vertices `rows` have been raised by four values."""
    chosen = torch.zeros(len(field), 1, dtype=step.dtype)
    chosen[rows] = 1.0
    return Field(field.color + chosen * step[:3], field.density + chosen[:, 0] * step[3])


def assert_matches(hats, row, gradient, matrix, tolerance):
    assert (hats.gradient[row] - gradient).norm() <= tolerance * gradient.norm()
    assert (matrix_of(hats, row) - matrix).norm() <= tolerance * matrix.norm()


@pytest.mark.parametrize("where", [OUTSIDE, INSIDE])
@pytest.mark.parametrize(("density", "tolerance"), [(0.01, 2e-3), (4.0, 0.03), (20.0, 0.15)])
def test_gradients_of_vertices_are_those_of_autograd(where, density, tolerance):
    mesh, field, truth = random_scene(density=density)
    leaves = [field.color.requires_grad_(), field.density.requires_grad_()]
    image = render(mesh, field, camera_at(where), BACKGROUND).color
    color, absorption = torch.autograd.grad((image - truth).square().mean(), leaves)
    model = model_image(mesh, field, camera_at(where), truth, BACKGROUND, transmittance_threshold=0.0)
    assert model.error == pytest.approx(float((image.detach() - truth).square().mean()), rel=1e-12)
    assert (model.vertices.gradient[:, :3] - color).norm() <= tolerance * color.norm()
    assert (model.vertices.gradient[:, 3] - absorption).norm() <= tolerance * absorption.norm()


@pytest.mark.parametrize("where", [OUTSIDE, INSIDE])
def test_models_of_a_lens(where):
    """Without distortion they are those of the pinhole, also from inside; with it their gradient is autograd's."""
    mesh, field, truth = random_scene()
    pinhole = camera_at(where)
    numbers = (pinhole.world_to_camera, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, pinhole.width, pinhole.height)
    options = {"background": BACKGROUND, "transmittance_threshold": 0.0}
    expected = model_image(mesh, field, pinhole, truth, **options)
    flat = model_image(mesh, field, LensCamera(*numbers), truth, **options)
    assert flat.error == pytest.approx(expected.error, rel=1e-6)
    for name in ("vertices", "edges", "faces"):
        one, other = (getattr(model, name).gradient for model in (flat, expected))
        assert (one - other).norm() <= 1e-4 * other.norm()
    lens = LensCamera(*numbers, coefficients=[-0.6, 0.3])
    leaves = [field.color.requires_grad_(), field.density.requires_grad_()]
    color, absorption = torch.autograd.grad(
        (render(mesh, field, lens, BACKGROUND).color - truth).square().mean(), leaves
    )
    bent = model_image(mesh, field, lens, truth, **options)
    assert (bent.vertices.gradient[:, :3] - color).norm() <= 0.03 * color.norm()
    assert (bent.vertices.gradient[:, 3] - absorption).norm() <= 0.03 * absorption.norm()
    assert (expected.vertices.gradient[:, :3] - color).norm() > 0.06 * color.norm()


@pytest.mark.parametrize("where", [OUTSIDE, INSIDE])
def test_matrices_of_vertices_hold_whole_rays(where):
    """Squares of a ray's whole response, over all cells around the vertex, not the sum of the cells' squares."""
    mesh, field, truth = random_scene()
    model = model_image(mesh, field, camera_at(where), truth, BACKGROUND, transmittance_threshold=0.0)
    for vertex in (0, 21, 42, 58):
        gradient, matrix = derivatives(mesh, field, vertex, camera_at(where), truth)
        assert_matches(model.vertices, vertex, gradient, matrix, 0.05)


@pytest.mark.parametrize("where", [OUTSIDE, INSIDE])
def test_edges_predict_a_real_bisection(where):
    mesh, field, truth = random_scene()
    model = model_image(mesh, field, camera_at(where), truth, BACKGROUND, transmittance_threshold=0.0)
    seen = torch.nonzero(model.edges.weight > 0.01 * model.edges.weight.max()).flatten()
    assert len(seen) > 50
    for edge in seen[:: len(seen) // 8].tolist():
        change = bisect_edges(mesh, torch.tensor([edge]))
        finer = Field(change.carry(field.color), change.carry(field.density))
        gradient, matrix = derivatives(change.mesh, finer, change.is_new, camera_at(where), truth)
        assert_matches(model.edges, edge, gradient, matrix, 0.12)


def test_faces_predict_a_real_vertex_in_their_centre():
    mesh, field, truth = random_scene()
    topology = mesh.topology
    model = model_image(mesh, field, camera_at(OUTSIDE), truth, BACKGROUND, transmittance_threshold=0.0)
    inner = torch.nonzero((topology.face_cells[:, 1] >= 0) & (model.faces.weight > 0)).flatten()
    for face in inner[:: len(inner) // 6].tolist():
        corners, cells = topology.faces[face].long(), topology.face_cells[face].long()
        rest = torch.ones(mesh.num_cells, dtype=torch.bool)
        rest[cells] = False
        tets = [mesh.tets[rest]]
        for cell in mesh.tets[cells]:
            for corner in corners:
                tets.append(torch.where(cell == corner, mesh.num_vertices, cell)[None])
        finer = TetMesh(torch.cat((mesh.vertices, mesh.vertices[corners].mean(0)[None])), torch.cat(tets))
        color = torch.cat((field.color, field.color[corners].mean(0)[None]))
        density = torch.cat((field.density, field.density[corners].mean()[None]))
        gradient, matrix = derivatives(finer, Field(color, density), -1, camera_at(OUTSIDE), truth)
        assert_matches(model.faces, face, gradient, matrix, 0.08)


def test_predicted_decrease_is_that_of_a_new_vertex_optimised_for_real():
    """Split the edge, optimise nothing but the new vertex's four values, and compare what was won."""
    mesh, field, _ = random_scene(density=3.0)
    field = Field(field.color, field.density + 2.0)  # so that no step leads below 0
    camera = camera_at(OUTSIDE)
    finer = bisect_edges(mesh, torch.arange(0, len(mesh.topology.edges), 40))
    generator = torch.Generator().manual_seed(5)
    noise = 0.15 * torch.randn(finer.mesh.num_vertices, 4, generator=generator, dtype=torch.float64)
    true_field = Field(finer.carry(field.color) + noise[:, :3], (finer.carry(field.density) + noise[:, 3]).clamp_min(0))
    truth = render(finer.mesh, true_field, camera, BACKGROUND).color
    model = model_image(mesh, field, camera, truth, BACKGROUND, transmittance_threshold=0.0)
    bound = 1.5
    bounds = torch.full((len(model.edges.gradient), 4), bound, dtype=torch.float64)
    predicted = model.edges.decrease(model.edges.best_step(-bounds, bounds))
    best = predicted.argsort(descending=True)[:6].tolist()
    assert len(best) == 6
    for edge in best:
        change = bisect_edges(mesh, torch.tensor([edge]))
        start = Field(change.carry(field.color), change.carry(field.density))

        achieved = model.error - least_error(change, start, camera, truth, bound)
        assert achieved > 0
        assert float(predicted[edge]) == pytest.approx(achieved, rel=0.15)


def least_error(change, field, camera, truth, bound):
    """Squared error once the four values of the new vertex are the best ones within a bound."""

    def error(values):
        step = torch.tensor(values, requires_grad=True)
        image = render(change.mesh, with_values(field, change.is_new, step), camera, BACKGROUND).color
        difference = (image - truth).square().mean()
        difference.backward()
        return 1e6 * difference.item(), 1e6 * step.grad.numpy()

    best = minimize(error, [0.0] * 4, jac=True, method="L-BFGS-B", bounds=[(-bound, bound)] * 4)
    return 1e-6 * best.fun


def test_best_step_solves_each_system():
    generator = torch.Generator().manual_seed(1)
    count = 200
    jacobian = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    hats = HatDerivatives(
        torch.randn(count, 4, generator=generator, dtype=torch.float64),
        2.0 + jacobian[:, 0] ** 2,
        jacobian[:, 1:],
        9.0 + jacobian[:, 1:].square().sum(1),
        torch.ones(count, dtype=torch.float64),
    )
    free = torch.full((count, 4), math.inf, dtype=torch.float64)
    step = hats.best_step(-free, free)
    matrices = torch.stack([matrix_of(hats, row) for row in range(count)])
    exact = torch.linalg.solve(matrices, -hats.gradient)
    torch.testing.assert_close(step, exact, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(hats.decrease(step), -0.5 * (hats.gradient * exact).sum(1), rtol=1e-9, atol=1e-12)
    bounded = hats.best_step(-0.1 * torch.ones_like(free), 0.05 * torch.ones_like(free))
    assert bounded.min() >= -0.1 and bounded.max() <= 0.05
    assert (hats.decrease(bounded) <= hats.decrease(step) + 1e-12).all()
    assert (hats.decrease(hats.best_step(-free, free, damping=1.0)) > 0).all()


def test_no_unit_of_length_and_sums_of_views():
    models = []
    for scale in (1.0, 1e-9):
        mesh, field, truth = random_scene(scale=scale)
        models.append(model_image(mesh, field, camera_at(OUTSIDE, scale=scale), truth, BACKGROUND))
    one, other = models[0], models[1].with_density_unit(1e9)
    for name in ("gradient", "emission", "coupling", "absorption", "weight"):
        mine, others = getattr(one.edges, name), getattr(other.edges, name)
        assert (mine - others).norm() <= 1e-6 * mine.norm()
    both = (one + one).scaled(0.5)
    torch.testing.assert_close(both.faces.coupling, one.faces.coupling)
    assert both.error == pytest.approx(one.error)


@pytest.mark.usefixtures("kernel_threads")
def test_float32_and_one_thread_agree():
    mesh, field, truth = random_scene()
    exact = model_image(mesh, field, camera_at(OUTSIDE), truth, BACKGROUND)
    mesh, field, truth = random_scene(torch.float32)
    runs = [model_image(mesh, field, camera_at(OUTSIDE), truth, BACKGROUND, deterministic=True) for _ in range(2)]
    assert torch.equal(runs[0].edges.gradient, runs[1].edges.gradient)
    assert torch.equal(runs[0].faces.coupling, runs[1].faces.coupling)
    for kind in ("vertices", "edges", "faces"):
        single, double = getattr(runs[0], kind), getattr(exact, kind)
        assert (single.gradient - double.gradient).norm() <= 1e-3 * double.gradient.norm()
        assert (single.absorption - double.absorption).norm() <= 1e-3 * double.absorption.norm()


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_edges_that_are_asked_for_have_the_models_of_all(share):
    mesh, field, truth = random_scene(torch.float32)
    generator = torch.Generator().manual_seed(0)
    edges = torch.rand(mesh.topology.edges.shape[0], generator=generator) < share
    steps = torch.rand(mesh.topology.faces.shape[0], 4, generator=generator)
    steps[torch.rand(len(steps), generator=generator) < 0.8] = 0.0
    camera, of_image = camera_at(OUTSIDE), {"background": BACKGROUND, "deterministic": True}
    whole, few = (
        model_image(mesh, field, camera, truth, hats=HatChoice(asked, steps), **of_image) for asked in (None, edges)
    )
    errors = truth[..., 0], truth[..., 1]
    others = [
        model_line_integrals(mesh, field.density, camera, errors, HatChoice(asked, steps), deterministic=True)
        for asked in (None, edges)
    ]
    for every, some in ((whole, few), others):
        for name in ("gradient", "emission", "coupling", "absorption", "weight"):
            expected, found = getattr(every.edges, name), getattr(some.edges, name)
            assert torch.equal(found[edges], expected[edges]) and not found[~edges].any()
            assert torch.equal(getattr(some.vertices, name), getattr(every.vertices, name))
        assert torch.equal(some.face_steps.slope, every.face_steps.slope) and bool(some.face_steps.slope.any())
        unasked = ~(steps != 0).any(1)
        assert not some.face_steps.slope[unasked].any() and not some.face_steps.curvature[unasked].any()


def test_what_is_refused():
    mesh, field, truth = random_scene()
    per_cell = dtv.Field(torch.rand(mesh.num_cells, 3), torch.rand(mesh.num_cells))
    with pytest.raises(DiffTetError, match=r"face_steps is .*; pass floats of shape \(\d+, 4\), one step a face\."):
        model_image(mesh, field, camera_at(OUTSIDE), truth, hats=HatChoice(face_steps=torch.zeros(3, 4)))
    with pytest.raises(DiffTetError, match=r"edges is .*; pass a bool tensor of shape \(\d+,\), one for each edge\."):
        model_image(mesh, field, camera_at(OUTSIDE), truth, hats=HatChoice(edges=torch.arange(3)))
    errors = torch.zeros(48, 48), torch.zeros(48, 48)
    with pytest.raises(DiffTetError, match="No steps of faces"):
        model_line_integrals(mesh, field.density, camera_at(OUTSIDE), errors, HatChoice())
    with pytest.raises(MeshError, match="lives on cells"):
        model_image(mesh, per_cell, camera_at(OUTSIDE), truth)
    with pytest.raises(DiffTetError, match=r"shape \(48, 48, 3\); the camera takes \(30, 30, 3\)"):
        model_image(mesh, field, camera_at(OUTSIDE, size=30), truth)


def test_views_of_no_rays_are_refused():
    mesh = TetMesh.grid((1, 1, 1))
    density, hats = torch.ones(mesh.num_vertices), HatChoice(face_steps=torch.zeros(mesh.topology.faces.shape[0], 4))
    rays = dtv.Rays(torch.zeros(0, 3, 3), torch.ones(0, 3, 3))
    with pytest.raises(DiffTetError, match="says nothing"):
        model_image(mesh, Field(torch.ones(mesh.num_vertices, 3), density), rays, torch.zeros(0, 3, 3))
    with pytest.raises(DiffTetError, match="says nothing"):
        model_line_integrals(mesh, density, rays, (torch.zeros(0, 3), torch.zeros(0, 3)), hats)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_models_of_line_integrals_predict_what_densities_do(scale):
    """Of vertices exactly where rays meet their cells but once; of edges and flips as bent hats are integrated."""
    mesh, field, _ = random_scene(scale=scale)
    camera, generator = camera_at(OUTSIDE, scale=scale), torch.Generator().manual_seed(1)
    density, unit = field.density, 4.0 / scale

    def integrals(mesh, density):
        return render(mesh, Field(density.new_zeros(len(density), 0), density), camera).optical_depth

    measured = integrals(mesh, unit * torch.rand(len(density), generator=generator, dtype=torch.float64))
    weights = torch.rand(measured.shape, generator=generator, dtype=torch.float64)

    def loss(mesh, density):
        return float((0.5 * weights * (integrals(mesh, density) - measured).square()).sum())

    flips = find_flips(mesh)
    values = torch.nn.functional.pad(density[:, None], (3, 0))
    hats = HatChoice(face_steps=face_steps(flips, flips.surplus(values)))
    errors = weights * (integrals(mesh, density) - measured), weights
    model = model_line_integrals(mesh, density, camera, errors, hats)
    step = torch.tensor([[0.0, 0.0, 0.0, 0.3 * unit]], dtype=torch.float64)
    before = loss(mesh, density)
    for vertex in range(0, mesh.num_vertices, 7):
        moved = density.clone()
        moved[vertex] += step[0, 3]
        decrease = float(model.vertices.decrease(step)[vertex])
        assert before - loss(mesh, moved) == pytest.approx(decrease, rel=1e-3, abs=1e-6 * before)
    for edge in range(0, mesh.topology.edges.shape[0], 23):
        change = bisect_edges(mesh, torch.tensor([edge]))
        moved = change.carry(density)
        moved[change.is_new] += step[0, 3]
        decrease = float(model.edges.decrease(step)[edge])
        assert before - loss(change.mesh, moved) == pytest.approx(decrease, rel=0.03, abs=2e-3 * before)
    gains = flip_gains(flips, flips.surplus(values), model)
    for one in (flips.kind == TWO_TO_THREE).nonzero().flatten()[:8]:
        after = loss(apply_flips(flips.select(one[None])).mesh, density)
        assert before - after == pytest.approx(float(gains[one]), rel=0.1, abs=2e-3 * before)
    with pytest.raises(DiffTetError, match="shape"):
        model_line_integrals(mesh, density, camera, (errors[0][1:], weights), hats)
