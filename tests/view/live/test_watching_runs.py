"""A run that is looked at: the same bits, pictures of its mesh, pauses, and another number of cells."""

import dataclasses
import os
import signal
import threading

import pytest
import torch

import difftetvr as dtv
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.refinement import Exchange
from difftetvr.view.live.contents import MeshContent
from difftetvr.view.live.scene import Scene
from difftetvr.view.live.server import Listening
from difftetvr.view.live.settings import Settings
from difftetvr.view.live.watching import RunWatcher

pytest.importorskip("viser")
CONFIG = dtv.FitConfig(cells=500, iterations=12, device="cpu", exchange=Exchange(rounds=4, views=3))


@pytest.fixture(scope="module")
def capture():
    return dtv.VolumeCapture(views=8, width=20, height=20).build()


@pytest.fixture(scope="module")
def plain(capture):
    return dtv.fit(capture, CONFIG)


def watched(capture, folder, at_iteration, config=CONFIG, checkpoint=None):
    """The result of a run that is looked at through one window, and what was shown there and said."""
    shown, said = [], []

    def scene_of(progress):
        content = MeshContent(progress.mesh, progress.field)
        camera = dtv.Camera.look_at((1.2, -1.3, 0.8), (0.0, 0.0, 0.0), (0, 0, 1), 0.8, 40, 30)
        return Scene("run", content, content.bounds, camera, (0.0, 0.0, 1.0), Settings())

    with RunWatcher(Listening(folder / "saved", port=0), scene_of, said.append) as watcher:

        def look(progress):
            watcher(progress)
            if watcher.shown is None:
                return
            server, panel = watcher.shown
            if progress.iteration == 1:
                studio = server.studio
                window = studio.open(lambda picture, is_full: shown.append((progress.iteration, picture.pixels)))
                studio.look(window, studio.scene.start)
                while studio.work(0.3):
                    pass
            at_iteration(progress, server, panel)

        result = dtv.fit(capture, config, checkpoint=checkpoint, on_progress=look)
    assert not (folder / "saved").exists()
    return result, shown, said


def test_a_run_is_the_same_whoever_looks(capture, plain, tmp_path):
    result, shown, said = watched(capture, tmp_path, lambda progress, server, panel: None)
    assert torch.equal(result.mesh.vertices, plain.mesh.vertices) and torch.equal(result.field.color, plain.field.color)
    assert len(said) == 1 and "only this machine can reach it." in said[0]
    assert shown[-1][1].shape == (30, 40, 3) and shown[-1][1].std() > 5


def test_a_run_waits_while_it_pauses_and_shows_its_mesh_as_it_is(capture, plain, tmp_path):
    seen = {}

    def hold(progress, server, panel):
        if progress.iteration == 6:
            panel.hold(True)
        if progress.iteration == 7:  # after the pause
            seen["mesh"] = server.studio.scene.content.mesh.vertices.clone()
            seen["there"] = progress.mesh.vertices.clone()

    def let_go(progress, server, panel):
        hold(progress, server, panel)
        if progress.iteration == 6:
            threading.Timer(0.5, lambda: panel.hold(False)).start()

    result, _, _ = watched(capture, tmp_path, let_go)
    assert torch.equal(seen["mesh"], seen["there"])  # taken when the pause began, after iteration 7
    assert torch.equal(result.mesh.vertices, plain.mesh.vertices)


def test_a_picture_that_cannot_be_drawn_ends_the_viewer_and_not_the_run(capture, plain, tmp_path, monkeypatch):
    def fail(self, camera, settings):
        raise RuntimeError("no such thing")

    def spoil(progress, server, panel):
        if progress.iteration == 4:
            monkeypatch.setattr(MeshContent, "seen_by", fail)
            panel.hold(True)

    result, _, said = watched(capture, tmp_path, spoil)
    assert said[-1] == "The viewer has ended, the run goes on without it: no such thing"
    assert torch.equal(result.mesh.vertices, plain.mesh.vertices)


def test_an_interrupt_ends_a_pause_and_saves_the_run(capture, plain, tmp_path):
    def hold(progress, server, panel):
        if progress.iteration == 6:
            panel.hold(True)
            threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()

    path = tmp_path / "a.safetensors"
    with pytest.raises(KeyboardInterrupt):
        watched(capture, tmp_path, hold, checkpoint=path)
    assert Checkpoint.load(path).iteration == 7
    resumed = dtv.fit(capture, CONFIG, checkpoint=path, resume=True)
    assert torch.equal(resumed.mesh.vertices, plain.mesh.vertices)


def test_a_run_is_given_more_cells(capture, plain, tmp_path):
    def ask(progress, server, panel):
        if progress.iteration == 2:
            panel.ask(900)

    result, _, _ = watched(capture, tmp_path, ask)
    assert result.history.budgets == [(3, 900)] and result.mesh.num_cells > 1.2 * plain.mesh.num_cells


def test_a_mesh_that_is_not_refined_has_no_budget_to_ask_for(capture, tmp_path):
    budgets = []

    def look(progress, server, panel):
        budgets.append(progress.budget)
        assert panel.take_budget() is None

    watched(capture, tmp_path, look, dataclasses.replace(CONFIG, refine="none", iterations=2))
    assert budgets == [None, None]
