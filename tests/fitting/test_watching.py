"""Whoever watches a run: mesh, field and pictures on demand, and what TensorBoard is given."""

import dataclasses
import io
import os
import signal
import time
import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from difftetvr.errors import FitError
from difftetvr.fitting import FitConfig, TensorBoardLogger, fit
from difftetvr.fitting.gradients import ViewGradients
from difftetvr.fitting.records import tensorboard
from difftetvr.fitting.records.evaluation import rendered_image, true_image
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.fitting.refinement import Exchange

SMALL = FitConfig(cells=500, iterations=20, evaluate_every=10, device="cpu", exchange=Exchange(rounds=2, views=3))


@pytest.fixture(scope="module")
def reference(small_capture):
    return fit(small_capture, SMALL)


def events_in(folder):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = events.EventAccumulator(
        str(folder), size_guidance={events.IMAGES: 0, events.SCALARS: 0, events.HISTOGRAMS: 0}
    )
    return found.Reload()


def same(a, b):
    return all(
        torch.equal(x, y)
        for x, y in ((a.mesh.vertices, b.mesh.vertices), (a.mesh.tets, b.mesh.tets), (a.field.density, b.field.density))
    )


def test_progress_shows_what_there_is(small_capture, reference):
    seen = []

    def look(progress):
        if progress.iteration in (7, 20):
            learned, held_out = progress.picture(), progress.picture(progress.glanced_views[0])
            seen.append((progress, progress.mesh, progress.field, learned, held_out))

    result = fit(small_capture, SMALL, on_progress=look)
    assert same(result, reference)  # looking changes nothing
    (early, mesh, field, learned, held_out), (late, last_mesh, last_field, _, last) = seen
    assert early.glanced_at is None and late.glanced_at == 20
    assert learned.view in small_capture.train_indices.tolist() and held_out.view in small_capture.test_indices.tolist()
    assert torch.equal(learned.rendered, rendered_image(mesh, field, small_capture, learned.view))
    assert torch.equal(held_out.truth, true_image(small_capture, held_out.view))
    assert not field.density.requires_grad and not mesh.vertices.requires_grad
    assert torch.equal(last_mesh.vertices, result.mesh.vertices) and torch.equal(last_field.color, result.field.color)
    assert not torch.equal(last.rendered, held_out.rendered)
    with pytest.raises(FitError, match="no view 99; name one of 0 to 9"):
        late.picture(99)


def test_the_picture_is_of_the_view_that_was_learned_from_last(small_capture, monkeypatch):
    accumulate, learned, seen = ViewGradients._accumulate, [], []

    def noting(self, mesh, view, *rest):
        learned.append(view)
        return accumulate(self, mesh, view, *rest)

    monkeypatch.setattr(ViewGradients, "_accumulate", noting)
    config = dataclasses.replace(SMALL, iterations=11, batch_views=2)
    fit(small_capture, config, on_progress=lambda progress: seen.append(progress.picture().view))
    assert seen == learned[1::2] and len(set(seen)) > 2


def test_tensorboard_gets_curves_pictures_and_quality(small_capture, reference, tmp_path):
    pictures, qualities = {}, []

    def look(progress):
        if progress.glanced_at == progress.iteration:
            pictures[progress.iteration] = progress.picture(progress.glanced_views[0])
            qualities.append(progress.mesh.quality())

    with TensorBoardLogger(tmp_path / "logs") as logger:

        def both(progress):
            logger(progress)
            look(progress)

        result = fit(small_capture, SMALL, on_progress=both)
    assert same(result, reference)
    events = events_in(tmp_path / "logs")
    losses = {event.step: event.value for event in events.Scalars("train/loss")}
    assert list(losses) == [10, 20]
    window = len(small_capture.train_indices) // result.config.batch
    assert losses[20] == pytest.approx(sum(result.history.loss[-window:]) / window, rel=1e-6)
    held_out = [(event.step, event.value) for event in events.Scalars("held_out/psnr")]
    assert held_out == [(at, pytest.approx(psnr, rel=1e-6)) for at, psnr in result.history.evaluations]
    gains = [(event.step, event.value) for event in events.Scalars("refinement/achieved")]
    assert gains == [(r.iteration, pytest.approx(r.achieved, rel=1e-5)) for r in result.history.refinements]
    shown = events.Images(f"held_out/view_{small_capture.test_indices[0]}")
    assert [event.step for event in shown] == [10, 20]
    for event in shown:
        decoded = np.asarray(Image.open(io.BytesIO(event.encoded_image_string)), dtype=np.float32) / 255
        picture = pictures[event.step]
        expected = torch.cat((picture.truth, picture.rendered), 1).clamp(0, 1).numpy()
        assert np.abs(decoded - expected).max() <= 1 / 255 + 1e-6
    histograms = events.Histograms("mesh/quality")
    assert [event.step for event in histograms] == [10, 20]
    for event, quality in zip(histograms, qualities, strict=True):
        assert event.histogram_value.num == len(quality)
        assert event.histogram_value.sum == pytest.approx(float(quality.double().sum()), rel=1e-5)


def test_a_resumed_run_replaces_what_was_logged_beyond_its_checkpoint(small_capture, tmp_path):
    pytest.importorskip("tensorboard")
    checkpoint = tmp_path / "checkpoint.safetensors"

    def run(iterations, resume):
        config = FitConfig.from_json({**SMALL.to_json(), "iterations": iterations})
        with TensorBoardLogger(tmp_path / "logs") as logger:
            fit(small_capture, config, checkpoint=checkpoint, resume=resume, on_progress=logger)

    run(20, False)
    saved = checkpoint.read_bytes()
    run(40, True)
    checkpoint.write_bytes(saved)
    run(40, True)
    events = events_in(tmp_path / "logs")
    assert [event.step for event in events.Scalars("train/loss")] == [10, 20, 30, 40]


def test_logs_that_cannot_be_written_do_not_end_a_run(small_capture, reference, tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    with TensorBoardLogger(tmp_path / "logs") as logger:

        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(TensorBoardLogger, "_add_curves", staticmethod(full))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", tensorboard.LogWarning)
            result = fit(small_capture, SMALL, on_progress=logger)
    assert same(result, reference)
    told = [str(warning.message) for warning in caught if warning.category is tensorboard.LogWarning]
    assert told == [
        f"Logs cannot be written into {tmp_path / 'logs'} any more (No space left on device); the run goes on without."
    ]


def test_without_tensorboard_a_sentence_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setattr(tensorboard.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FitError, match=r"not installed; pip install 'difftetvr\[tensorboard\]'"):
        TensorBoardLogger(tmp_path)


def test_a_file_in_the_place_of_logs_is_refused(tmp_path):
    folder = RunFolder(tmp_path)
    folder.logs.touch()
    with pytest.raises(FitError, match="is a file where the folder of logs should be"):
        folder.require_free(resume=False, overwrite=False)


GROWING = dataclasses.replace(SMALL, cells=600, iterations=16, exchange=Exchange(rounds=8, views=3))


def cells_of(result):
    return [record.cells for record in result.history.refinements]


def test_a_budget_that_is_steered_counts_from_the_next_refinement_on(small_capture, tmp_path):
    plain = fit(small_capture, GROWING)
    assert plain.history.budgets == [] and "budgets" not in plain.metrics

    def steer(progress):
        assert progress.budget == (900 if progress.iteration > 5 else 600)
        if progress.iteration == 5:
            progress.steer(900)
            progress.steer(900)

    more = fit(small_capture, GROWING, on_progress=steer)
    assert more.history.budgets == [(5, 900)] and more.metrics["budgets"] == [(5, 900)]
    before = [record.cells for record in more.history.refinements if record.iteration < 5]
    assert before == cells_of(plain)[: len(before)] and before
    assert cells_of(more)[-1] > 1.2 * cells_of(plain)[-1] and cells_of(more)[-1] <= 900


def test_a_run_goes_on_with_the_budget_that_it_was_steered_to(small_capture, tmp_path):
    def steer(progress):
        if progress.iteration == 5:
            progress.steer(900)

    def break_off(progress):
        steer(progress)
        if progress.iteration == 9:
            raise RuntimeError("killed")

    saved = dataclasses.replace(GROWING, checkpoint_seconds=0.0)
    whole = fit(small_capture, saved, on_progress=steer)
    with pytest.raises(RuntimeError, match="killed"):
        fit(small_capture, saved, checkpoint=tmp_path / "a.safetensors", on_progress=break_off)
    resumed = fit(small_capture, saved, checkpoint=tmp_path / "a.safetensors", resume=True)
    assert resumed.history.budgets == [(5, 900)] and same(resumed, whole)


def test_what_cannot_be_steered_is_said(small_capture):
    def wrong(progress):
        for cells, reason in ((0, "at least 1"), (2.5, "number of cells"), ("many", "number of cells")):
            with pytest.raises(FitError, match=reason):
                progress.steer(cells)

    fit(small_capture, dataclasses.replace(SMALL, iterations=1), on_progress=wrong)

    def fixed(progress):
        assert progress.budget is None
        with pytest.raises(FitError, match="refines no mesh"):
            progress.steer(900)

    fit(small_capture, dataclasses.replace(SMALL, iterations=1, refine="none"), on_progress=fixed)


def test_who_holds_a_run_up_is_told_of_an_interrupt(small_capture, tmp_path):
    held = []

    def hold(progress):
        if progress.iteration == 2:
            end = time.monotonic() + 30.0
            os.kill(os.getpid(), signal.SIGINT)
            while not progress.is_interrupted() and time.monotonic() < end:
                time.sleep(0.01)
            held.append(progress.is_interrupted())
        else:
            assert not progress.is_interrupted()

    with pytest.raises(KeyboardInterrupt):
        fit(small_capture, SMALL, checkpoint=tmp_path / "a.safetensors", on_progress=hold)
    assert held == [True]
    resumed = fit(small_capture, SMALL, checkpoint=tmp_path / "a.safetensors", resume=True)
    assert same(resumed, fit(small_capture, SMALL))
