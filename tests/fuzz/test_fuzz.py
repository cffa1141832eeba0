"""Damaged inputs of every reader; DIFFTETVR_FUZZ=10000 judges that many of them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

for package in ("meshio", "h5py", "netCDF4", "nibabel", "tifffile", "SimpleITK"):
    pytest.importorskip(package)
pytest.importorskip("resource", reason="limits of memory are those of POSIX")

ROOT = Path(__file__).parents[2]
COUNT = int(os.environ.get("DIFFTETVR_FUZZ", "200"))
MESHES = (".bintet", ".mesh", ".msh", ".node", ".npz", ".ovm", ".vtk", ".vtu", ".pvd", ".vti")


def test_damaged_inputs_give_content_or_a_sentence():
    """In processes of their own, which may not use 2 GB more nor more than 20 s an input."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT / "tests")])}
    command = [sys.executable, "-m", "fuzz", "--inputs", str(COUNT)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120 + COUNT)
    assert done.returncode == 0, done.stdout + done.stderr
    for suffix in MESHES:
        assert f"mesh {suffix} " in done.stdout
    for kind in ("capture", "volume", "scan", "geometry", "transfer function", "points"):
        assert f"\n{kind} " in done.stdout
