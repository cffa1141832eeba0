"""What a run leaves in its folder: whose it is, what is swept, and what a shortage of memory costs."""

import threading

import pytest
import safetensors.torch

from difftetvr.errors import FitError
from difftetvr.fitting import FitConfig
from difftetvr.fitting.loop import fit
from difftetvr.fitting.records.folder import RunFolder

TINY = FitConfig(cells=50, iterations=2, refine="none", device="cpu")


class PanicException(BaseException):
    """What compiled code in Rust raises where it sees no way on."""


def test_one_run_at_a_time_in_a_folder(tmp_path):
    folder = RunFolder(tmp_path / "new" / "run")
    with folder.claimed():
        (folder.path / "notes.txt").write_text("mine")
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(FitError, match=f"Another run is going on in {folder.path}"), folder.claimed():
            pytest.fail("the body must not run")
        assert sorted(tmp_path.rglob("*")) == before
    assert [path.name for path in folder.path.iterdir()] == ["notes.txt"]


def test_folders_that_came_to_nothing_are_removed(tmp_path):
    with pytest.raises(ZeroDivisionError), RunFolder(tmp_path / "a" / "b").claimed():
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_claiming_a_folder_sweeps_what_dead_runs_had_half_written(tmp_path):
    folder = RunFolder(tmp_path)
    folder.views.mkdir()
    half = [".checkpoint-0123abcd.safetensors", ".curves-0123abcd.png", ".probe-0123abcd", ".config-0123abcd.json"]
    half += ["views/.0002_truth-0123abcd.png", "checkpoint.safetensors.lock"]
    others = [
        ".checkpoint-mine.safetensors",
        ".photo-0123abcd.png",
        "views/.photo-0123abcd.png",
        "checkpoint.safetensors",
    ]
    for name in half + others:
        (tmp_path / name).write_text("half")
    with folder.claimed():
        pass
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == sorted([*others, "views"])


@pytest.mark.parametrize("name", ["model.vtu", "metrics.json", "curves.png", "checkpoint.safetensors"])
def test_folders_in_place_of_files_are_found_before_the_run(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(FitError, match=f"{name} is a folder where the {name.partition('.')[0]} should be a file"):
        RunFolder(tmp_path).require_free(resume=False, overwrite=True)


def test_a_file_in_place_of_the_pictures_is_found_before_the_run(tmp_path):
    (tmp_path / "views").write_text("mine")
    with pytest.raises(FitError, match="views is a file where the folder of pictures should be"):
        RunFolder(tmp_path).require_free(resume=False, overwrite=False)


def test_runs_of_the_library_do_not_share_a_checkpoint(small_capture, tmp_path):
    path, (inside, done) = tmp_path / "checkpoint.safetensors", (threading.Event(), threading.Event())
    (tmp_path / ".checkpoint-0123abcd.safetensors").write_text("half")

    def wait(progress):
        inside.set()
        done.wait(60)

    first = threading.Thread(target=fit, args=(small_capture, TINY), kwargs={"checkpoint": path, "on_progress": wait})
    first.start()
    try:
        assert inside.wait(60)
        with pytest.raises(FitError, match="Another run saves its checkpoint"):
            fit(small_capture, TINY, checkpoint=path, resume=True)
    finally:
        done.set()
        first.join()
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_panics_for_want_of_memory_are_errors(small_capture, tmp_path, monkeypatch):
    def panic(*args, **kwargs):
        raise PanicException("Python API call failed")

    monkeypatch.setattr(safetensors.torch, "save", panic)
    with pytest.raises(MemoryError, match="Python API call failed"):
        fit(small_capture, TINY, checkpoint=tmp_path / "checkpoint.safetensors")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("options", [{"cells": 500_000_000}, {"grid": (800, 400, 200)}], ids=str)
def test_runs_that_cannot_fit_the_memory_are_refused_before_they_begin(small_capture, monkeypatch, options):
    monkeypatch.setattr("difftetvr.trust.free_memory", lambda: 2**34)
    with pytest.raises(FitError, match=r"^A run with [\d,]+ cells would take [\d.]+ GiB, but only 12.8 GiB of memory"):
        fit(small_capture, FitConfig(device="cpu", **options))
