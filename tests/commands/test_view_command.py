"""`view`: what it shows of whatever it is given, who can look, and what it refuses."""

import importlib.util

import numpy as np
import pytest
import torch
from commands.helpers import fails

import difftetvr as dtv
import difftetvr.cli as cli
from difftetvr.view.live.server import LiveServer

pytest.importorskip("viser")
SERVED = ["--device", "cpu", "--port", "0"]


@pytest.fixture
def scene_of(monkeypatch, capsys):
    """The scene that a command shows, and what it prints; it ends at once, as by Ctrl-C."""
    found = []

    def serve(server, is_over=None):
        found.append(server.studio.scene)
        raise KeyboardInterrupt

    monkeypatch.setattr(LiveServer, "serve", serve)

    def scene_of(*args):
        capsys.readouterr()
        assert cli.main(["view", *map(str, args), *SERVED]) == 130
        return found.pop(), capsys.readouterr().out

    return scene_of


def test_a_run_is_shown_with_its_cameras(run, scene_of, tmp_path):
    folder = tmp_path / "saved"
    scene, out = scene_of(run, "-o", folder)
    beside, _ = scene_of(run / "model.vtu", "-o", folder)
    assert scene.content.mesh.num_cells == beside.content.mesh.num_cells > 100
    assert len(scene.views.cameras) == 10 and scene.views.capture is None and "error" not in scene.modes
    assert "only this machine can reach it." in out and f"What is saved goes to {folder}" in out.replace("\n", "")
    assert not folder.exists()  # nothing has been saved


def test_photographs_are_shown_with_the_model_and_without(scene_of, tmp_path):
    capture = dtv.load_capture("tooth", views=9, width=20, height=16)
    capture.save(tmp_path / "views.npz")
    alone, _ = scene_of(tmp_path / "views.npz", "-o", tmp_path)
    assert alone.content is None and len(alone.views.cameras) == 9 and alone.modes == ("color",)
    mesh = dtv.TetMesh.grid((2, 2, 2))
    dtv.save(tmp_path / "a.vtu", mesh, dtv.Field(torch.rand(27, 3), torch.rand(27)))
    both, _ = scene_of(tmp_path / "a.vtu", "--capture", tmp_path / "views.npz", "--background", "white")
    assert both.views.capture is not None and "error" in both.modes and both.settings.background == (1.0, 1.0, 1.0)
    assert torch.allclose(both.bounds, capture.bounds.double())


def test_scalars_and_volumes_have_a_look(scene_of, tmp_path):
    mesh = dtv.TetMesh.grid((3, 3, 3))
    points = mesh.vertices.numpy()
    np.savez(tmp_path / "flow.npz", vertices=points, tets=mesh.tets.numpy(), pressure=points[:, 2])
    flow, _ = scene_of(tmp_path / "flow.npz", "--value-range", "0", "0.5", "-o", tmp_path)
    look = flow.settings.look
    assert flow.scalar == "pressure" and look.value_range == (0.0, 0.5) and look.density > 0
    dtv.rendering.save_camera(tmp_path / "c.json", flow.start.with_size(30, 20))
    seen_so, _ = scene_of(tmp_path / "flow.npz", "--camera", tmp_path / "c.json")
    assert (seen_so.start.width, seen_so.start.fx) == (30, flow.start.with_size(30, 20).fx)
    tooth, _ = scene_of("tooth", "-o", tmp_path)
    assert tooth.settings.look.value_range == (0.0, 255.0) and tooth.modes == ("color", "opacity")
    middle = tooth.content.seen_by(tooth.start.with_size(24, 24), tooth.settings)
    assert 0.05 < float(middle.alpha.mean()) < 0.8


def test_what_is_no_good_is_refused_before_anything_is_served(capsys, tmp_path, monkeypatch):
    assert "--port is 70000" in fails(capsys, "view", "tooth", "--port", "70000")
    assert "nothing.vtu" in fails(capsys, "view", tmp_path / "nothing.vtu")
    assert "--scalar says nothing" in fails(capsys, "view", "tooth", "--scalar", "a", "-o", tmp_path)
    (tmp_path / "file").write_text("")
    assert "Cannot write" in fails(capsys, "view", "tooth", "-o", tmp_path / "file" / "folder")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "pip install 'difftetvr[view]' installs it." in fails(capsys, "view", "tooth")
