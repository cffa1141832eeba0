"""Commands that fail: full disks, short memory, damaged runs; what they say and what they leave."""

import errno
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from commands.helpers import FIT, TRAINER, VIEWS, fails, raising

import difftetvr.cli as cli
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.records.folder import RunFolder
from difftetvr.fitting.trainer import Trainer
from difftetvr.terminal import sentence_for


def test_outputs_that_cannot_be_written_are_found_before_the_work(run, tmp_path, capsys, monkeypatch):
    def work(*args, **kwargs):
        pytest.fail("the work has begun")

    monkeypatch.setattr("difftetvr.cli.options.CaptureOptions.load", work)
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
    monkeypatch.setattr("difftetvr.mesh.io.load_data", raising(error))
    assert "not enough memory; use fewer cells" in fails(capsys, "info", run / "model.vtu")


def test_real_shortages_of_memory_are_recognised():
    for shortage in (lambda: torch.empty(2**46), lambda: np.empty(2**46), lambda: bytes(2**60)):
        with pytest.raises((RuntimeError, MemoryError)) as caught:
            shortage()
        assert sentence_for(caught.value) == "There is not enough memory; use fewer cells, or fewer or smaller views."


def test_mistakes_of_the_program_are_not_hidden(run, monkeypatch):
    monkeypatch.setattr("difftetvr.mesh.io.load_data", raising(RuntimeError("a shape is wrong")))
    with pytest.raises(RuntimeError, match="a shape is wrong"):
        cli.main(["info", str(run / "model.vtu")])


@pytest.mark.parametrize("command", ["info", "render", "export"])
def test_endless_names_are_cut(command, capsys):
    name = "x" * 5000
    outputs = {"info": [], "render": ["-o", "a.png"], "export": ["a.vtu"]}[command]
    for path in (f"{name}.vtu", f"{name}.nrrd", name):
        assert len(fails(capsys, command, path, *outputs)) < 400


SHORTEST = ["--cells", "500", "--iterations", "1", "--refine", "none", "--device", "cpu"]


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.ENOSPC, "No space left on device")])
@pytest.mark.parametrize("where", ["prepare", "step", "save"])
@pytest.mark.parametrize("existing", [False, True])
def test_a_failed_start_leaves_nothing(tmp_path, capsys, monkeypatch, error, where, existing):
    """Neither a run that refuses the next attempt nor the folders made for it."""
    target = {
        "prepare": (TRAINER, "starting_mesh"),
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
        fails(capsys, "fit", "tooth", "-o", folder, *VIEWS, *SHORTEST)
    assert sorted(tmp_path.rglob("*")) == before
    assert cli.main(["fit", "tooth", "-o", str(folder), *VIEWS, *SHORTEST]) == 0


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
        patch.setattr(TRAINER, "starting_mesh", raising(MemoryError()))
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
    said = fails(capsys, "fit", "tooth", "-o", folder, "--resume")
    assert f"--resume cannot use {folder}/config.json (start anew with --overwrite, or mend it): " in said
    for name in change:
        (folder / "config.json").write_text(json.dumps({k: v for k, v in saved.items() if k != name}))
        assert f"option '{name}' is missing" in fails(capsys, "fit", "tooth", "-o", folder, "--resume")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--cells", 500_000_000], "A run with 500,000,000 cells would take"),
        (["--views", 10**9], "1,000,000,000 views of 24 x 24 pixels would take"),
        (["--width", 50_000, "--height", 50_000], "10 views of 50,000 x 50,000 pixels would take"),
    ],
    ids=lambda value: str(value[0]),
)
def test_runs_that_cannot_fit_the_memory_say_what_they_would_need(tmp_path, capsys, options, sentence):
    said = fails(capsys, "fit", "tooth", "-o", tmp_path / "out", *VIEWS, "--device", "cpu", *options)
    assert said.startswith(f"difftetvr: {sentence}") and "of memory can be used; " in said
    assert not list(tmp_path.iterdir())


def test_a_second_run_into_a_folder_is_refused_and_changes_nothing(tmp_path, capsys):
    folder = RunFolder(tmp_path / "out")
    with folder.claimed():
        folder.config.write_text("of the first run")
        before = {path.name: path.read_bytes() for path in folder.path.iterdir()}
        for options in ([], ["--overwrite"]):
            assert "Another run is going on" in fails(capsys, "fit", "tooth", "-o", folder.path, *VIEWS, *FIT, *options)
        folder.config.write_text(json.dumps({"capture": "tooth", "capture_options": {}, "fit": {}}))
        assert "Another run is going on" in fails(capsys, "fit", "tooth", "-o", folder.path, "--resume")
        assert {path.name for path in folder.path.iterdir()} == set(before)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="only POSIX has such pipes")
@pytest.mark.parametrize("option", ["--config", "--transfer-function", "--initial-mesh"])
def test_pipes_and_devices_are_no_files(tmp_path, capsys, option):
    suffix = ".vtu" if "mesh" in option else ".json"
    pipe, device = tmp_path / f"pipe{suffix}", tmp_path / f"device{suffix}"
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    for path in (pipe, device):
        assert path.name in fails(capsys, "fit", "tooth", "-o", tmp_path / "out", *VIEWS, *FIT, option, path)
    assert not (tmp_path / "out").exists()


def test_a_mesh_larger_than_its_budget_is_told(tmp_path, capsys):
    assert cli.main(["fit", "tooth", "-o", str(tmp_path / "out"), *VIEWS, *SHORTEST, "--cells", "1"]) == 0
    assert "Beginning with 6 cells, more than --cells 1: this is the nearest" in capsys.readouterr().out


def test_folder_in_place_of_the_checkpoint(run, tmp_path, capsys):
    folder = tmp_path / "out"
    shutil.copytree(run, folder)
    (folder / "checkpoint.safetensors").unlink()
    (folder / "checkpoint.safetensors").mkdir()
    assert "is a folder where the checkpoint" in fails(capsys, "fit", "tooth", "-o", folder, "--resume")
