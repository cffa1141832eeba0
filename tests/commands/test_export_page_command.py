"""`export` to a page: what it says, which scalar it shows, and what is refused."""

from __future__ import annotations

import base64
import json
import re
import zlib
from pathlib import Path

import pytest
import torch
from commands.helpers import fails

import difftetvr.cli as cli
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import save
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, save_camera

MESH = TetMesh.grid((2, 2, 2), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
COUNT = MESH.num_vertices


@pytest.fixture
def model(tmp_path: Path) -> Path:
    folder = tmp_path / "hot dog"
    folder.mkdir()
    save(folder / "model.vtu", MESH, Field(torch.rand(COUNT, 3), torch.rand(COUNT)))
    return folder / "model.vtu"


@pytest.fixture
def simulation(tmp_path: Path) -> Path:
    save(tmp_path / "s.vtu", MESH, point_data={"T": 300.0 + torch.rand(COUNT), "v": torch.rand(COUNT, 3)})
    return tmp_path / "s.vtu"


def exported(capsys, *args) -> tuple[str, dict]:
    """What it prints, and the header of the page."""
    capsys.readouterr()
    assert cli.main(["export", *map(str, args)]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    page = Path(args[1]).read_text(encoding="utf-8")
    packed = re.search(r'<script id="volume" type="text/plain">(.*?)</script>', page, re.DOTALL)[1]
    content = zlib.decompress(base64.b64decode(packed))
    return printed.out, json.loads(content[4 : 4 + int.from_bytes(content[:4], "little")])


def test_a_model(model, tmp_path, capsys):
    out = tmp_path / "page.html"
    printed, header = exported(capsys, model, out)
    assert re.fullmatch(rf"Wrote {re.escape(str(out))} \(48 cells, 0\.0\d+ MB\)\n", printed)
    assert header["title"] == "hot dog" and header["kind"] == "color" and header["background"] == [0, 0, 0]
    camera = Camera.look_at((0.0, -9.0, 0.0), (0.0, 0.0, 0.0), width=40, height=20)
    save_camera(tmp_path / "c.json", camera)
    options = ["--background", "white", "--title", "Ball", "--camera", tmp_path / "c.json"]
    _, header = exported(capsys, model, out, *options)
    assert header["title"] == "Ball" and header["background"] == [1, 1, 1]
    assert header["opening"]["eye"] == pytest.approx([0.0, -4.5, 0.0], abs=1e-6)


def test_a_simulation(simulation, tmp_path, capsys):
    out = tmp_path / "page.html"
    function = TransferFunction([0.0, 0.7], [0.1, 0.3], [[0.0, 0.5, 1.0]] * 2)
    function.save(tmp_path / "tf.json")
    options = ["--transfer-function", tmp_path / "tf.json", "--value-range", 300, 310, "--attenuation", 8]
    printed, header = exported(capsys, simulation, out, "--scalar", "T", *options)
    assert "(48 cells, T, 0.0" in printed
    transfer = header["transfer"]
    assert header["scalar"] == "T" and header["title"] == "s" and transfer["range"] == [300.0, 310.0]
    # A side of 2 and an attenuation of 8 for a side of 1.
    assert transfer["density"] == pytest.approx(8.0) and transfer["scalar"] == pytest.approx([0.0, 0.7])


def test_what_is_refused(model, simulation, tmp_path, capsys):
    out = tmp_path / "page.html"
    assert "there are several scalars" in fails(capsys, "export", simulation, out)
    assert "shows one scalar, but 2 are given" in fails(capsys, "export", simulation, out, "--scalar", "T", "v")
    said = fails(capsys, "export", model, out, "--attenuation", 3)
    assert "--attenuation is for scalars" in said and "name a scalar by --scalar" in said
    said = fails(capsys, "export", model, tmp_path / "a.vtu", "--title", "x")
    assert "--title is for a page (.html)" in said
    assert "--level is for a surface" in fails(capsys, "export", model, out, "--level", 1)
    assert "background of the page" in fails(capsys, "export", model, out, "--background", 2, 0, 0)
    assert "none.json" in fails(capsys, "export", model, out, "--camera", tmp_path / "none.json")
    assert not out.exists()


def test_loose_cells(tmp_path, capsys):
    """Two cells that touch in half a face."""
    vertices = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0.5, 0, 0]]).float()
    mesh = TetMesh(vertices, torch.tensor([[0, 1, 2, 3], [0, 2, 5, 4], [0, 2, 1, 4]]), conforming=False)
    save(tmp_path / "m.vtu", mesh, Field(torch.rand(6, 3), torch.rand(6)))
    assert "do not meet face to face" in fails(capsys, "export", tmp_path / "m.vtu", tmp_path / "page.html")
