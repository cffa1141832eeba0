"""`viewpoint`, and `render --camera`."""

import json

import numpy as np
import pytest
from commands.helpers import fails
from PIL import Image

import difftetvr as dtv
import difftetvr.cli as cli

SEARCH = ["--search-size", "16", "--scouts", "8", "--starts", "2", "--iterations", "4", "--device", "cpu"]
SIZE = ["--width", "24", "--height", "20"]


@pytest.fixture
def simulation(tmp_path):
    mesh = dtv.TetMesh.grid((3, 3, 3))
    path = tmp_path / "flow.npz"
    np.savez(path, vertices=mesh.vertices.numpy(), tets=mesh.tets.numpy(), pressure=mesh.vertices[:, 2].numpy())
    return path


def test_it_writes_views_that_render_takes(simulation, tmp_path, capsys):
    folder = tmp_path / "views"
    assert cli.main(["viewpoint", str(simulation), "-o", str(folder), *SEARCH, *SIZE, "--background", "white"]) == 0
    out = capsys.readouterr().out
    assert "climb 1" in out and "best of 8 scouts" in out and "worst" in out
    report = json.loads((folder / "views.json").read_text())
    assert len(report["found"]) == 2 and len(report["scouts"]) == 8
    assert report["found"][0]["entropy"] >= max(view["entropy"] for view in report["scouts"])
    for name in ("best", "worst"):
        picture = tmp_path / "again.png"
        command = ["render", str(simulation), "-o", str(picture), "--camera", str(folder / f"{name}.json")]
        assert cli.main([*command, "--background", "white", "--device", "cpu"]) == 0
        again, first = (np.asarray(Image.open(file)) for file in (picture, folder / f"{name}.png"))
        assert again.shape == (20, 24, 3) and np.array_equal(again, first)
    assert Image.open(folder / "map.png").width > 100


def test_a_camera_can_be_asked_for_in_another_size(simulation, tmp_path, capsys):
    camera = dtv.Camera.look_at((0.5, -2.0, 0.8), (0.5, 0.5, 0.5), width=24, height=20)
    dtv.rendering.save_camera(tmp_path / "camera.json", camera)
    picture = tmp_path / "a.png"
    command = ["render", str(simulation), "-o", str(picture), "--camera", str(tmp_path / "camera.json")]
    assert cli.main([*command, "--width", "48"]) == 0
    assert Image.open(picture).size == (48, 40)
    assert "squeeze" in fails(capsys, *command, "--width", "48", "--height", "90")
    assert "leave out --eye" in fails(capsys, *command, "--eye", "1", "2", "3")
    assert "Cannot read the camera" in fails(capsys, *command[:-1], tmp_path / "none.json")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--fov", "190"], "--fov"),
        (["--scouts", "3"], "at least as many scouts"),
        (["--radius", "0"], "radius"),
        (["--search-size", "1"], "--search-size"),
        (["--width", "0"], "--width"),
        (["--scalar", "speed"], "speed"),
    ],
)
def test_bad_input_is_one_sentence(simulation, tmp_path, capsys, options, sentence):
    assert sentence in fails(capsys, "viewpoint", simulation, "-o", tmp_path / "views", *options)


def test_a_file_in_the_place_of_the_folder_is_one_sentence(simulation, capsys):
    assert "is a file" in fails(capsys, "viewpoint", simulation, "-o", simulation)


def test_an_interrupted_search_is_resumed(simulation, tmp_path, capsys, monkeypatch):
    from difftetvr.inverse.viewpoint.search import _Look

    folder, climb, climbs = tmp_path / "views", _Look.climb, []
    command = ["viewpoint", str(simulation), *SEARCH, *SIZE]
    assert "no unfinished search" in fails(capsys, *command, "-o", folder, "--resume")

    def interrupted(look, pose):
        climbs.append(pose)
        if len(climbs) == 2:
            raise KeyboardInterrupt
        return climb(look, pose)

    with monkeypatch.context() as patch:
        patch.setattr(_Look, "climb", interrupted)
        assert cli.main([*command, "-o", str(folder)]) == 130
    assert "with --resume goes on" in capsys.readouterr().out
    assert "--overwrite or another folder" in fails(capsys, *command, "-o", folder)
    assert "one of --resume and --overwrite" in fails(capsys, *command, "-o", folder, "--resume", "--overwrite")
    assert "has other options" in fails(capsys, *command, "--measure", "both", "-o", folder, "--resume")
    assert cli.main([*command, "-o", str(folder), "--resume"]) == 0
    assert cli.main([*command, "-o", str(tmp_path / "whole")]) == 0
    assert not (folder / "search.json").exists()
    assert (folder / "views.json").read_bytes() == (tmp_path / "whole" / "views.json").read_bytes()
