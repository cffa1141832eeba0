"""The examples run as they stand."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def run(*command: str, folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def last_number(output: str, pattern: str) -> float:
    return float(re.findall(pattern, output)[-1])


def test_render_mesh(tmp_path):
    run(str(ROOT / "examples" / "render_mesh.py"), str(tmp_path), folder=tmp_path)
    assert (tmp_path / "render_mesh.png").stat().st_size > 10_000
    assert (tmp_path / "render_mesh.vtu").exists()


def test_simulation(tmp_path):
    output = run(str(ROOT / "examples" / "simulation.py"), str(tmp_path), folder=tmp_path)
    assert re.search(r"'\+[\d.]*[1-9]", output)
    assert (tmp_path / "simulation.png").stat().st_size > (tmp_path / "simulation_opened.png").stat().st_size > 10_000


def test_tomography(tmp_path):
    output = run(str(ROOT / "examples" / "tomography.py"), str(tmp_path), folder=tmp_path)
    assert last_number(output, r"off by ([\d.]+) %") < 5.0


@pytest.mark.slow  # a whole reconstruction
def test_fit_volume(tmp_path):
    output = run(str(ROOT / "examples" / "fit_volume.py"), str(tmp_path), folder=tmp_path)
    assert last_number(output, r"PSNR ([\d.]+)") > 23.0


@pytest.mark.slow  # a whole reconstruction
def test_fit_photos(tmp_path):
    output = run(str(ROOT / "examples" / "fit_photos.py"), str(tmp_path), folder=tmp_path)
    assert last_number(output, r"PSNR ([\d.]+)") > 25.0
    assert (tmp_path / "fit_photos.png").stat().st_size > 10_000


def test_recover_pose(tmp_path):
    output = run(str(ROOT / "examples" / "recover_pose.py"), folder=tmp_path)
    assert last_number(output, r"off by ([\d.]+)") < 0.002
    assert (tmp_path / "out" / "examples" / "recover_pose.png").exists()


def test_own_training_loop(tmp_path):
    output = run(str(ROOT / "examples" / "own_training_loop.py"), folder=tmp_path)
    assert last_number(output, r"PSNR ([\d.]+)") > 22.0


def test_every_example_is_tested_and_short():
    tests = Path(__file__).read_text()
    for example in EXAMPLES:
        assert f"def test_{example.stem}(" in tests
        assert len(example.read_text().splitlines()) <= 60
