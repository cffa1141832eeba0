"""The commands, from arguments to files and exit codes."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from commands.helpers import FIT, VIEWS, fails
from PIL import Image

import difftetvr.cli as cli
from difftetvr.capture import Capture
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load, save
from difftetvr.rendering import Camera


def test_fit_fills_its_folder(run):
    names = {
        "model.vtu",
        "metrics.json",
        "config.json",
        "curves.png",
        "comparison.png",
        "cut.png",
        "views",
        "checkpoint.safetensors",
    }
    assert {p.name for p in run.iterdir()} == names
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["psnr"] == pytest.approx(np.mean(metrics["psnr_per_view"]))
    assert metrics["views"] == [2, 7]
    assert metrics["iterations"] == 4
    mesh, field = load(run / "model.vtu")
    assert (metrics["cells"], metrics["vertices"]) == (mesh.num_cells, mesh.num_vertices)
    assert field.location == "vertex"
    assert sorted(p.name for p in (run / "views").iterdir())[:2] == ["0002_reconstruction.png", "0002_truth.png"]
    config = json.loads((run / "config.json").read_text())
    assert config["capture"] == "tooth"
    assert config["fit"]["cells"] == 500
    assert config["capture_options"]["views"] == 10


def test_eval_repeats_the_numbers_of_the_fit(run, tmp_path, capsys):
    output = tmp_path / "eval.json"
    assert cli.main(["eval", str(run / "model.vtu"), "-o", str(output), "--device", "cpu"]) == 0
    numbers = json.loads(output.read_text())
    metrics = json.loads((run / "metrics.json").read_text())
    assert numbers["psnr"] == pytest.approx(metrics["psnr"], abs=1e-3)
    assert numbers["ssim"] == pytest.approx(metrics["ssim"], abs=1e-3)
    said = capsys.readouterr().out
    assert f"{metrics['psnr']:.2f}" in said and f"Comparing with: tooth {' '.join(VIEWS)}" in said


def test_eval_reads_a_capture_as_the_run_beside_the_model_did(run, tmp_path, capsys):
    """If it is the same one, by whatever path; the command line wins, and a model alone knows nothing of any run."""
    model, alone = run / "model.vtu", tmp_path / "model.vtu"
    alone.write_bytes(model.read_bytes())
    parsed = cli.parse_command(["eval", str(model), "tooth", "--width", "20", "--no-keep-lens"])
    assert (parsed.capture, parsed.views_of.views, parsed.views_of.width) == ("tooth", 10, 20)
    assert cli.parse_command(["eval", str(model), f"{tmp_path}/other.nrrd"]).views_of.views is None
    assert cli.parse_command(["eval", str(alone), "tooth"]).views_of.views is None
    assert "name CAPTURE" in fails(capsys, "eval", alone)
    picture = str(tmp_path / "a.png")
    assert cli.parse_command(["compare", "tooth", str(model), str(alone), "-o", picture]).views_of.views == 10
    assert cli.parse_command(["compare", "tooth", str(alone), "-o", picture]).views_of.views is None


def test_render_frames_the_mesh(run, tmp_path, capsys):
    picture = tmp_path / "a.png"
    model = str(run / "model.vtu")
    assert cli.main(["render", model, "-o", str(picture), "--width", "40", "--height", "30", "--device", "cpu"]) == 0
    pixels = np.asarray(Image.open(picture))
    assert pixels.shape == (30, 40, 3)
    assert pixels[10:20, 15:25].max() > 20
    assert max(pixels[0].max(), pixels[-1].max()) <= 5, "what is seen lies within the picture, but for haze"
    given = ["--eye", "0", "-3", "0.5", "--target", "0", "0", "50", "--background", "0", "1", "0"]
    assert cli.main(["render", model, "-o", str(picture), "--width", "8", "--height", "8", *given]) == 0
    assert np.asarray(Image.open(picture)).reshape(-1, 3).tolist() == [[0, 255, 0]] * 64


def test_compare_and_cut_draw_pictures(run, tmp_path, capsys):
    model, sheet, cut = str(run / "model.vtu"), tmp_path / "sheet.png", tmp_path / "cut.png"
    assert cli.main(["compare", "tooth", model, model, "-o", str(sheet), "--names", "one", "other", *VIEWS]) == 0
    assert Image.open(sheet).width > 3 * 384
    assert cli.main(["cut", model, "-o", str(cut), "--size", "100", "--normal", "0", "1", "0", "--no-cells"]) == 0
    assert max(Image.open(cut).size) == 100
    assert "2 models but 1 --names" in fails(capsys, "compare", "tooth", model, model, "-o", sheet, "--names", "x")
    assert "no model" in fails(capsys, "compare", "tooth", "-o", sheet)
    assert "misses the mesh" in fails(capsys, "cut", model, "-o", cut, "--origin", 9, 9, 9)
    assert "--size is 1" in fails(capsys, "cut", model, "-o", cut, "--size", 1)
    fails(capsys, "cut", model, "-o", tmp_path / "cut.jpg")
    fails(capsys, "compare", "tooth", tmp_path / "nothing.vtu", "-o", sheet)


def test_info_describes_meshes_and_captures(run, tmp_path, capsys):
    assert cli.main(["info", str(run / "model.vtu")]) == 0
    assert "per vertex" in capsys.readouterr().out
    assert cli.main(["info", "tooth", "--views", "5", "--width", "12", "--height", "10"]) == 0
    assert "12 x 10" in capsys.readouterr().out
    image = torch.rand(2, 12, 14, 3)
    mesh, field = load(run / "model.vtu")
    camera = Camera.look_at((0.0, -2.0, 0.5), (0.0, 0.0, 0.0), width=14, height=12)
    bounds = torch.tensor([[0.0, 0, 0], [1, 1, 1]])
    Capture([camera] * 2, image, None, torch.tensor([False, True]), bounds, "photos").save(tmp_path / "photos.npz")
    save(tmp_path / "mesh.npz", mesh, field)
    assert cli.main(["info", str(tmp_path / "photos.npz")]) == 0
    assert "2 (1 training, 1 held out)" in capsys.readouterr().out
    assert cli.main(["info", str(tmp_path / "mesh.npz")]) == 0
    assert "per vertex" in capsys.readouterr().out


@pytest.mark.parametrize("suffix", [".vtk", ".msh", ".npz", ".vtu"])
def test_export(run, tmp_path, suffix):
    output = tmp_path / f"model{suffix}"
    assert cli.main(["export", str(run / "model.vtu"), str(output)]) == 0
    (mesh, field), (mesh_read, field_read) = load(run / "model.vtu"), load(output)
    assert torch.equal(mesh.vertices, mesh_read.vertices)
    assert torch.equal(field.color, field_read.color)


def test_resume_takes_the_options_of_the_run(run, tmp_path, capsys):
    folder = tmp_path / "out"
    folder.mkdir()
    for name in ("config.json", "checkpoint.safetensors"):
        (folder / name).write_bytes((run / name).read_bytes())
    assert cli.main(["fit", "-o", str(folder), "--resume"]) == 0
    assert (folder / "model.vtu").read_bytes() == (run / "model.vtu").read_bytes()
    assert "cells = 500" in fails(capsys, "fit", "tooth", "-o", folder, "--resume", "--cells", "900")
    assert "other views" in fails(capsys, "fit", "tooth", "-o", folder, "--resume", "--width", "32")
    assert "fits 'tooth'" in fails(capsys, "fit", "molar.nrrd", "-o", folder, "--resume")


def test_a_run_can_be_trained_longer(run, tmp_path, capsys):
    folder = tmp_path / "out"
    folder.mkdir()
    for name in ("config.json", "checkpoint.safetensors"):
        (folder / name).write_bytes((run / name).read_bytes())
    done = json.loads((run / "metrics.json").read_text())["iterations"]
    longer = ["fit", "-o", str(folder), "--resume", "--iterations", str(done + 2)]
    assert cli.main(longer) == 0
    assert json.loads((folder / "metrics.json").read_text())["iterations"] == done + 2
    assert json.loads((folder / "config.json").read_text())["fit"]["iterations"] == done + 2
    # It is the longer run now.
    assert cli.main(["fit", "-o", str(folder), "--resume"]) == 0
    said = fails(capsys, "fit", "-o", folder, "--resume", "--iterations", done)
    assert f"has done {done + 2} iterations already, this one is to have {done}" in said


def test_another_run_is_never_overwritten_unasked(run, tmp_path, capsys):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "model.vtu").write_text("precious")
    (folder / "notes.txt").write_text("mine")
    assert "already holds a run" in fails(capsys, "fit", "tooth", "-o", folder, *VIEWS, *FIT)
    assert (folder / "model.vtu").read_text() == "precious"
    assert "contradict" in fails(capsys, "fit", "tooth", "-o", folder, *VIEWS, *FIT, "--resume", "--overwrite")
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT, "--overwrite"]) == 0
    assert load(folder / "model.vtu")[0].num_cells == load(run / "model.vtu")[0].num_cells
    assert (folder / "notes.txt").read_text() == "mine"


def test_tensorboard_is_written_beside_the_run_and_replaced_with_it(tmp_path, capsys, monkeypatch):
    pytest.importorskip("tensorboard")
    folder = tmp_path / "out"
    fit = ["fit", "tooth", "-o", str(folder), *VIEWS, *FIT, "--tensorboard"]
    assert cli.main(fit) == 0
    first = list((folder / "tensorboard").iterdir())
    (folder / "tensorboard" / "notes.txt").write_text("mine")
    assert cli.main([*fit, "--overwrite"]) == 0
    second = [path for path in (folder / "tensorboard").iterdir() if path.suffix != ".txt"]
    assert len(first) == len(second) == 1 and first != second
    assert (folder / "tensorboard" / "notes.txt").exists()
    model = (folder / "model.vtu").read_bytes()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install 'difftetvr[tensorboard]'" in fails(capsys, *fit, "--overwrite")
    assert (folder / "model.vtu").read_bytes() == model


def test_bad_input_is_one_sentence_and_code_2(run, tmp_path, capsys):
    model = run / "model.vtu"
    (tmp_path / "broken.vtu").write_text("<VTKFile")
    (tmp_path / "short.raw").write_bytes(bytes(10))
    (tmp_path / "file").write_text("")
    out = tmp_path / "out"
    save(tmp_path / "grid.vtu", TetMesh.grid((1, 1, 1)), Field(torch.zeros(8, 3), torch.zeros(8)))
    fails(capsys, "fit", "nothing.nrrd", "-o", out)
    fails(capsys, "fit", tmp_path / "file", "-o", out)
    fails(capsys, "fit", tmp_path / "short.raw", "-o", out, "--shape", 3, 3, 3, "--dtype", "uint8")
    fails(capsys, "fit", "tooth", "-o", out, "--cells", -5)
    fails(capsys, "fit", "tooth", "-o", out, "--device", "quantum", *VIEWS)
    fails(capsys, "fit", "tooth", "-o", tmp_path / "file")
    fails(capsys, "render", tmp_path / "broken.vtu", "-o", tmp_path / "a.png")
    fails(capsys, "render", tmp_path / "nothing.vtu", "-o", tmp_path / "a.png")
    fails(capsys, "render", model, "-o", tmp_path / "a.jpg")
    fails(capsys, "render", model, "-o", tmp_path / "missing" / "a.png", "--width", 8, "--height", 8)
    fails(capsys, "render", model, "-o", tmp_path / "a.png", "--width", 0)
    assert "--fov is 200 degrees" in fails(capsys, "render", model, "-o", tmp_path / "a.png", "--fov", 200)
    assert "--fov" in fails(capsys, "render", model, "-o", tmp_path / "a.png", "--fov", "nan")
    for option in ("--eye", "--target", "--up", "--background"):
        assert f"{option} is nan 0 1" in fails(capsys, "render", model, "-o", tmp_path / "a.png", option, "nan", 0, 1)
    assert "image size" in fails(capsys, "render", model, "-o", tmp_path / "a.png", "--width", 10**5, "--height", 65000)
    fails(capsys, "render", model, "-o", tmp_path / "a.png", "--width", 10**30)
    assert "'meta'" in fails(capsys, "render", model, "-o", tmp_path / "a.png", "--device", "meta")
    assert "'meta'" in fails(capsys, "fit", "tooth", "-o", out, "--device", "meta", *VIEWS)
    assert "'cpu:99'" in fails(capsys, "render", model, "-o", tmp_path / "a.png", "--device", "cpu:99")
    assert "cells" in fails(capsys, "fit", "tooth", "-o", out, "--cells", 10**23, *VIEWS)
    assert "no capture that is known" in fails(capsys, "info", tmp_path)
    fails(capsys, "eval", model, "nothing.nrrd")
    fails(capsys, "eval", tmp_path / "nothing.vtu", "tooth")
    fails(capsys, "eval", model, "tooth", *VIEWS, "--test-every", 0)
    fails(capsys, "info", tmp_path / "nothing.vtu")
    fails(capsys, "info", tmp_path / "broken.vtu")
    fails(capsys, "export", model, tmp_path / "a.off")
    fails(capsys, "export", tmp_path / "nothing.vtu", tmp_path / "a.vtk")
    assert {p.name for p in tmp_path.iterdir()} == {"broken.vtu", "short.raw", "file", "grid.vtu"}


@pytest.mark.parametrize(
    "args", [[], ["fit"], ["paint"], ["fit", "tooth"], ["fit", "tooth", "-o", "x", "--cells", "many"]]
)
def test_usage_errors_are_code_2(capsys, args):
    assert cli.main(args) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_help_is_code_0(capsys):
    assert cli.main(["fit", "--help"]) == 0
    assert "--haze-penalty" in capsys.readouterr().out


@pytest.mark.skipif(sys.platform == "win32", reason="there a process cannot send another one an interrupt alone")
def test_interrupt_saves_a_checkpoint_and_leaves_with_130(tmp_path):
    folder = tmp_path / "out"
    args = ["fit", "tooth", "-o", str(folder), *VIEWS, "--cells", "500", "--iterations", "100000", "--device", "cpu"]
    code = "import sys; from difftetvr.cli import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *args], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        lines = iter(process.stdout.readline, "")  # on a busy machine it first says that it makes the mesh
        assert any("loss" in line for line in lines)
        os.kill(process.pid, signal.SIGINT)
        rest, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "--resume" in rest
    assert "Traceback" not in rest
    assert (folder / "checkpoint.safetensors").exists()
    assert not (folder / "model.vtu").exists()
