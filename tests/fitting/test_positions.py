import numpy as np
import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr import TetMesh
from difftetvr.errors import FitError
from difftetvr.fitting.motion import VertexOptimizerConfig
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.regularizers import shape_barrier
from difftetvr.mesh.changes.bisection import bisect_edges
from difftetvr.mesh.limits import MotionLimits

properties = examples(13)
seeds = st.integers(0, 2**32 - 1)
boundaries = st.sampled_from(["fixed", "slide"])


def jittered_grid(seed=0, shape=(3, 3, 2), dtype=torch.float64):
    """Inner vertices off the lattice; the boundary is that of the unit box."""
    mesh = TetMesh.grid(shape, dtype=dtype)
    noise = torch.rand(mesh.vertices.shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)
    noise[torch.unique(mesh.topology.boundary_faces).long()] = 0.5
    return TetMesh(mesh.vertices + 0.15 * (noise - 0.5), mesh.tets)


def gradients(mesh, seed, count=1):
    rng = np.random.default_rng(seed)
    return [torch.from_numpy(rng.normal(size=mesh.vertices.shape)).to(mesh.vertices.dtype) for _ in range(count)]


def step_with(optimizer, gradient, rate=None):
    optimizer.mesh.vertices.grad = gradient.clone()
    return optimizer.step(rate)


def on_box(vertices):
    return (vertices == 0) | (vertices == 1)


@properties
@given(
    seed=seeds,
    boundary=boundaries,
    dtype=st.sampled_from([torch.float32, torch.float64]),
    rate=st.floats(-3, 3).map(lambda e: 10.0**e),
    barrier=st.sampled_from([0.0, 0.1, 100.0]),
)
def test_no_gradient_and_no_rate_harms_the_mesh(seed, boundary, dtype, rate, barrier):
    """Rates up to a thousand altitudes, hence far over 100 cells: cap and guard hold, the box stays a box."""
    config = VertexOptimizerConfig(boundary=boundary, barrier=barrier)
    optimizer = VertexOptimizer(jittered_grid(seed, dtype=dtype), config)
    start = optimizer.mesh
    pushes = gradients(start, seed, 4)
    pushes[2] *= 1e20
    pushes[3] = start.vertices.detach() - 0.5  # towards the centre
    for push in pushes:
        before = optimizer.mesh
        report = step_with(optimizer, push, rate)
        mesh = optimizer.mesh
        mesh.validate()
        moved = (mesh.vertices != before.vertices).any(1)
        assert report.moved == moved.sum()
        move = torch.linalg.vector_norm((mesh.vertices - before.vertices).double(), dim=1)
        longest = config.cap * before.vertex_altitudes().double()
        assert (move <= longest * (1 + 1e-6) + 1e-7).all()
        floor = torch.minimum(before.quality(), torch.tensor(config.limits.quality, dtype=dtype))
        assert (mesh.quality() >= floor * (1 - 1e-6)).all()
        assert (mesh.volumes() >= config.limits.volume_ratio * before.volumes() * (1 - 1e-6)).all()

    side = on_box(start.vertices)
    if boundary == "fixed":
        assert torch.equal(mesh.vertices[side.any(1)], start.vertices[side.any(1)])
    else:
        assert torch.equal(mesh.vertices[side], start.vertices[side])
        assert (mesh.vertices[side.sum(1) == 1] != start.vertices[side.sum(1) == 1]).any()
    assert float(mesh.volumes().double().sum().detach()) == pytest.approx(1.0, rel=1e-6)


def test_steps_are_zero_where_nothing_is_allowed():
    """All vertices of a 1x1x1 grid are corners of the box: neither kind of boundary leaves them a direction."""
    for boundary in ("fixed", "slide"):
        optimizer = VertexOptimizer(TetMesh.grid((1, 1, 1)), VertexOptimizerConfig(boundary=boundary))
        report = step_with(optimizer, torch.ones(8, 3))
        assert torch.equal(optimizer.mesh.vertices, TetMesh.grid((1, 1, 1)).vertices)
        assert report.moved == report.refused == 0


def test_without_gradient_and_barrier_nothing_moves():
    mesh = jittered_grid()
    optimizer = VertexOptimizer(mesh, VertexOptimizerConfig(barrier=0.0, wall=0.0))
    step_with(optimizer, torch.zeros_like(mesh.vertices))
    assert torch.equal(optimizer.mesh.vertices, mesh.vertices)


@properties
@given(seed=seeds, boundary=boundaries, exponent=st.integers(-40, 40))
def test_steps_scale_with_the_mesh(seed, boundary, exponent):
    """Gradients of the same loss are 1/s as long in a mesh of size s, steps s times as long: to the bit, s = 2^k."""
    scale = 2.0**exponent
    mesh = jittered_grid(seed)
    config = VertexOptimizerConfig(boundary=boundary)
    plain, scaled = VertexOptimizer(mesh, config), VertexOptimizer(TetMesh(mesh.vertices * scale, mesh.tets), config)
    for push in gradients(mesh, seed, 5):
        assert step_with(plain, push) == step_with(scaled, push / scale)
    assert torch.equal(plain.mesh.vertices * scale, scaled.mesh.vertices)


@pytest.mark.parametrize("scale", [1e-12, 1 / 3, 1e6])
def test_any_unit_of_length_and_of_the_loss(scale):
    mesh = jittered_grid()
    plain, scaled = VertexOptimizer(mesh), VertexOptimizer(TetMesh(mesh.vertices * scale, mesh.tets))
    for push in gradients(mesh, 1, 5):
        step_with(plain, push)
        step_with(scaled, push * 1e-30)
    torch.testing.assert_close(scaled.mesh.vertices / scale, plain.mesh.vertices, rtol=0, atol=1e-12)


def test_the_shortest_gradients_move_vertices_as_far():
    """Numbers below 1e-38 are 0 to kernels of float32; enough vertices that several threads take part."""
    mesh = TetMesh.grid((30, 30, 30))
    push = torch.randn(mesh.vertices.shape, generator=torch.Generator().manual_seed(0))
    plain, tiny = (VertexOptimizer(mesh, VertexOptimizerConfig(barrier=0.0)) for _ in range(2))
    assert step_with(plain, push).moved == step_with(tiny, push * 1e-39).moved > 0.8 * mesh.num_vertices
    torch.testing.assert_close(tiny.mesh.vertices, plain.mesh.vertices, rtol=0, atol=1e-5)


@properties
@given(seed=seeds, boundary=boundaries)
def test_steps_turn_with_the_mesh(seed, boundary):
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    turn = torch.from_numpy(matrix * np.linalg.det(matrix)).T
    mesh = jittered_grid(seed)
    config = VertexOptimizerConfig(boundary=boundary)
    plain, turned = VertexOptimizer(mesh, config), VertexOptimizer(TetMesh(mesh.vertices @ turn, mesh.tets), config)
    for push in gradients(mesh, seed, 3):
        step_with(plain, push)
        step_with(turned, push @ turn)
    torch.testing.assert_close(turned.mesh.vertices, plain.mesh.vertices @ turn, rtol=0, atol=1e-10)


def test_a_steady_gradient_moves_by_the_rate_in_altitudes():
    mesh = jittered_grid(shape=(4, 4, 4))
    optimizer = VertexOptimizer(mesh, VertexOptimizerConfig(barrier=0.0, wall=0.0))
    push = torch.ones_like(mesh.vertices)
    report = step_with(optimizer, push, rate=0.02)
    move = torch.linalg.vector_norm(optimizer.mesh.vertices - mesh.vertices, dim=1).detach()
    inner = ~on_box(mesh.vertices).any(1)
    torch.testing.assert_close(move[inner], 0.02 * mesh.vertex_altitudes()[inner])
    assert report.moved == inner.sum()
    assert report.capped == report.halved == report.refused == 0


def test_the_cap_and_the_guard_report_what_they_hold_back():
    mesh = jittered_grid(shape=(4, 4, 4))
    push = gradients(mesh, 0)[0]
    inner = int((~on_box(mesh.vertices).any(1)).sum())
    capped = VertexOptimizer(mesh, VertexOptimizerConfig(barrier=0.0, wall=0.0))
    assert step_with(capped, push, rate=100.0).capped == inner
    strict = MotionLimits(volume_ratio=0.999)
    held = VertexOptimizer(mesh, VertexOptimizerConfig(barrier=0.0, wall=0.0, limits=strict))
    report = step_with(held, push, rate=100.0)
    assert report.halved + report.refused > inner / 2
    assert report.moved <= inner - report.refused


def test_barrier_alone_improves_shapes():
    mesh = jittered_grid(3, shape=(4, 4, 4))
    optimizer = VertexOptimizer(mesh)
    worst, total = mesh.quality().min(), shape_barrier(mesh)
    for _ in range(50):
        step_with(optimizer, torch.zeros_like(mesh.vertices))
    assert optimizer.mesh.quality().min() > worst
    assert shape_barrier(optimizer.mesh) < total


def flattening(config, steps=300):
    """One inner vertex that the loss pulls straight into a face of the box; returns its optimiser and the reports."""
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float64)
    optimizer = VertexOptimizer(mesh, config)
    push = torch.zeros_like(mesh.vertices)
    push[13, 2] = 1.0
    return optimizer, [step_with(optimizer, push) for _ in range(steps)]


def test_the_wall_stops_thin_cells_before_the_guard_must():
    config = VertexOptimizerConfig(barrier=0.0)
    optimizer, reports = flattening(config)
    assert sum(report.refused + report.halved for report in reports) == 0
    assert config.limits.quality < optimizer.mesh.quality().min() < 2.5 * config.limits.quality
    _, reports = flattening(VertexOptimizerConfig(barrier=0.0, wall=0.0))
    assert sum(report.refused for report in reports) > 50


def test_gradients_add_up_between_steps():
    mesh = jittered_grid()
    once, twice = VertexOptimizer(mesh), VertexOptimizer(mesh)
    weights = gradients(mesh, 2, 2)
    ((weights[0] + weights[1]) * once.mesh.vertices).sum().backward()
    for weight in weights:
        (weight * twice.mesh.vertices).sum().backward()
    once.step()
    twice.step()
    torch.testing.assert_close(once.mesh.vertices, twice.mesh.vertices)
    assert twice.mesh.vertices.grad is None and twice.mesh.vertices.requires_grad
    # The mesh that was passed in is nobody's to move.
    assert torch.equal(mesh.vertices, jittered_grid().vertices)


def test_descends_in_a_loop_of_ones_own():
    """Moves the inner vertices towards places that a valid mesh can reach."""
    mesh, target = TetMesh.grid((3, 3, 2), dtype=torch.float64), jittered_grid(5).vertices
    optimizer = VertexOptimizer(mesh, VertexOptimizerConfig(barrier=0.0, wall=0.0))
    for i in range(150):
        (optimizer.mesh.vertices - target).square().sum().backward()
        optimizer.step(optimizer.config.rate_at(i / 150))
    before = (mesh.vertices - target).abs().max()
    assert (optimizer.mesh.vertices - target).abs().max() < 0.05 * before


@pytest.mark.parametrize("boundary", ["fixed", "slide"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_goes_on_from_a_saved_state_to_the_bit(boundary, dtype):
    mesh = jittered_grid(dtype=dtype)
    config = VertexOptimizerConfig(boundary=boundary)
    pushes = gradients(mesh, 3, 8)
    whole = VertexOptimizer(mesh, config)
    for push in pushes[:4]:
        step_with(whole, push)
    saved = {name: tensor.clone() for name, tensor in whole.state().items()}
    resumed = VertexOptimizer(mesh.with_vertices(saved["vertices"]), config)
    resumed.restore(saved)
    for push in pushes[4:]:
        assert step_with(whole, push) == step_with(resumed, push)
    after = resumed.state()
    assert all(torch.equal(tensor, after[name]) for name, tensor in whole.state().items())
    assert resumed.steps == 8
    assert not torch.equal(saved["vertices"], after["vertices"]), "restore() must copy"


def test_refuses_a_foreign_state():
    optimizer = VertexOptimizer(jittered_grid())
    with pytest.raises(FitError, match="vertices"):
        optimizer.restore(VertexOptimizer(jittered_grid(shape=(2, 2, 2))).state())
    with pytest.raises(FitError, match="second_moment"):
        optimizer.restore({k: v for k, v in optimizer.state().items() if k != "second_moment"})


@pytest.mark.parametrize("boundary", ["fixed", "slide"])
def test_follows_a_change_of_the_mesh(boundary):
    mesh = jittered_grid(shape=(4, 3, 3))
    optimizer = VertexOptimizer(mesh, VertexOptimizerConfig(boundary=boundary))
    for push in gradients(mesh, 4, 6):
        step_with(optimizer, push)
    before = optimizer.state()
    change = bisect_edges(optimizer.mesh, torch.tensor([5, 40, 90]))
    optimizer.carry(change)
    after = optimizer.state()

    assert torch.equal(after["vertices"], change.mesh.vertices)
    kept, ends = ~change.is_new, change.parents.long()
    assert change.is_new.any()
    for name in ("first_moment", "second_moment"):
        assert torch.equal(after[name][kept], before[name][ends[kept, 0]])
    assert not after["first_moment"][change.is_new].any()
    means = before["second_moment"][ends[change.is_new]].mean(1)
    torch.testing.assert_close(after["second_moment"][change.is_new], means)
    assert optimizer.steps == 6

    side = on_box(change.mesh.vertices)
    for push in gradients(change.mesh, 5, 4):
        step_with(optimizer, push)
    optimizer.mesh.validate()
    assert torch.equal(optimizer.mesh.vertices[side], change.mesh.vertices[side])


@properties
@given(
    seed=seeds,
    boundary=boundaries,
    dtype=st.sampled_from([torch.float32, torch.float64]),
    length=st.sampled_from([1e-3, 0.05, 10.0]),
)
def test_moves_to_places_as_far_as_the_mesh_allows(seed, boundary, dtype, length):
    mesh = jittered_grid(seed, dtype=dtype)
    optimizer = VertexOptimizer(mesh, VertexOptimizerConfig(boundary=boundary))
    step_with(optimizer, gradients(mesh, seed)[0])
    state, old = optimizer.state(), optimizer.mesh.vertices.detach()
    places = old + length * gradients(mesh, seed + 1)[0]
    optimizer.mesh.vertices.grad = gradients(mesh, seed)[0]
    optimizer.move_to(places)
    assert optimizer.mesh.vertices.requires_grad and optimizer.mesh.vertices.grad is None
    TetMesh(optimizer.mesh.vertices.detach(), mesh.tets)
    inner = ~on_box(mesh.vertices).any(1)
    if length == 1e-3:
        torch.testing.assert_close(optimizer.mesh.vertices[inner].detach(), places[inner])
    sides = on_box(mesh.vertices)
    assert torch.equal(optimizer.mesh.vertices.detach()[sides], mesh.vertices[sides])
    for name in ("first_moment", "second_moment", "steps"):
        assert torch.equal(optimizer.state()[name], state[name])


def test_takes_one_place_for_each_vertex():
    optimizer = VertexOptimizer(jittered_grid())
    before = optimizer.mesh
    with pytest.raises(FitError, match=r"^The places have shape \(3,\); pass one for each vertex, \(48, 3\)\.$"):
        optimizer.move_to(torch.zeros(3))
    assert optimizer.mesh is before


def test_says_what_is_missing():
    mesh = jittered_grid()
    optimizer = VertexOptimizer(mesh)
    with pytest.raises(FitError, match="No gradient"):
        optimizer.step()
    push = torch.ones_like(mesh.vertices)
    push[7, 1] = torch.nan
    state = {name: tensor.clone() for name, tensor in optimizer.state().items() if name != "gradient"}
    with pytest.raises(FitError, match="vertex 7"):
        step_with(optimizer, push)
    assert all(torch.equal(optimizer.state()[name], tensor) for name, tensor in state.items())
    optimizer.zero_grad()
    with pytest.raises(FitError, match="No gradient"):
        optimizer.step()


@pytest.mark.parametrize(
    "option",
    [
        {"rate": 0.0},
        {"final_rate": np.inf},
        {"betas": (0.9, 1.0)},
        {"barrier": -1.0},
        {"wall": np.nan},
        {"cap": 0.25},
        {"coplanarity": -1e-3},
        {"boundary": "free"},
    ],
)
def test_refuses_options_out_of_range(option):
    with pytest.raises(FitError, match=next(iter(option))):
        VertexOptimizerConfig(**option)


def test_rate_falls_log_linearly():
    config = VertexOptimizerConfig(rate=0.1, final_rate=0.001)
    assert [config.rate_at(p) for p in (0.0, 0.5, 1.0)] == pytest.approx([0.1, 0.01, 0.001])


@pytest.mark.gpu
@pytest.mark.parametrize("boundary", ["fixed", "slide"])
def test_cuda_agrees_with_the_cpu(boundary):
    mesh = jittered_grid(shape=(5, 4, 4))
    config = VertexOptimizerConfig(boundary=boundary)
    cpu, cuda = VertexOptimizer(mesh, config), VertexOptimizer(mesh.to("cuda"), config)
    for push in gradients(mesh, 6, 5):
        assert step_with(cpu, push, 0.3) == step_with(cuda, push.cuda(), 0.3)
    torch.testing.assert_close(cuda.mesh.vertices.cpu(), cpu.mesh.vertices, rtol=0, atol=1e-12)
    cuda.carry(bisect_edges(cuda.mesh, torch.tensor([5, 40, 90], device="cuda")))
    step_with(cuda, torch.ones_like(cuda.mesh.vertices))
    cuda.mesh.validate()
