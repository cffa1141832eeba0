"""Several processes that fit together come to the same, and to what one comes to."""

import dataclasses
import os
from pathlib import Path

import pytest
import torch
from fitting import together

from difftetvr.errors import FitError
from difftetvr.fitting import Processes, fit
from difftetvr.fitting.processes import ALONE, _take_own_share
from difftetvr.fitting.trainer import Trainer

PLACES = {"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"}


@pytest.fixture(scope="module")
def capture():
    return together.CAPTURE.build()


def of_one(config):
    """The options with which one process does what two do."""
    return dataclasses.replace(config, batch_views=config.batch_views or 2)


@pytest.fixture(scope="module")
def both(capture, two_processes, tmp_path_factory):
    """What both processes of `together` found; they also went on with what one process had begun."""
    folder = tmp_path_factory.mktemp("together")
    trainer = Trainer(capture, of_one(together.EXCHANGE))
    for _ in range(4):
        trainer.step()
    trainer.checkpoint().save(folder / "begun.safetensors")
    done = two_processes(Path(together.__file__), folder)
    assert done.returncode == 0, done.stderr
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


def assert_same_bits(one, other):
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert torch.equal(tensor, other[name]), name


@pytest.mark.parametrize("name", [*together.CONFIGS, "four", "resumed", "idle"])
def test_processes_hold_the_same_bits(both, name):
    assert_same_bits(both[0][name], both[1][name])


@pytest.mark.parametrize("name", together.CONFIGS)
def test_two_processes_with_a_view_each_are_one_with_two_to_the_bit(capture, both, name):
    one = together.state_of(together.advanced(Trainer(capture, of_one(together.CONFIGS[name]))))
    assert len(one["errors"]) >= (1 if name == "star" else 2)
    assert_same_bits(one, both[0][name])


def test_more_views_than_processes_differ_by_rounding_alone(capture, both):
    config = dataclasses.replace(together.EXCHANGE, batch_views=4)
    one = together.state_of(together.advanced(Trainer(capture, config), 3))
    assert torch.equal(one["tets"], both[0]["four"]["tets"])
    for name, tensor in one.items():
        torch.testing.assert_close(both[0]["four"][name], tensor, rtol=1e-5, atol=1e-5)


def test_a_process_with_nothing_to_render_changes_nothing(capture, both):
    assert_same_bits(together.idle(capture, ALONE), both[0]["idle"])


def test_two_processes_go_on_with_what_one_has_begun(capture, both):
    result = fit(capture, of_one(together.EXCHANGE))
    for found in both:
        assert torch.equal(result.mesh.tets, found["resumed"]["tets"])
        assert torch.equal(result.mesh.vertices, found["resumed"]["vertices"])
        assert torch.equal(result.field.color, found["resumed"]["color"])
        assert {**result.metrics, "seconds": 0} == found["metrics"]


def test_an_interrupt_of_one_process_ends_all_after_the_same_iteration(both):
    assert [found["interrupted"] for found in both] == [2, 2]


def test_a_difference_between_processes_is_found(both):
    for found in both:
        assert found["disagreement"].startswith("The processes have come to different meshes after 0 iterations; ")


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 7])
def test_every_item_and_every_share_is_taken_once(count):
    items = list(range(11))
    processes = [Processes(rank, count) for rank in range(count)]
    assert sorted(item for process in processes for item in process.share(items)) == items
    shares = [share for process in processes for share in process.shares(items, 4)]
    assert sorted(map(tuple, shares)) == [(0, 4, 8), (1, 5, 9), (2, 6, 10), (3, 7)]
    assert sum(len(process.shares(items[:2], 4)) for process in processes) == 2


def test_a_process_is_alone_where_no_others_are_told_of(monkeypatch):
    for name in PLACES:
        monkeypatch.delenv(name, raising=False)
    with Processes.joined() as processes:
        assert processes == ALONE and processes.is_first and processes.speaks_first()
    for name in PLACES:
        monkeypatch.setenv(name, "0" if "RANK" in name else "1")
    with Processes.joined() as processes:
        assert processes == ALONE


@pytest.mark.parametrize("wrong", [{"RANK": "2"}, {"RANK": "one"}, {"LOCAL_RANK": "-1"}, {"WORLD_SIZE": "0"}])
def test_places_that_make_no_sense_are_one_sentence(monkeypatch, wrong):
    for name, text in (PLACES | wrong).items():
        monkeypatch.setenv(name, text)
    (name, text), *_ = wrong.items()
    with pytest.raises(FitError, match=f"says .*{name}='{text}'.*; unset them, or use torchrun"), Processes.joined():
        pass


@pytest.mark.usefixtures("kernel_threads")
@pytest.mark.parametrize(
    ("visible", "rank", "expected"),
    [(None, 1, "1"), ("2,5", 1, "5"), ("GPU-a,GPU-b", 0, "GPU-a"), ("3", 1, ""), ("", 1, "")],
)
def test_each_process_of_a_machine_takes_its_gpu_and_its_share_of_the_cores(monkeypatch, visible, rank, expected):
    from difftetvr.backend import dr

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible or "")
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    _take_own_share(rank, 10_000)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == expected
    assert dr.thread_count() == 1


def test_a_gpu_that_is_in_use_already_cannot_be_changed(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    with pytest.raises(FitError, match=r"call Processes\.joined\(\) before anything"):
        _take_own_share(1, 2)
