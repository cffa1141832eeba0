"""The command ``difftetvr doctor``."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING

from difftetvr._version import __version__
from difftetvr.errors import BackendError

if TYPE_CHECKING:
    import torch
    from rich.console import Console

    from difftetvr.backend import BackendState

_PACKAGES = ("torch", "drjit", "numpy", "scipy", "meshio", "tyro", "rich", "pytetwild", "tetgen", "h5py")
_VARIABLES = ("DRJIT_LIBLLVM_PATH", "DRJIT_LIBCUDA_PATH", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS", "EAGER_IMPORT")
_SIDE = 32
_LARGEST_ERROR = 1e-4
"""Of a float32 image and its gradients, in units of their greatest value; usual are 1e-6."""


@dataclass(frozen=True)
class Doctor:
    """Say what this installation runs on, and whether each back end renders rightly; for bug reports."""

    def run(self, console: Console) -> None:
        """Prints versions and back ends, and renders a small picture on each that starts."""
        for line in _machine():
            console.print(line, highlight=False)
        from difftetvr.backend import backend_states

        states = backend_states()
        running = [state for state in states if state.works]
        wrong = []
        for state in states:
            console.print(f"{state.name + ':':<10}{state.text}", highlight=False)
            if not state.works:
                continue
            try:
                error, against = _error(state, running)
                text = f"a test image and its gradients are off by {error:.1e} {against}"
            except Exception as failure:  # one that fails must not hide what the others do
                error, text = math.inf, f"a test image fails: {' '.join(str(failure).split())}"
            console.print(f"{'':<10}{text}", highlight=False)
            if not error < _LARGEST_ERROR:
                wrong.append(state.name)
        if not running:
            raise BackendError(f"No back end starts, so nothing can be rendered. {states[0].text}")
        if wrong:
            raise BackendError(f"The back end {wrong[0]} renders wrongly; please report it with the lines above.")


def _machine() -> Iterator[str]:
    """What can be told without PyTorch."""
    yield f"difftetvr {__version__}"
    yield f"{'Python:':<10}{platform.python_version()} ({platform.python_implementation()})"
    yield f"{'system:':<10}{platform.platform()}, {platform.machine()}"
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield f"{'CPU:':<10}{_processor()}, {cores} cores usable, {_memory()}"
    yield f"{'packages:':<10}{', '.join(f'{name} {_version(name)}' for name in _PACKAGES)}"
    given = [f"{name}={os.environ[name]}" for name in _VARIABLES if name in os.environ]
    if given:
        yield f"{'set:':<10}{', '.join(given)}"


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "-"


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.partition(":")[2].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _memory() -> str:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return "memory unknown"
    return f"{total / 2**30:.1f} GiB of memory"


def _error(state: BackendState, running: list[BackendState]) -> tuple[float, str]:
    """Largest error of a back end's float32 image and gradients, in units of their greatest value, and against what."""
    import torch

    reference = next((other for other in running if other.device == "cpu"), state)
    dtype = torch.float64 if reference.has_doubles else torch.float32
    pairs = zip(_sample(state.device, torch.float32), _sample(reference.device, dtype), strict=True)
    error = max(float((found - true).abs().max() / true.abs().max()) for found, true in pairs)
    return error, f"from {reference.name}'s in {str(dtype).removeprefix('torch.')}"


def _sample(device: str, dtype: torch.dtype) -> list[torch.Tensor]:
    """A small image, and the derivatives of a loss on it by positions, colours and densities, as float64 on the CPU."""
    import torch

    from difftetvr.mesh import Field, TetMesh
    from difftetvr.rendering import Camera, render

    mesh = TetMesh.grid((4, 4, 4)).to(device, dtype)
    vertices = mesh.vertices.clone().requires_grad_()
    color = (0.5 + 0.5 * torch.sin(7.0 * mesh.vertices)).requires_grad_()
    density = (3.0 + 2.0 * torch.cos(5.0 * mesh.vertices.sum(1))).requires_grad_()
    camera = Camera.look_at((1.7, -1.3, 1.1), (0.5, 0.5, 0.5), width=_SIDE, height=_SIDE)
    image = render(mesh.with_vertices(vertices), Field(color, density), camera).color
    gradients = torch.autograd.grad(image.square().sum(), (vertices, color, density))
    return [tensor.detach().to("cpu", torch.float64) for tensor in (image, *gradients)]
