"""The loop: it learns, repeats itself, and goes on where it was stopped."""

import dataclasses
import json
import re
import signal

import pytest
import torch

from difftetvr.capture import Capture
from difftetvr.errors import BackendError, CaptureError, FitError
from difftetvr.fitting import FitConfig, fit
from difftetvr.fitting.parameters import FieldParameters
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.records.evaluation import evaluate, true_image
from difftetvr.fitting.refinement import Exchange, Grow
from difftetvr.fitting.trainer import Trainer
from difftetvr.mesh import TetMesh

FEW_ROUNDS = Exchange(rounds=5, views=3)
"""A round costs as much as ten other iterations."""

SMALL = FitConfig(cells=2_000, iterations=40, evaluate_every=20, device="cpu", exchange=FEW_ROUNDS)

TINY = FitConfig(cells=500, iterations=3, device="cpu", exchange=FEW_ROUNDS)


def assert_same_result(a, b):
    """To the last bit, in all but the time it took."""
    assert torch.equal(a.mesh.vertices, b.mesh.vertices)
    assert torch.equal(a.mesh.tets, b.mesh.tets)
    assert torch.equal(a.field.color, b.field.color)
    assert torch.equal(a.field.density, b.field.density)
    assert a.history.loss == b.history.loss
    assert a.history.evaluations == b.history.evaluations
    assert a.history.refinements == b.history.refinements
    assert a.history.moves == b.history.moves
    assert {**a.metrics, "seconds": 0} == {**b.metrics, "seconds": 0}


@pytest.fixture(scope="module")
def reference(small_capture):
    return fit(small_capture, SMALL)


def test_fit_learns_to_show_held_out_views(small_capture, reference):
    start = Trainer(small_capture, SMALL)
    before = evaluate(start.mesh, start.parameters.detached_field(), small_capture, [2, 7]).mean_psnr
    loss = reference.history.loss
    assert sum(loss[-8:]) < 0.6 * sum(loss[:8])
    assert reference.metrics["psnr"] > before + 3
    assert reference.metrics["ssim"] > 0.5
    assert reference.metrics["views"] == [2, 7]
    assert reference.metrics["cells"] == reference.mesh.num_cells
    assert reference.metrics["iterations"] == 40
    assert [i for i, _ in reference.history.evaluations] == [20, 40]


def test_values_stay_valid_and_empty_space_becomes_exactly_empty(reference):
    color, density = reference.field.color, reference.field.density
    assert ((color >= 0) & (color <= 1)).all()
    assert (density >= 0).all()
    assert (density == 0).float().mean() > 0.1
    assert not color.requires_grad


@pytest.mark.usefixtures("kernel_threads")
def test_interrupted_run_goes_on_to_the_same_result(small_capture, reference, tmp_path):
    handler = signal.getsignal(signal.SIGINT)  # ignored where the tests run in the background
    path = tmp_path / "checkpoint.safetensors"

    def interrupt(progress):
        if progress.iteration == 13:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        fit(small_capture, SMALL, checkpoint=path, on_progress=interrupt)
    stopped = Checkpoint.load(path)
    assert stopped.iteration == 13
    seen = []
    result = fit(small_capture, SMALL, checkpoint=path, resume=True, on_progress=lambda p: seen.append(p.iteration))
    assert seen[0] == 14
    assert result.history.loss[:13] == stopped.history.loss
    assert_same_result(result, reference)
    assert signal.getsignal(signal.SIGINT) is handler


def test_killed_run_goes_on_from_its_last_checkpoint(small_capture, reference, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    kept = tmp_path / "kept.safetensors"

    def keep(progress):
        if progress.iteration == 22:
            path.rename(kept)

    config = dataclasses.replace(SMALL, checkpoint_seconds=0.0)
    fit(small_capture, config, checkpoint=path, on_progress=keep)
    assert Checkpoint.load(kept).iteration == 21
    assert_same_result(fit(small_capture, SMALL, checkpoint=kept, resume=True), reference)


def test_restored_trainer_is_equal_to_the_bit(small_capture, tmp_path):
    trainer = Trainer(small_capture, SMALL)
    for _ in range(3):
        trainer.step()
    trainer.checkpoint().save(tmp_path / "c.safetensors")
    restored = Trainer.resume(small_capture, SMALL, Checkpoint.load(tmp_path / "c.safetensors"))
    before, after = trainer.checkpoint(), restored.checkpoint()
    assert before.tensors.keys() == after.tensors.keys()
    assert {"color.exp_avg", "density.exp_avg_sq", "color.step"} <= before.tensors.keys()
    for name, tensor in before.tensors.items():
        assert torch.equal(tensor, after.tensors[name]), name
    assert before.history == after.history


def test_resuming_a_finished_run_changes_nothing(small_capture, tmp_path):
    config = FitConfig(cells=500, iterations=3, device="cpu")
    path = tmp_path / "c.safetensors"
    first = fit(small_capture, config, checkpoint=path)
    again = fit(small_capture, config, checkpoint=path, resume=True)
    assert torch.equal(first.field.color, again.field.color)
    assert first.metrics == again.metrics


def test_a_finished_run_goes_on_at_the_rates_of_a_longer_one(small_capture, tmp_path, monkeypatch):
    config, path = FitConfig(cells=500, iterations=3, refine="none", device="cpu"), tmp_path / "c.safetensors"
    first = fit(small_capture, config, checkpoint=path)
    step, rates = FieldParameters.step, []
    monkeypatch.setattr(FieldParameters, "step", lambda self, rate, haze: rates.append(rate) or step(self, rate, haze))
    longer = dataclasses.replace(config, iterations=5)
    second = fit(small_capture, longer, checkpoint=path, resume=True)
    assert rates == [longer.rate_at(3), longer.rate_at(4)] and rates[0] > config.rate_at(2)
    assert second.history.loss[:3] == first.history.loss and len(second.history.loss) == 5
    with pytest.raises(FitError, match="has done 5 iterations already, this one is to have 4"):
        fit(small_capture, dataclasses.replace(config, iterations=4), checkpoint=path, resume=True)


def test_resume_refuses_other_options_and_other_images(small_capture, tmp_path):
    config = FitConfig(cells=500, iterations=3, device="cpu")
    path = tmp_path / "c.safetensors"
    fit(small_capture, config, checkpoint=path)
    with pytest.raises(FitError, match=r"rate = 0\.03.*0\.5"):
        fit(small_capture, FitConfig(cells=500, iterations=3, rate=0.5), checkpoint=path, resume=True)
    darker = Capture(
        small_capture.cameras, small_capture.images / 2, None, small_capture.test, small_capture.bounds, "darker", 25.0
    )
    with pytest.raises(FitError, match="mean_radiance"):
        fit(darker, config, checkpoint=path, resume=True)


@pytest.fixture(scope="module")
def begun(small_capture):
    """A run of few cells after two steps."""
    trainer = Trainer(small_capture, TINY)
    trainer.step()
    trainer.step()
    return trainer


def damaged(path):
    return pytest.raises(FitError, match=rf"^The checkpoint {path} cannot be read \(.+\); start anew, [^\n]+\.$")


def test_any_flipped_bit_is_found(small_capture, begun, tmp_path):
    path = tmp_path / "c.safetensors"
    begun.checkpoint().save(path)
    content = path.read_bytes()
    header = 8 + int.from_bytes(content[:8], "little")
    places = [*range(0, header, 23), *range(header, len(content), 997), len(content) - 1]
    for place in places:
        path.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        with pytest.raises(FitError, match=re.escape(str(path))):
            Checkpoint.load(path)
    path.write_bytes(content)
    assert Checkpoint.load(path).history == begun.history


STORED = ("vertices", "tets", "color", "density", "color.exp_avg", "density.exp_avg_sq", "density.step")
REPLACED = {
    "vertices": torch.zeros(140, 2),
    "tets": torch.zeros(7, 4, dtype=torch.int32),
    "color": torch.zeros(3, 140),
    "density": torch.zeros(140, dtype=torch.float64),
    "color.exp_avg": torch.zeros(139, 3),
    "density.exp_avg_sq": torch.zeros(140, 1),
    "density.step": torch.zeros(2),
}


@pytest.mark.parametrize(("name", "tensor"), [*((name, None) for name in STORED), *REPLACED.items()])
def test_checkpoints_of_other_contents_are_refused(small_capture, begun, tmp_path, name, tensor):
    """Intact files, as another program might write them."""
    checkpoint = begun.checkpoint()
    del checkpoint.tensors[name]
    if tensor is not None:
        checkpoint.tensors[name] = tensor
    path = tmp_path / "c.safetensors"
    checkpoint.save(path)
    with damaged(path):
        fit(small_capture, TINY, checkpoint=path, resume=True)


@pytest.mark.parametrize(
    "change",
    [
        {"config": [1, 2]},
        {"config": {"cells": "many"}},
        {"config": {"speed": 3}},
        {"capture": 3},
        {"iteration": "two"},
        {"iteration": 1},
        {"iteration": 10**9},
        {"evaluations": [3]},
        {"seconds": None},
    ],
)
def test_checkpoints_of_another_state_are_refused(begun, tmp_path, monkeypatch, change):
    path = tmp_path / "c.safetensors"
    dumps = json.dumps
    monkeypatch.setattr(json, "dumps", lambda state: dumps(state | change))
    begun.checkpoint().save(path)
    with damaged(path):
        Checkpoint.load(path)


def test_checkpoint_of_another_version(begun, tmp_path, monkeypatch):
    path = tmp_path / "c.safetensors"
    dumps = json.dumps
    monkeypatch.setattr(json, "dumps", lambda state: dumps(state | {"version": 1}))
    begun.checkpoint().save(path)
    with pytest.raises(FitError, match="has version 1, this program reads version 6; start anew"):
        Checkpoint.load(path)


@pytest.mark.parametrize("resume", [False, True])
def test_folder_in_place_of_the_checkpoint(small_capture, tmp_path, resume):
    with pytest.raises(FitError, match=f"{tmp_path} is a folder where the checkpoint should be"):
        fit(small_capture, TINY, checkpoint=tmp_path, resume=resume)


def test_a_checkpoint_that_cannot_be_written_is_found_before_the_first_iteration(small_capture, tmp_path):
    with pytest.raises(FitError, match="create the folder first"):
        fit(
            small_capture,
            TINY,
            checkpoint=tmp_path / "missing" / "c.safetensors",
            on_progress=lambda _: pytest.fail("the work has begun"),
        )
    assert not list(tmp_path.iterdir())


def test_the_first_checkpoint_is_as_large_as_all_others(small_capture, tmp_path):
    path = tmp_path / "c.safetensors"
    sizes = []
    config = dataclasses.replace(TINY, checkpoint_seconds=0.0, refine="none")
    fit(small_capture, config, checkpoint=path, on_progress=lambda _: sizes.append(path.stat().st_size))
    assert len(sizes) == 3
    assert sizes[0] == pytest.approx(path.stat().st_size, rel=0.02)


@pytest.mark.parametrize("content", [b"", b"nonsense", b"\x08" + bytes(7) + b"{}      "])
def test_damaged_checkpoint_is_one_sentence(small_capture, tmp_path, content):
    (tmp_path / "c.safetensors").write_bytes(content)
    with pytest.raises(FitError, match=r"c\.safetensors cannot be read"):
        fit(small_capture, SMALL, checkpoint=tmp_path / "c.safetensors", resume=True)


@pytest.mark.parametrize(
    "options",
    [
        {"loss": "l1"},
        {"location": "cell", "refine": "none"},
        {"refine": "grow"},
        {"refine": "star", "move": False},
        {"background": "random"},
        {"background": "white", "batch_views": 3},
        {"grid": (3, 4, 5), "haze_penalty": 0.0, "refine": "none"},
    ],
)
def test_options_learn_too(small_capture, options):
    rounds = {"exchange": FEW_ROUNDS, "grow": Grow(rounds=5, views=3)}
    config = FitConfig(cells=1_000, iterations=16, evaluate_every=0, device="cpu", **rounds, **options)
    result = fit(small_capture, config)
    assert sum(result.history.loss[-4:]) < 0.8 * sum(result.history.loss[:4])
    assert result.field.location_on(result.mesh) == config.location
    if config.grid:
        assert result.metrics["cells"] == 6 * 3 * 4 * 5


@pytest.mark.parametrize("penalty", [0.0, 0.01])
def test_haze_that_no_image_sees_decays(penalty):
    """Densities without any gradient stay as they are, unless the penalty pulls them to zero; seen ones win."""
    mesh = TetMesh.grid((2, 2, 2))
    parameters = FieldParameters(mesh, FitConfig(initial_density=0.3), torch.full((mesh.num_vertices,), 25.0))
    for _ in range(60):
        parameters.zero_grad()
        (-(parameters.density[:3].sum())).backward()
        parameters.step(0.01, penalty)
    density = parameters.density.detach()
    assert (density[:3] > 0.8).all()
    assert (density[3:] == (0.3 if penalty == 0 else 0.0)).all()


def test_backgrounds_need_alpha(small_capture):
    opaque = Capture(
        small_capture.cameras, small_capture.images, None, small_capture.test, small_capture.bounds, "photos", 25.0
    )
    with pytest.raises(CaptureError, match="'photos' have no alpha"):
        fit(opaque, FitConfig(background="random"))
    with pytest.raises(CaptureError, match="no alpha"):
        true_image(opaque, 0, (1.0, 1.0, 1.0))


def test_truth_over_a_background(small_capture):
    over = true_image(small_capture, 3, (1.0, 0.5, 0.0))
    clear = small_capture.alphas[3] == 0
    assert clear.any()
    assert torch.equal(over[clear], torch.tensor([1.0, 0.5, 0.0]).expand(int(clear.sum()), 3))
    assert torch.equal(over[..., 2], small_capture.images[3][..., 2])


@pytest.mark.parametrize("device", ["quantum", "hip", "cuda:77", "xpu:77"])
def test_unknown_device_is_one_short_sentence(small_capture, device):
    """PyTorch's own answer to some of them is its registry, of thousands of characters."""
    with pytest.raises(FitError, match=f"device '{device}' cannot be used .*use .*cpu") as error:
        fit(small_capture, FitConfig(device=device))
    assert len(str(error.value)) < 200


def test_device_without_a_back_end(small_capture):
    with pytest.raises(BackendError, match=r"'meta' has no Dr\.Jit back end"):
        fit(small_capture, FitConfig(device="meta"))


def test_capture_without_held_out_views(small_capture):
    everything = Capture(
        small_capture.cameras,
        small_capture.images,
        small_capture.alphas,
        torch.zeros(10, dtype=torch.bool),
        small_capture.bounds,
        "all",
        25.0,
    )
    metrics = fit(everything, FitConfig(cells=500, iterations=2, evaluate_every=1, device="cpu")).metrics
    assert metrics["psnr"] is None
    assert metrics["train_psnr"] > 5


def test_glances_tell_the_psnr_alone(small_capture, monkeypatch):
    trainer = Trainer(small_capture, SMALL)
    whole = trainer.evaluate(trainer._glanced_views())
    assert len(whole.ssim) == len(whole.psnr) > 0
    monkeypatch.setattr("difftetvr.fitting.records.evaluation.ssim", lambda *_: pytest.fail("SSIM is of no use here"))
    trainer.glance()
    assert trainer.history.evaluations == [(0, whole.mean_psnr)]
