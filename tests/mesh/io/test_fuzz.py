"""Damaged files of every format; DIFFTETVR_FUZZ=10000 damages that many of them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("meshio")
pytest.importorskip("resource", reason="limits of memory are those of POSIX")

ROOT = Path(__file__).parents[3]
COUNT = int(os.environ.get("DIFFTETVR_FUZZ", "400"))


def test_damaged_files_give_a_mesh_or_a_sentence():
    """In a process of its own, which may not use more than 1 GiB nor more than 5 s a file."""
    command = [sys.executable, str(ROOT / "tests/mesh/io/fuzz.py"), str(COUNT)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60 + COUNT)
    assert done.returncode == 0, done.stdout + done.stderr
    for suffix in (".bintet", ".mesh", ".msh", ".node", ".npz", ".ovm", ".vtk", ".vtu", ".xdmf", ".pvd", ".vti"):
        assert f"{suffix} sentence" in done.stdout
