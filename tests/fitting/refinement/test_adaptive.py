"""Runs that move and refine: they learn more, stay valid, and go on after a kill at any moment."""

import dataclasses
import importlib
import itertools

import pytest
import torch

from difftetvr.errors import FitError
from difftetvr.fitting import FitConfig, fit
from difftetvr.fitting.motion import Motion
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.refinement import Exchange, Grow, Refinement, Star
from difftetvr.fitting.trainer import Trainer
from difftetvr.mesh import TetMesh, bisect_edges

SHORT = FitConfig(
    cells=700,
    iterations=14,
    evaluate_every=0,
    device="cpu",
    exchange=Exchange(rounds=5, views=3),
    grow=Grow(rounds=4, views=3, initial=0.4),
    star=Star(views=3, initial=0.2),
)
"""Few iterations, refined in most of them. The star's epochs are 4 iterations long."""


def config_for(refine):
    return dataclasses.replace(SHORT, refine=refine, batch_views=2, motion=Motion(every=3))


def state_of(trainer):
    return trainer.checkpoint().tensors


@pytest.mark.parametrize("refine", ["exchange", "grow", "star"])
@pytest.mark.usefixtures("kernel_threads")
def test_killed_at_any_moment_it_goes_on_to_the_same_result(small_capture, tmp_path, refine):
    """From every moment the next one is the same, and so are all that follow; one run goes on to its end."""
    config = dataclasses.replace(config_for(refine), iterations=10)
    files = [tmp_path / f"{iteration}.safetensors" for iteration in range(config.steps + 1)]
    straight = Trainer(small_capture, config)
    straight.checkpoint().save(files[0])
    for file in files[1:]:
        straight.step()
        straight.checkpoint().save(file)
    assert len(straight.history.refinements) >= (1 if refine == "star" else 4)
    for file, following in itertools.pairwise(files):
        resumed, expected = Trainer.resume(small_capture, config, Checkpoint.load(file)), Checkpoint.load(following)
        resumed.step()
        assert state_of(resumed).keys() == expected.tensors.keys()
        for name, tensor in state_of(resumed).items():
            assert torch.equal(tensor, expected.tensors[name]), (file, name)
        for events in ("refinements", "moves", "loss"):
            assert getattr(resumed.history, events) == getattr(expected.history, events), (file, events)
    result = fit(small_capture, config, checkpoint=files[4], resume=True)
    for name, tensor in state_of(straight).items():
        assert torch.equal(tensor, Checkpoint.load(files[4]).tensors[name]), name
    assert result.history.refinements == straight.history.refinements
    assert result.history.moves == straight.history.moves and result.history.loss == straight.history.loss


@pytest.mark.parametrize(("cells", "rounds"), [(300, 20), pytest.param(600, None, marks=pytest.mark.slow)])
def test_moving_and_refining_beats_a_fixed_grid_of_as_many_cells(small_capture, cells, rounds):
    config = FitConfig(cells=cells, iterations=120, evaluate_every=0, device="cpu", exchange=Exchange(rounds=rounds))
    adaptive = fit(small_capture, config)
    uniform = fit(small_capture, dataclasses.replace(config, move=False, refine="none"))
    assert adaptive.mesh.num_cells <= cells
    assert adaptive.metrics["train_psnr"] > uniform.metrics["train_psnr"] + 1.0
    assert adaptive.metrics["psnr"] > uniform.metrics["psnr"] + 0.5
    rebuilt = TetMesh(adaptive.mesh.vertices, adaptive.mesh.tets)
    assert torch.equal(rebuilt.tets, adaptive.mesh.tets), "every cell is positive"
    assert adaptive.mesh.bounds().allclose(uniform.mesh.bounds())
    torch.testing.assert_close(adaptive.mesh.volumes().sum(), uniform.mesh.volumes().sum(), rtol=1e-4, atol=0.0)


def test_no_step_of_a_run_ever_leaves_an_invalid_mesh(small_capture):
    trainer = Trainer(small_capture, dataclasses.replace(SHORT, iterations=60, motion=Motion(rate=0.5, every=1)))
    for _ in range(60):
        trainer.step()
        mesh = trainer.mesh
        assert (mesh.volumes() > 0).all()
        assert (trainer.parameters.density >= 0).all()
    TetMesh(trainer.mesh.vertices, trainer.mesh.tets)
    assert trainer.history.moves.moved > 0


def test_metrics_tell_of_moves_and_of_predicted_and_achieved_gains(small_capture):
    metrics = fit(small_capture, SHORT).metrics
    assert metrics["moves"]["steps"] == 7  # every second iteration, until 95 % of the run
    assert len(metrics["refinements"]) == 5
    for record in metrics["refinements"]:
        assert record["predicted"] > 0
        assert record["achieved"] == record["error_before"] - record["error_after"]
        assert record["cells"] <= 700
    # The first ones, on a field that has learnt nothing yet, win in any case.
    assert metrics["refinements"][0]["achieved"] > 0


def test_growth_begins_small_and_ends_at_the_budget(small_capture):
    trainer = Trainer(small_capture, dataclasses.replace(SHORT, refine="grow"))
    assert trainer.mesh.num_cells < 0.5 * trainer.budget == 350
    result = fit(small_capture, dataclasses.replace(SHORT, refine="grow"))
    cells = [record.cells for record in result.history.refinements]
    assert cells == sorted(cells)
    assert 0.95 * 700 < result.mesh.num_cells <= 700


def test_a_given_grid_or_mesh_is_its_own_budget(small_capture):
    config = dataclasses.replace(SHORT, grid=(4, 4, 6))
    assert Trainer(small_capture, config).budget == 6 * 4 * 4 * 6
    mesh = Trainer(small_capture, SHORT).mesh
    assert Trainer(small_capture, FitConfig(device="cpu"), mesh).budget == mesh.num_cells
    growing = FitConfig(device="cpu", cells=5000, refine="grow")
    assert Trainer(small_capture, growing, mesh).budget == 5000


class BisectFirst:
    """A strategy of one's own: bisects the first edge once."""

    views = 2

    def initial_cells(self, budget):
        return budget

    def is_due(self, moment):
        return moment.iteration == 3

    def lets_move(self, moment):
        return moment.iteration < 5

    def refine(self, situation):
        change = bisect_edges(situation.mesh, torch.tensor([0]))
        return Refinement([change])


def test_strategies_of_ones_own(small_capture, tmp_path):
    result = fit(small_capture, SHORT, strategy=BisectFirst())
    (record,) = result.history.refinements
    assert (record.iteration, record.added, record.predicted) == (3, 1, None)
    assert result.history.moves.steps == 2
    assert result.mesh.num_vertices == Trainer(small_capture, SHORT).mesh.num_vertices + 1


def test_resuming_with_another_strategy_is_refused(small_capture, tmp_path):
    path = tmp_path / "c.safetensors"
    fit(small_capture, SHORT, strategy=BisectFirst(), checkpoint=path)
    with pytest.raises(FitError, match="refines its mesh by BisectFirst, not Exchange"):
        fit(small_capture, SHORT, checkpoint=path, resume=True)


@pytest.mark.parametrize("refine", ["exchange", "grow", "star"])
def test_meshes_in_double_precision_and_with_unused_vertices(small_capture, refine):
    lower, upper = small_capture.bounds.tolist()
    mesh = TetMesh.grid((4, 4, 6), lower, upper, dtype=torch.float64)
    spare = torch.rand(50, 3, dtype=torch.float64) * 0.1
    mesh = TetMesh(torch.cat((mesh.vertices, spare)), mesh.tets)
    result = fit(small_capture, dataclasses.replace(config_for(refine), cells=800), mesh=mesh)
    assert result.mesh.vertices.dtype == torch.float64
    assert result.history.refinements[0].added > 0
    assert result.mesh.num_cells <= 800
    TetMesh(result.mesh.vertices, result.mesh.tets)


def test_a_mesh_given_to_grow_never_shrinks(small_capture):
    config = dataclasses.replace(SHORT, cells=700, refine="grow", grid=(4, 4, 6))
    cells = [record.cells for record in fit(small_capture, config).history.refinements]
    assert min(cells) >= 0.97 * 576
    assert 0.95 * 700 < cells[-1] <= 700


def test_flips_alone_keep_the_budget(small_capture):
    config = dataclasses.replace(SHORT, exchange=Exchange(share=0.0, rounds=8, views=3))
    for record in fit(small_capture, config).history.refinements:
        assert record.cells <= 700


def test_a_device_without_double_precision_is_one_sentence(small_capture, monkeypatch):
    requirements = importlib.import_module("difftetvr.fitting.beginning.requirements")
    monkeypatch.setattr(requirements, "_WITHOUT_DOUBLES", ("cpu",))
    with pytest.raises(FitError, match=r"double precision, which cpu lacks; use the device cpu, or neither move"):
        Trainer(small_capture, SHORT)
    Trainer(small_capture, dataclasses.replace(SHORT, move=False, refine="none"))


@pytest.mark.gpu
@pytest.mark.parametrize("refine", ["exchange", "grow", "star"])
def test_cuda_moves_and_refines_like_the_cpu(small_capture, refine):
    config = dataclasses.replace(SHORT, refine=refine)
    cpu, cuda = fit(small_capture, config), fit(small_capture, dataclasses.replace(config, device="cuda"))
    assert len(cpu.history.refinements) == len(cuda.history.refinements)
    assert cuda.metrics["psnr"] == pytest.approx(cpu.metrics["psnr"], abs=0.5)
    TetMesh(cuda.mesh.vertices, cuda.mesh.tets)


def test_refinement_needs_colours_on_vertices(small_capture):
    with pytest.raises(
        FitError, match=r"^The option refine is exchange; it must be none where colours belong to cells"
    ):
        FitConfig(location="cell")
    per_cell = FitConfig(location="cell", refine="none", device="cpu")
    assert per_cell.strategy() is None
    with pytest.raises(FitError, match="field on cells cannot be refined"):
        Trainer(small_capture, per_cell, strategy=Star())


def test_options_survive_json_with_their_parts():
    config = config_for("grow")
    assert FitConfig.from_json(config.to_json()) == config
    with pytest.raises(FitError, match=r"'motion\.speed'"):
        FitConfig.from_json({"motion": {"speed": 1.0}})
    with pytest.raises(FitError, match=r"^The option exchange\.rounds is 1\.5; it must be a whole number or null\.$"):
        FitConfig.from_json({"exchange": {"rounds": 1.5}})
    with pytest.raises(FitError, match=r"^The option motion is no JSON object"):
        FitConfig.from_json({"motion": [1, 2]})


@pytest.mark.parametrize("options", [{"every": 0}, {"until": 0.0}, {"until": 1.1}, {"rate": -1.0}])
def test_motion_out_of_range_is_refused(options):
    with pytest.raises(FitError, match=rf"^The option motion\.{next(iter(options))} is "):
        Motion(**options)
