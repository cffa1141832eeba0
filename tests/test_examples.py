"""The examples run as they stand."""

import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs an example as its command line would, in this process, which has imported PyTorch and compiled kernels."""

    def output_of(name: str, *arguments: Path) -> str:
        example = ROOT / "examples" / f"{name}.py"
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(argument) for argument in (example, *arguments)])
        capsys.readouterr()
        runpy.run_path(str(example), run_name="__main__")
        return capsys.readouterr().out

    return output_of


def last_number(output: str, pattern: str) -> float:
    return float(re.findall(pattern, output)[-1])


def test_render_mesh(run, tmp_path):
    run("render_mesh", tmp_path)
    assert (tmp_path / "render_mesh.png").stat().st_size > 10_000
    assert (tmp_path / "render_mesh.vtu").exists()


def test_simulation(run, tmp_path):
    output = run("simulation", tmp_path)
    assert re.search(r"'\+[\d.]*[1-9]", output)
    assert (tmp_path / "simulation.png").stat().st_size > (tmp_path / "simulation_opened.png").stat().st_size > 10_000


def test_tomography(run, tmp_path):
    output = run("tomography", tmp_path)
    assert last_number(output, r"off by ([\d.]+) %") < 30.0  # voxels with sharp edges, from 21 noisy views


@pytest.mark.slow  # a whole reconstruction
def test_fit_volume(run, tmp_path):
    output = run("fit_volume", tmp_path)
    assert last_number(output, r"PSNR ([\d.]+)") > 23.0


@pytest.mark.slow  # a whole reconstruction
def test_fit_photos(run, tmp_path):
    output = run("fit_photos", tmp_path)
    assert last_number(output, r"PSNR ([\d.]+)") > 25.0
    assert (tmp_path / "fit_photos.png").stat().st_size > 10_000


def test_recover_pose(run, tmp_path):
    output = run("recover_pose")
    assert last_number(output, r"off by ([\d.]+)") < 0.002
    assert (tmp_path / "out" / "examples" / "recover_pose.png").exists()


def test_best_viewpoint(run, tmp_path):
    output = run("best_viewpoint", tmp_path)
    assert last_number(output, r"Entropy ([\d.]+)") > last_number(output, r"scouts ([\d.]+)")
    assert (tmp_path / "viewpoint_map.png").stat().st_size > 10_000


def test_fit_transfer(run, tmp_path):
    output = run("fit_transfer", tmp_path)
    assert last_number(output, r"PSNR ([\d.]+)") > 35.0
    assert (tmp_path / "fit_transfer.json").exists() and (tmp_path / "fit_transfer.png").stat().st_size > 10_000


def test_fit_scalar(run, tmp_path):
    output = run("fit_scalar", tmp_path)
    assert last_number(output, r"PSNR ([\d.]+)") > 38.0
    assert (tmp_path / "fit_scalar.vtu").exists() and (tmp_path / "fit_scalar.png").stat().st_size > 10_000


def test_own_training_loop(run):
    output = run("own_training_loop")
    assert last_number(output, r"PSNR ([\d.]+)") > 22.0


def test_every_example_is_tested_and_short():
    tests = Path(__file__).read_text()
    for example in EXAMPLES:
        assert f"def test_{example.stem}(" in tests
        assert len(example.read_text().splitlines()) <= 60
