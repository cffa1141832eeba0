"""Strategies: their schedules, their predictions against real changes, and what they do to a mesh."""

import dataclasses

import pytest
import torch

from difftetvr.capture.free_space import FreeSpace
from difftetvr.errors import FitError
from difftetvr.fitting.refinement import Exchange, Grow, Moment, Situation, Star
from difftetvr.fitting.refinement.gains import (
    Candidates,
    bisection_gains,
    collapse_costs,
    edges_before,
    face_steps,
    flip_gains,
)
from difftetvr.mesh import Field, TetMesh, bisect_edges, collapse_edges
from difftetvr.mesh.changes.flip_search import find_flips
from difftetvr.mesh.changes.flips import apply_flips
from difftetvr.mesh.locate import locate
from difftetvr.rendering import Camera, render
from difftetvr.rendering.gauss_newton import HatChoice, model_image

NOWHERE = FreeSpace([], [])
CAMERA = Camera.look_at(eye=(0.4, -1.6, 0.9), target=(0.5, 0.5, 0.5), up=(0, 0, 1), width=48, height=48)


def shells(points):
    """(N, 4) values of a smooth scene with a steep shell in it: where a mesh must be fine."""
    distance = torch.linalg.vector_norm(points - points.new_tensor([0.55, 0.45, 0.5]), dim=1)
    shell = torch.exp(-(((distance - 0.3) / 0.07) ** 2))
    color = torch.stack((shell, 0.5 + 0.4 * points[:, 0], 1.0 - shell), 1)
    return torch.cat((color.clamp(0, 1), 6.0 * shell[:, None]), 1)


@pytest.fixture(scope="module")
def scene():
    """A coarse jittered mesh with the shells' values, in float64, and the model of its squared error."""
    generator = torch.Generator().manual_seed(3)
    mesh = TetMesh.grid((5, 5, 5), dtype=torch.float64)
    step = 0.2 * (torch.rand(mesh.vertices.shape, generator=generator, dtype=torch.float64) - 0.5)
    step[mesh.topology.boundary_faces.unique().long()] = 0.0
    mesh = mesh.with_vertices(mesh.vertices + step * mesh.vertex_altitudes()[:, None])
    fine = TetMesh.grid((24, 24, 24), dtype=torch.float64)
    truth = image_of(fine, shells(fine.vertices))
    values = shells(mesh.vertices)
    return mesh, values, truth, model_of(mesh, values, truth)


def field_of(values):
    return Field(values[:, :3], values[:, 3])


def image_of(mesh, values):
    return render(mesh, field_of(values), CAMERA).color


def model_of(mesh, values, truth):
    return model_image(mesh, field_of(values), CAMERA, truth, transmittance_threshold=0.0)


def error_of(mesh, values, truth):
    return float((image_of(mesh, values) - truth).square().mean())


def situation_of(scene, budget=None, iteration=100, free_space=NOWHERE):
    mesh, values, _, model = scene
    moment = Moment(iteration, 1000, 10, mesh.num_cells, budget or mesh.num_cells)
    gradients = torch.linspace(0, 1, mesh.num_vertices)
    return Situation(mesh, values, moment, lambda hats: model, lambda: gradients, free_space)


def everything(mesh):
    return torch.ones(mesh.num_vertices, dtype=torch.bool)


def applied(values, refinement):
    for change in refinement.changes:
        values = change.carry(values)
    return values if refinement.surplus is None else values + refinement.surplus


def test_long_runs_are_refined_more_often():
    due = [sum(Exchange().is_due(Moment(i, n, 64, 900, 1000)) for i in range(n)) for n in (1200, 2400, 4800)]
    assert due == [40, 40, 80]


@pytest.mark.parametrize("iterations", [30, 240, 2400])
@pytest.mark.parametrize("strategy", [Exchange(rounds=40), Exchange(rounds=3, until=0.5), Grow(rounds=7)])
def test_rounds_are_spread_over_the_run(strategy, iterations):
    due = [i for i in range(iterations) if strategy.is_due(Moment(i, iterations, 64, 900, 1000))]
    assert len(due) == min(strategy.rounds, int(strategy.until * iterations) + 1)
    assert due[0] > 0 and due[-1] <= strategy.until * iterations + 1
    gaps = torch.tensor(due).diff()
    assert gaps.max() - gaps.min() <= 1
    assert strategy.target(Moment(due[-1], iterations, 64, 900, 1000)) == 1000


def test_growth_is_by_equal_factors():
    grow = Grow(rounds=4, until=0.8, initial=1 / 16)
    assert grow.initial_cells(16_000) == 1000
    targets = [grow.target(Moment(i, 100, 10, 0, 16_000)) for i in (0, 20, 40, 60, 80, 99)]
    assert targets == [1000, 2000, 4000, 8000, 16_000, 16_000]
    assert Exchange().initial_cells(777) == 777


def test_the_article_s_epochs():
    """Colours alone for one pass over the views, with positions for the next, then the subdivision."""
    star = Star(until=0.5)
    moments = [Moment(i, 100, 5, 10, 1000) for i in range(100)]
    assert [m.iteration for m in moments if star.is_due(m)] == [10, 20, 30, 40, 50]
    moving = [m.iteration for m in moments if star.lets_move(m)]
    assert moving == [i for i in range(50) if i // 5 % 2 == 1]
    assert not star.is_due(dataclasses.replace(moments[10], cells=1000)), "the budget is used up"


def test_star_takes_the_largest_gradients_within_the_budget(scene):
    mesh = scene[0]
    refinement = Star(share=0.05).refine(situation_of(scene, budget=10**6))
    change = refinement.changes[0]
    count = round(0.05 * mesh.num_vertices)
    split = change.parents[change.is_new]
    assert (split >= mesh.num_vertices - count).any(1).all(), "gradients grow with the vertices' indices"
    assert refinement.added == int(change.is_new.sum()) and refinement.removed == 0
    room = mesh.num_cells + (change.mesh.num_cells - mesh.num_cells) // 2
    fewer = Star(share=0.05).refine(situation_of(scene, budget=room))
    assert mesh.num_cells < fewer.changes[0].mesh.num_cells <= room
    assert Star().refine(situation_of(scene, budget=mesh.num_cells)) is None


def test_collapse_costs_are_those_of_the_values_after_a_real_collapse(scene):
    mesh, values, _, model = scene
    costs = collapse_costs(mesh, values, model.vertices, everything(mesh), 1.0)
    generator = torch.Generator().manual_seed(0)
    tried = 0
    for row in torch.randperm(len(costs.cost), generator=generator)[:120].tolist():
        edge, target = costs.edges[row : row + 1], costs.target[row : row + 1]
        change = collapse_edges(mesh, edge, target, torch.zeros(1), min_quality=0.0)
        if change.mesh.num_vertices == mesh.num_vertices:
            continue
        tried += 1
        removed = int(mesh.topology.edges[edge[0], 1 - target[0]])
        cell, weights, found = locate(change.mesh, mesh.vertices[removed : removed + 1])
        assert found.all()
        after = (change.carry(values)[change.mesh.tets[cell[0]].long()] * weights[0][:, None]).sum(0)
        step = torch.zeros_like(values)
        step[removed] = after - values[removed]
        least = 0.5 * float(model.vertices.curvature(step)[removed])
        assert float(costs.cost[row]) >= least * (1 - 1e-6) - 1e-15, "the bends between the new cells cost more"
        assert mesh.num_cells - change.mesh.num_cells == int(costs.cells[row])
    assert tried > 15


def test_flips_gain_the_same_by_the_one_step_that_is_asked_for(scene):
    mesh, values, truth, model = scene
    flips = find_flips(mesh)
    steps = face_steps(flips, flips.surplus(values))
    assert 0 < int(steps.any(1).sum()) < len(steps)
    hats = HatChoice(face_steps=steps)
    asked = model_image(mesh, field_of(values), CAMERA, truth, transmittance_threshold=0.0, hats=hats)
    assert asked.faces is None
    expected = flip_gains(flips, flips.surplus(values), model)
    torch.testing.assert_close(
        flip_gains(flips, flips.surplus(values), asked), expected, rtol=1e-9, atol=1e-9 * float(expected.max())
    )
    both = (asked + asked).scaled(0.5).with_density_unit(3.0)
    torch.testing.assert_close(both.face_steps.decrease(), asked.face_steps.decrease())


def test_where_all_else_is_linear_a_collapse_costs_the_vertex_s_own_deviation(scene):
    mesh, _, _, model = scene
    matrix = torch.tensor([[0.2, 0.1, -0.1, 1.0], [0.1, -0.2, 0.3, 0.5], [0.0, 0.1, 0.2, -0.3]], dtype=torch.float64)
    values = 0.5 + mesh.vertices @ matrix
    flat = collapse_costs(mesh, values, model.vertices, everything(mesh), 1.0)
    assert flat.cost.abs().max() < 1e-20
    inner = set(range(mesh.num_vertices)) - set(mesh.topology.boundary_faces.unique().tolist())
    vertex = sorted(inner)[len(inner) // 2]
    bump = torch.zeros_like(values)
    bump[vertex] = torch.tensor([0.3, -0.2, 0.1, 0.4], dtype=torch.float64)
    costs = collapse_costs(mesh, values + bump, model.vertices, everything(mesh), 1.0)
    removed = mesh.topology.edges.long()[costs.edges].gather(1, 1 - costs.target[:, None])[:, 0]
    expected = 0.5 * float(model.vertices.curvature(bump)[vertex])
    assert (removed == vertex).sum() > 3
    torch.testing.assert_close(costs.cost[removed == vertex], torch.full_like(costs.cost[removed == vertex], expected))


def test_collapses_cost_what_is_predicted(scene):
    """Over four orders of magnitude, where nothing is left to win and the quadratic is all there is."""
    mesh, values, _, _ = scene
    truth = image_of(mesh, values)
    model = model_of(mesh, values, truth)
    costs = collapse_costs(mesh, values, model.vertices, everything(mesh), 1.0)
    predicted, real = [], []
    generator = torch.Generator().manual_seed(0)
    for row in torch.randperm(len(costs.cost), generator=generator)[:160].tolist():
        half_edge = costs.edges[row : row + 1], costs.target[row : row + 1]
        change = collapse_edges(mesh, *half_edge, torch.zeros(1), min_quality=0.0)
        if change.mesh.num_vertices < mesh.num_vertices:
            predicted.append(float(costs.cost[row]))
            real.append(error_of(change.mesh, change.carry(values), truth))
    assert len(real) > 40
    logarithms = torch.tensor([predicted, real], dtype=torch.float64).log()
    assert logarithms[0].max() - logarithms[0].min() > 7
    assert torch.corrcoef(logarithms)[0, 1] > 0.85
    assert abs(float((logarithms[1] - logarithms[0]).median())) < 0.7, "within a factor of two in the middle"


def test_flip_gains_are_those_of_real_flips(scene):
    truth = scene[2]
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    mesh = TetMesh.delaunay(torch.cat((scene[0].vertices, points)))
    values = shells(mesh.vertices)
    model = model_of(mesh, values, truth)
    flips = find_flips(mesh, min_quality=0.02)
    gain = flip_gains(flips, flips.surplus(values), model)
    before = error_of(mesh, values, truth)
    best = gain.argsort(descending=True)
    rows = torch.cat((best[:25], best[-25:]))
    achieved = []
    for row in rows.tolist():
        change = apply_flips(flips.select(torch.tensor([row])), torch.zeros(1))
        achieved.append(before - error_of(change.mesh, values, truth))
    predicted, achieved = gain[rows], torch.tensor(achieved, dtype=torch.float64)
    assert set(flips.kind[rows].tolist()) >= {2, 3}
    assert torch.corrcoef(torch.stack((predicted, achieved)))[0, 1] > 0.9
    assert (achieved[:25] > 0).float().mean() > 0.8
    assert (achieved[25:] < 0).float().mean() > 0.8
    assert 0.6 < float(achieved[:25].sum() / predicted[:25].sum()) < 1.4


@pytest.mark.parametrize(("stays_empty", "start"), [(False, 1.0), (True, 1.0), (True, 0.6)])
def test_bisections_win_what_is_predicted(scene, stays_empty, start):
    mesh, values, truth, model = scene
    edges = torch.arange(0, len(mesh.topology.edges), 2)
    candidates = Candidates(edges, torch.full((len(edges),), stays_empty))
    gains = bisection_gains(mesh, values, model.edges, candidates, start)
    assert not gains.gain[1::2].any() and not gains.start[1::2].any()
    before = error_of(mesh, values, truth)
    best = gains.start_gain.argsort(descending=True)[:12]
    achieved = 0.0
    for edge in best.tolist():
        change = bisect_edges(mesh, torch.tensor([edge]))
        finer = change.carry(values) + change.is_new[:, None] * gains.start[edge]
        assert ((finer[:, :3] >= -1e-12) & (finer[:, :3] <= 1 + 1e-12)).all() and (finer[:, 3] >= -1e-12).all()
        assert not stays_empty or (finer[change.is_new, 3].abs() < 1e-12).all()
        won = before - error_of(change.mesh, finer.clamp_min(0.0), truth)
        assert won > 0
        achieved += won
    assert achieved == pytest.approx(float(gains.start_gain[best].sum()), rel=0.3)


def test_exchange_leaves_free_space_alone(scene):
    mesh, values, truth, model = scene
    # The half of the scene that is nearer to the camera.
    space = FreeSpace([Camera.look_at((5.0, 0.5, 0.5), (0.0, 0.5, 0.5), width=8, height=8)], [4.5])
    values = values.clone()
    values[space.contains(mesh.vertices), 3] = 0.0
    situation = situation_of((mesh, values, truth, model), 2 * mesh.num_cells, free_space=space)
    refinement = Exchange(flips=False).refine(situation)
    added = refinement.changes[-1].is_new
    positions = refinement.changes[-1].mesh.vertices[added]
    density = applied(values, refinement)[added, 3]
    is_free = space.contains(positions)
    assert is_free.any() and (density[is_free].abs() < 1e-12).all() and (density[~is_free] > 0.0).any()


def test_edges_before_a_change(scene):
    mesh = scene[0]
    change = bisect_edges(mesh, torch.tensor([7, 300]))
    before = edges_before(mesh.topology, change)
    edges = change.mesh.topology.edges
    for row in range(len(edges)):
        ends = sorted(edges[row].tolist())
        if before[row] >= 0:
            assert mesh.topology.edges[before[row]].tolist() == ends
        else:
            assert ends[1] >= mesh.num_vertices
    assert set(range(len(mesh.topology.edges))) - set(before.tolist()) == {7, 300}


@pytest.mark.parametrize(
    "strategy",
    [Exchange(), Exchange(flips=False), Exchange(boundary="fixed"), Exchange(share=0.0, initial=0.5), Grow(rounds=2)],
)
def test_an_exchange_lowers_the_error_and_keeps_the_budget(scene, strategy):
    mesh, values, truth, _ = scene
    budget = mesh.num_cells if strategy.initial == 1.0 else round(1.05 * mesh.num_cells)
    situation = situation_of(scene, budget, iteration=860)
    refinement = strategy.refine(situation)
    changed = refinement.changes[-1].mesh
    TetMesh(changed.vertices, changed.tets)
    target = strategy.target(situation.moment)
    assert 0.97 * target <= changed.num_cells <= target
    new_values = applied(values, refinement)
    assert ((new_values[:, :3] >= -1e-12) & (new_values[:, :3] <= 1 + 1e-12)).all()
    assert (new_values[:, 3] >= -1e-12).all()
    assert (refinement.surplus != 0).any(1).sum() <= refinement.added
    if strategy.boundary == "fixed" and strategy.share:
        kept = set(refinement.changes[0].parents[:, 0].tolist())
        assert set(mesh.topology.boundary_faces.unique().tolist()) <= kept
    achieved = error_of(mesh, values, truth) - error_of(changed, new_values, truth)
    assert achieved > 0
    assert 0.4 < achieved / refinement.predicted < 1.5
    assert (refinement.flipped > 0) == strategy.flips
    assert (refinement.removed > 0) == (strategy.share > 0)


@pytest.mark.parametrize(
    ("kind", "option"),
    [
        (Exchange, {"rounds": 0}),
        (Exchange, {"until": 1.5}),
        (Exchange, {"share": 1.0}),
        (Exchange, {"views": 0}),
        (Exchange, {"start": -0.1}),
        (Grow, {"initial": 0.0}),
        (Grow, {"long": 2.0}),
        (Star, {"share": 0.0}),
        (Star, {"until": -1.0}),
        (Star, {"views": 0}),
    ],
)
def test_refuses_options_out_of_range(kind, option):
    with pytest.raises(FitError, match=rf"^The option {kind.__name__.lower()}\.{next(iter(option))} is "):
        kind(**option)
