"""Means over iterations: their weights, where they begin anew, and what refinements begin with."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from hypotheses import examples
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.errors import FitError
from difftetvr.fitting import FitConfig
from difftetvr.fitting.motion import Motion
from difftetvr.fitting.positions import VertexOptimizer
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.refinement import Exchange
from difftetvr.fitting.refinement.iterate_mean import IterateMean
from difftetvr.fitting.trainer import Trainer

properties = examples(20)
counts = st.integers(1, 12)
ROUNDS = FitConfig(cells=300, iterations=16, evaluate_every=0, device="cpu", exchange=Exchange(rounds=2, views=3))


def iterates(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [{"x": torch.rand(3, 2, generator=generator, dtype=torch.float64)} for _ in range(count)]


def mean_of(some, share):
    mean = IterateMean(share)
    for iterate in some:
        mean.add(iterate)
    return mean


@properties
@given(count=counts, inverse=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_weights_are_those_of_polynomial_decay(count, inverse, seed):
    """With share 1 / (p + 1) the k-th iterate weighs like (k + p - 1)! / (k - 1)!, which is about k^p."""
    some = iterates(count, seed)
    power = inverse - 1
    weights = torch.tensor([float(torch.arange(k, k + power).prod()) for k in range(1, count + 1)]).double()
    expected = sum(w * one["x"] for w, one in zip(weights / weights.sum(), some, strict=True))
    torch.testing.assert_close(mean_of(some, 1.0 / inverse).means["x"], expected)


def test_a_share_of_nothing_keeps_nothing():
    mean = mean_of(iterates(3), 0.0)
    assert mean.means == {} and mean.state(iterates(1)[0]) == {}


def test_begins_anew_with_tensors_of_any_shape():
    mean = mean_of(iterates(4), 0.5)
    mean.begin_anew()
    assert mean.means == {}
    last = {"x": torch.full((7, 2), 3.0)}
    mean.add(last)
    assert torch.equal(mean.means["x"], last["x"])


@properties
@given(before=st.integers(0, 5), after=counts)
def test_goes_on_from_a_saved_state_to_the_bit(before, after):
    some = iterates(before + after)
    straight = mean_of(some[:before], 0.3)
    saved = {name: tensor.clone() for name, tensor in straight.state(some[0]).items()}
    resumed = IterateMean(0.3)
    resumed.restore(saved, some[0])
    for iterate in some[before:]:
        straight.add(iterate)
        resumed.add(iterate)
    assert torch.equal(straight.means["x"], resumed.means["x"])


def test_iterates_may_change_in_place_after_they_were_added():
    leaf = torch.ones(3)
    mean = mean_of([{"x": leaf}], 0.5)
    leaf += 1.0
    assert torch.equal(mean.means["x"], torch.ones(3))


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_refinement_begins_with_the_means_since_the_last_one(small_capture, monkeypatch, share):
    config = dataclasses.replace(ROUNDS, averaging=share)
    trainer, begun = Trainer(small_capture, config), []
    refine = Trainer._refine
    monkeypatch.setattr(Trainer, "_refine", lambda self, strategy: begun.append(now(self)) or refine(self, strategy))

    def now(run):
        return {name: tensor.detach().clone() for name, tensor in run._iterate_now().items()}

    mean, expected = IterateMean(share or 1.0), []
    while trainer.iteration < config.steps:
        if trainer.strategy.is_due(trainer._moment()):
            expected.append(mean.means if share else now(trainer))
            mean.begin_anew()
        trainer.step()
        mean.add(now(trainer))
    for first, second in zip(begun, expected, strict=True):
        for name, tensor in first.items():
            torch.testing.assert_close(tensor, second[name], rtol=1e-5, atol=1e-6, msg=name)
    assert len(begun) == 2


def test_a_run_of_before_there_were_means_goes_on_without(small_capture, tmp_path):
    path = tmp_path / "c.safetensors"
    trainer = Trainer(small_capture, dataclasses.replace(ROUNDS, averaging=0.0))
    for _ in range(9):
        trainer.step()
    saved = trainer.checkpoint()
    dataclasses.replace(saved, config=dataclasses.replace(saved.config, averaging=None)).save(path)
    resumed = Trainer.resume(small_capture, ROUNDS, Checkpoint.load(path))
    assert resumed.config.averaging == 0.0
    resumed.step(), trainer.step()
    for name, tensor in trainer.checkpoint().tensors.items():
        assert torch.equal(resumed.checkpoint().tensors[name], tensor), name
    with pytest.raises(FitError, match=r"averaging = 0.0, this run asks for 0.5"):
        Trainer.resume(small_capture, dataclasses.replace(ROUNDS, averaging=0.5), Checkpoint.load(path))


def test_vertices_that_stay_do_not_move_to_their_means(small_capture, monkeypatch):
    config = dataclasses.replace(ROUNDS, averaging=1.0, motion=Motion(until=0.3, every=1))
    trainer, moved = Trainer(small_capture, config), []
    monkeypatch.setattr(VertexOptimizer, "move_to", lambda self, places: moved.append(trainer.iteration))
    while trainer.iteration < config.steps:
        trainer.step()
    assert [record.iteration for record in trainer.history.refinements] == [7, 14]
    assert moved == []


def test_what_is_empty_stays_empty(small_capture, monkeypatch):
    config = dataclasses.replace(ROUNDS, averaging=1.0)
    trainer, seen = Trainer(small_capture, config), []
    even_out, middle = Trainer._even_out, small_capture.bounds.mean(0)[0]
    trainer._free_space = SimpleNamespace(
        contains=lambda places: places[:, 0] < middle, vertices_of=lambda mesh: mesh.vertices[:, 0] < middle
    )
    trainer._keep_free()

    def watched(self):
        even_out(self)
        seen.append(float(self.parameters.density.detach()[self.parameters.is_free].abs().sum()))

    monkeypatch.setattr(Trainer, "_even_out", watched)
    while trainer.iteration < config.steps:
        trainer.step()
    assert trainer.parameters.is_free.any() and trainer.parameters.density.any()
    assert seen == [0.0, 0.0]


def test_nothing_is_kept_where_nothing_is_refined(small_capture):
    trainer = Trainer(small_capture, dataclasses.replace(ROUNDS, refine="none"))
    trainer.step()
    assert not any(name.startswith("mean") for name in trainer.checkpoint().tensors)
