"""The commands, from arguments to files and exit codes."""

import errno
import importlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import difftetvr.cli as cli
from difftetvr.capture import Capture
from difftetvr.fit.checkpoint import Checkpoint
from difftetvr.fit.folder import RunFolder
from difftetvr.fit.loop import Trainer
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load, save
from difftetvr.terminal import sentence_for

LOOP = importlib.import_module("difftetvr.fit.loop")  # difftetvr.fit is the function, too
VIEWS = ["--views", "10", "--width", "24", "--height", "24"]
FIT = ["--cells", "500", "--iterations", "4", "--device", "cpu"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished small run, never written to by the tests."""
    folder = tmp_path_factory.mktemp("run") / "out"
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT]) == 0
    return folder


def fails(capsys, *args):
    """Asserts exit code 2 and one sentence on standard error; returns it."""
    capsys.readouterr()
    assert cli.main([str(a) for a in args]) == 2
    error = capsys.readouterr().err
    assert re.fullmatch(r"difftetvr: [^\n]+\.\n", error), error
    assert "Traceback" not in error
    return error


def test_fit_fills_its_folder(run):
    names = {
        "model.vtu",
        "metrics.json",
        "config.json",
        "curves.png",
        "comparison.png",
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
    assert cli.main(["eval", str(run / "model.vtu"), "tooth", "-o", str(output), "--device", "cpu", *VIEWS]) == 0
    numbers = json.loads(output.read_text())
    metrics = json.loads((run / "metrics.json").read_text())
    assert numbers["psnr"] == pytest.approx(metrics["psnr"], abs=1e-3)
    assert numbers["ssim"] == pytest.approx(metrics["ssim"], abs=1e-3)
    assert f"{metrics['psnr']:.2f}" in capsys.readouterr().out


def test_render_frames_the_mesh(run, tmp_path, capsys):
    picture = tmp_path / "a.png"
    model = str(run / "model.vtu")
    assert cli.main(["render", model, "-o", str(picture), "--width", "40", "--height", "30", "--device", "cpu"]) == 0
    pixels = np.asarray(Image.open(picture))
    assert pixels.shape == (30, 40, 3)
    assert pixels[10:20, 15:25].max() > 20
    assert pixels[0].max() == pixels[-1].max() == 0, "the mesh lies within the picture"
    given = ["--eye", "0", "-3", "0.5", "--target", "0", "0", "50", "--background", "0", "1", "0"]
    assert cli.main(["render", model, "-o", str(picture), "--width", "8", "--height", "8", *given]) == 0
    assert np.asarray(Image.open(picture)).reshape(-1, 3).tolist() == [[0, 255, 0]] * 64


def test_info_describes_meshes_and_captures(run, tmp_path, capsys):
    assert cli.main(["info", str(run / "model.vtu")]) == 0
    assert "per vertex" in capsys.readouterr().out
    assert cli.main(["info", "tooth", "--views", "5", "--width", "12", "--height", "10"]) == 0
    assert "12 x 10" in capsys.readouterr().out
    image = torch.rand(2, 12, 14, 3)
    mesh, field = load(run / "model.vtu")
    camera = cli.Render(model=run, output=run, width=14, height=12)._camera(mesh)
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
    assert cli.main(["fit", "tooth", "-o", str(folder), "--resume"]) == 0
    assert (folder / "model.vtu").read_bytes() == (run / "model.vtu").read_bytes()
    assert "cells = 500" in fails(capsys, "fit", "tooth", "-o", folder, "--resume", "--cells", "900")
    assert "other views" in fails(capsys, "fit", "tooth", "-o", folder, "--resume", "--width", "32")
    assert "fits 'tooth'" in fails(capsys, "fit", "molar.nrrd", "-o", folder, "--resume")


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
    assert "cells" in fails(capsys, "fit", "tooth", "-o", out, "--cells", 10**23, *VIEWS)
    assert "folder" in fails(capsys, "info", tmp_path)
    fails(capsys, "eval", model, "nothing.nrrd")
    fails(capsys, "eval", tmp_path / "nothing.vtu", "tooth")
    fails(capsys, "eval", model, "tooth", *VIEWS, "--test-every", 0)
    fails(capsys, "info", tmp_path / "nothing.vtu")
    fails(capsys, "info", tmp_path / "broken.vtu")
    fails(capsys, "export", model, tmp_path / "a.ply")
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


def test_interrupt_saves_a_checkpoint_and_leaves_with_130(tmp_path):
    folder = tmp_path / "out"
    args = ["fit", "tooth", "-o", str(folder), *VIEWS, "--cells", "500", "--iterations", "100000", "--device", "cpu"]
    code = "import sys; from difftetvr.cli import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *args], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        first = process.stdout.readline()
        assert "loss" in first, first
        time.sleep(0.2)
        os.kill(process.pid, signal.SIGINT)
        rest, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "--resume" in rest
    assert "Traceback" not in rest
    assert (folder / "checkpoint.safetensors").exists()
    assert not (folder / "model.vtu").exists()


def test_outputs_that_cannot_be_written_are_found_before_the_work(run, tmp_path, capsys, monkeypatch):
    def work(*args, **kwargs):
        pytest.fail("the work has begun")

    monkeypatch.setattr(cli.CaptureOptions, "load", work)
    monkeypatch.setattr("difftetvr.mesh.io.load", work)
    missing, file = tmp_path / "missing", tmp_path / "file"
    file.write_text("")
    for arguments in (
        ["eval", run / "model.vtu", "tooth", "-o", missing / "e.json"],
        ["render", run / "model.vtu", "-o", missing / "a.png"],
        ["export", run / "model.vtu", missing / "a.vtk"],
        ["fit", "tooth", "-o", file / "run"],
    ):
        assert "Cannot write" in fails(capsys, *arguments)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


MEMORY_ERRORS = [
    MemoryError(),
    torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    RuntimeError("[enforce fail at alloc_cpu.cpp:124] err == 0. DefaultCPUAllocator: can't allocate memory: you tried"),
    RuntimeError("jit_malloc(): out of memory! Could not allocate 68719476736 bytes of device memory."),
    RuntimeError("cuda_check(): API error 0002 (CUDA_ERROR_OUT_OF_MEMORY)"),
    RuntimeError("std::bad_alloc"),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
]


@pytest.mark.parametrize("error", MEMORY_ERRORS, ids=lambda e: f"{type(e).__name__} {e}"[:40])
def test_every_shortage_of_memory_is_the_same_sentence(run, capsys, monkeypatch, error):
    monkeypatch.setattr("difftetvr.mesh.io.load_with_optional_field", raising(error))
    assert "not enough memory; use fewer cells" in fails(capsys, "info", run / "model.vtu")


def test_real_shortages_of_memory_are_recognised():
    for shortage in (lambda: torch.empty(2**46), lambda: np.empty(2**46), lambda: bytes(2**60)):
        with pytest.raises((RuntimeError, MemoryError)) as caught:
            shortage()
        assert sentence_for(caught.value) == "There is not enough memory; use fewer cells, or fewer or smaller views."


def test_mistakes_of_the_program_are_not_hidden(run, monkeypatch):
    monkeypatch.setattr("difftetvr.mesh.io.load_with_optional_field", raising(RuntimeError("a shape is wrong")))
    with pytest.raises(RuntimeError, match="a shape is wrong"):
        cli.main(["info", str(run / "model.vtu")])


def raising(error):
    def fail(*args, **kwargs):
        raise error

    return fail


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.parametrize("where", ["prepare", "step", "save"])
@pytest.mark.parametrize("existing", [False, True])
def test_a_failed_start_leaves_nothing(tmp_path, capsys, monkeypatch, error, where, existing):
    """Neither a run that refuses the next attempt nor the folders made for it."""
    target = {
        "prepare": (LOOP, "build_grid"),
        "step": (Trainer, "step"),
        "save": (Checkpoint, "save"),
    }[where]
    folder = tmp_path / "new" / "out"
    if existing:
        folder.mkdir(parents=True)
        (folder / "notes.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with monkeypatch.context() as patch:
        patch.setattr(*target, raising(error))
        fails(capsys, "fit", "tooth", "-o", folder, *VIEWS, *FIT)
    assert sorted(tmp_path.rglob("*")) == before
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT]) == 0


def test_a_failure_later_keeps_what_can_be_resumed(tmp_path, capsys, monkeypatch):
    step = Trainer.step

    def third_fails(trainer):
        if trainer.iteration == 2:
            raise MemoryError
        step(trainer)

    folder = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", third_fails)
        fails(capsys, "fit", "tooth", "-o", folder, *VIEWS, *FIT)
    assert {p.name for p in folder.iterdir()} == {"config.json", "checkpoint.safetensors"}
    assert "already holds" in fails(capsys, "fit", "tooth", "-o", folder, *VIEWS, *FIT)
    assert cli.main(["fit", "tooth", "-o", str(folder), "--resume"]) == 0


def test_what_cannot_start_does_not_cost_the_run_that_was_to_be_replaced(run, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "out"
    shutil.copytree(run, folder)
    with monkeypatch.context() as patch:
        patch.setattr(LOOP, "build_grid", raising(MemoryError()))
        fails(capsys, "fit", "tooth", "-o", folder, *VIEWS, *FIT, "--overwrite")
    assert {p.name: p.read_bytes() for p in folder.glob("*.*")} == {p.name: p.read_bytes() for p in run.glob("*.*")}


def test_overwriting_removes_the_checkpoint_first_and_the_options_last(run, tmp_path, monkeypatch):
    folder = tmp_path / "out"
    shutil.copytree(run, folder)
    removed = []
    unlink = Path.unlink

    def note(path, missing_ok=False):
        removed.append(path.name)
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", note)
    RunFolder(folder)._clear()
    assert removed[0] == "checkpoint.safetensors"
    assert removed[-1] == "config.json"


@pytest.mark.parametrize(
    "change",
    [
        {"capture_options": {"views": "ten"}},
        {"capture_options": {"views": 10, "colour": 3}},
        {"capture_options": [10]},
        {"capture": 3},
        {"fit": {"cells": "many"}},
        {"fit": {"cells": -5}},
        {"fit": None},
    ],
)
def test_damaged_options_of_a_run(run, tmp_path, capsys, change):
    folder = tmp_path / "out"
    shutil.copytree(run, folder)
    saved = json.loads((run / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(saved | change))
    assert f"{folder}/config.json is damaged" in fails(capsys, "fit", "tooth", "-o", folder, "--resume")
    for name in change:
        (folder / "config.json").write_text(json.dumps({k: v for k, v in saved.items() if k != name}))
        assert "lacks" in fails(capsys, "fit", "tooth", "-o", folder, "--resume")


def test_folder_in_place_of_the_checkpoint(run, tmp_path, capsys):
    folder = tmp_path / "out"
    shutil.copytree(run, folder)
    (folder / "checkpoint.safetensors").unlink()
    (folder / "checkpoint.safetensors").mkdir()
    assert "is a folder where the checkpoint" in fails(capsys, "fit", "tooth", "-o", folder, "--resume")


@pytest.mark.parametrize("name", ["d[b].vtu", "[red]x.vtu", "x[bold].vtu", ":apple:.vtu", "d[/b].vtu"])
def test_names_of_files_are_shown_as_they_are(run, tmp_path, capsys, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes((run / "model.vtu").read_bytes())
    assert cli.main(["info", str(path)]) == 0
    assert name in capsys.readouterr().out
    assert cli.main(["render", str(path), "-o", f"{path}.png", "--width", "8", "--height", "8"]) == 0
    assert f"Wrote {path}.png (8 x 8)" in capsys.readouterr().out
    assert cli.main(["export", str(path), f"{path}.npz"]) == 0
    assert f"Wrote {path}.npz" in capsys.readouterr().out


def test_names_with_line_breaks_stay_one_line(tmp_path, capsys):
    assert "no\\nthing" in fails(capsys, "info", tmp_path / "no\nthing.vtu")


def difftetvr(*args, **environment):
    """Runs the command line as a process of its own."""
    source = str(Path(cli.__file__).parents[1])
    return subprocess.run(
        [sys.executable, "-m", "difftetvr", *(str(a) for a in args)],
        capture_output=True,
        env={**os.environ, "PYTHONPATH": source, **environment},
    )


def test_encodings_without_blocks_and_accents(run, tmp_path):
    path = tmp_path / "zähne.vtu"
    path.write_bytes((run / "model.vtu").read_bytes())
    done = difftetvr("info", path, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert (done.returncode, done.stderr) == (0, b"")
    shown = done.stdout.decode("ascii")
    assert "#####" in shown
    assert "z\\xe4hne.vtu" in shown
    assert "█████" in difftetvr("info", path, PYTHONIOENCODING="utf-8").stdout.decode()


@pytest.mark.parametrize("module", ["difftetvr", "difftetvr.cli"])
def test_modules_run(module, tmp_path):
    source = str(Path(cli.__file__).parents[1])
    command = [sys.executable, "-m", module, "info", str(tmp_path / "nothing.vtu")]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": source})
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"difftetvr: There is no mesh file {tmp_path}/nothing.vtu; check the path.\n"


def test_interrupted_runs_tell_a_command_that_shells_understand(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(LOOP, "optimise", raising(KeyboardInterrupt()))
    folder = tmp_path / "my [b]run's"
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *FIT]) == 130
    line = capsys.readouterr().out.strip()
    command = line.partition("continue with: ")[2]
    assert shlex.split(command) == ["difftetvr", "fit", "tooth", "-o", str(folder), "--resume"]
