"""`fit-transfer`: what it writes, and what other commands make of it."""

import json

import numpy as np
import pytest
import torch
from commands.helpers import fails
from PIL import Image

import difftetvr as dtv
import difftetvr.cli as cli

FIT = ["--knots", "6", "--iterations", "4", "--device", "cpu"]
TOOTH = ["--views", "3", "--width", "12", "--height", "12", "--test-every", "0", "--cells", "300"]


@pytest.fixture(scope="module")
def simulation(tmp_path_factory):
    """A mesh with a pressure, and images of it."""
    folder = tmp_path_factory.mktemp("simulation")
    mesh = dtv.TetMesh.grid((3, 3, 3))
    pressure = 10.0 + 2.0 * mesh.vertices[:, 2]
    np.savez(folder / "flow.npz", vertices=mesh.vertices.numpy(), tets=mesh.tets.numpy(), pressure=pressure.numpy())
    field = dtv.ScalarField(pressure, dtv.TransferFunction.default(), 25.0)
    cameras = dtv.capture.fibonacci_orbit(3, (0.5, 0.5, 0.5), 2.0, width=12, height=12)
    images = dtv.render(mesh, field, cameras)
    test = torch.zeros(3, dtype=torch.bool)
    capture = dtv.Capture(cameras, images.color, images.alpha.clamp(0, 1), test, mesh.bounds(), "flow")
    capture.save(folder / "views.npz")
    return folder


def test_it_writes_a_function_that_render_takes(simulation, tmp_path, capsys):
    truth = tmp_path / "truth.json"
    dtv.TransferFunction.default().save(truth)
    flow, out = str(simulation / "flow.npz"), tmp_path / "out"
    command = ["fit-transfer", flow, str(simulation / "views.npz"), "-o", str(out), *FIT, "--truth", str(truth)]
    assert cli.main(command) == 0
    assert "Training: PSNR" in capsys.readouterr().out
    assert {file.name for file in out.iterdir()} >= {"transfer_function.json", "start.json", "metrics.json"}
    assert json.loads((out / "metrics.json").read_text())["iterations"] == 4
    assert Image.open(out / "report.png").width > 500
    picture = tmp_path / "a.png"
    shown = ["--transfer-function", str(out / "transfer_function.json"), "--width", "8", "--height", "8"]
    assert cli.main(["render", flow, "-o", str(picture), *shown, "--device", "cpu"]) == 0
    assert "run in" in fails(capsys, *command)
    assert "knots = 6, this run asks for 7" in fails(capsys, *command, "--resume", "--knots", "7")
    assert json.loads((out / "config.json").read_text())["search"]["knots"] == 6
    assert cli.main([*command, "--resume"]) == 0
    assert cli.main([*command, "--overwrite"]) == 0
    before = json.loads((out / "metrics.json").read_text())
    assert cli.main(["fit-transfer", "-o", str(out), "--resume"]) == 0  # with all that the run was made with
    after = json.loads((out / "metrics.json").read_text())
    assert after["iterations"] == 4 and after.keys() == before.keys()
    (out / "config.json").write_text("{}")
    assert "--resume cannot use" in fails(capsys, "fit-transfer", "-o", out, "--resume")


def test_volumes_are_scalars_and_images(tmp_path, capsys):
    assert cli.main(["fit-transfer", "tooth", "tooth", "-o", str(tmp_path / "out"), *FIT, *TOOTH]) == 0
    assert "tetrahedra" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--knots", "1"], "knots is 1"),
        (["--scalar", "speed"], "speed"),
        (["--start", "none.json"], "none.json"),
        (["--resume"], "no run in"),
        (["--attenuation", "-1"], "attenuation"),
    ],
)
def test_bad_input_is_one_sentence(simulation, tmp_path, capsys, options, sentence):
    given = [simulation / "flow.npz", simulation / "views.npz", "-o", tmp_path / "out", *FIT[2:]]
    assert sentence in fails(capsys, "fit-transfer", *given, *options)


def test_images_that_are_none_are_one_sentence(simulation, tmp_path, capsys):
    given = [simulation / "flow.npz", tmp_path, "-o", tmp_path / "out"]
    assert "no capture" in fails(capsys, "fit-transfer", *given)
