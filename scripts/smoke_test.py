"""Is the installed package whole? Run it with the Python that difftetvr was installed into, from any folder.

Asks for what an installation can lack: modules, the stubs that name them, packaged data, the command, a libLLVM.
Renders one image and its derivatives on the CPU, and compares them with the formula of a homogeneous cube.
"""

import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

# The package must be the installed one: not src/ beside this script, nor whatever PYTHONPATH names.
CHECKOUT = Path(__file__).resolve().parents[1]


def run(*command: str) -> str:
    """Output of a command that must succeed."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "PYTHONUTF8": "1"}
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, encoding="utf-8")
    if done.returncode:
        raise AssertionError(f"{command} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout


def check_package() -> None:
    """Everything that is announced is there."""
    import difftetvr

    place = Path(difftetvr.__file__).resolve()
    assert not place.is_relative_to(CHECKOUT / "src"), f"{place} is the checkout, not an installed package"
    for name in dir(difftetvr):
        getattr(difftetvr, name)
    assert (place.parent / "py.typed").is_file()
    print(f"difftetvr {difftetvr.__version__} in {place.parent}")


def check_render() -> None:
    """A cube of constant density and colour: colour (1 - exp(-density length)), straight through."""
    import torch

    import difftetvr as dtv

    mesh = dtv.TetMesh.grid((2, 2, 2), lower=(0.0, 0.0, 0.0), upper=(1.0, 1.0, 1.0))
    tint = torch.tensor([0.2, 0.5, 1.0])
    density = torch.full((mesh.num_vertices,), 3.0, requires_grad=True)
    color = tint.expand(mesh.num_vertices, 3)
    camera = dtv.Camera.look_at((0.5, -1.5, 0.5), (0.5, 0.5, 0.5), (0, 0, 1), width=9, height=9)
    image = dtv.render(mesh, dtv.Field(color, density), camera)
    assert torch.allclose(image.color[4, 4], tint * (1.0 - math.exp(-3.0)), atol=1e-5), image.color[4, 4]
    image.alpha[4, 4].backward()
    assert density.grad is not None
    assert math.isclose(density.grad.sum().item(), math.exp(-3.0), rel_tol=1e-3), density.grad.sum()
    print("one image and its derivatives are right")


def check_commands() -> None:
    """The command and the module, and data that come with the package."""
    command = Path(sys.executable).with_name("difftetvr.exe" if os.name == "nt" else "difftetvr")
    if not command.is_file() and os.name == "nt":
        command = command.parent / "Scripts" / command.name  # outside virtual environments
    assert "reconstruct" in run(str(command), "--help").lower()
    assert "usage" in run(sys.executable, "-m", "difftetvr", "fit", "--help").lower()
    assert "held out" in run(str(command), "info", "tooth")
    print("the command runs")


if __name__ == "__main__":
    check_package()
    check_render()
    check_commands()
