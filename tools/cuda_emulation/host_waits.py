"""How often a host waits for the device in a rendering and its backward pass: ``python -m cuda_emulation.host_waits``.

Every wait costs a GPU the time that the host needs to have something for it again. Printed for each kind of call, once
its kernels are there: waits in Dr.Jit (as the driver is asked to) and in PyTorch (by the operation), and how many
kernels are launched. Needs ``src`` and ``tools`` on PYTHONPATH.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Callable

import torch

from cuda_emulation import torch_device
from cuda_emulation.started import DRIVER
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import (
    Camera,
    LensCamera,
    ParallelCamera,
    Rays,
    ScalarField,
    depth_at,
    render,
    render_normals,
    transmittance_at,
)
from difftetvr.rendering.gauss_newton import model_image

CAMERA = Camera.look_at((1.5, -1.2, 0.9), (0.0, 0.0, 0.0), fov_y=0.8, width=48, height=32)


def driver_counts() -> Counter[str]:
    """What the driver has counted so far, by name."""
    name_of = DRIVER.emulated_cuda_count
    name_of.restype = ctypes.c_char_p
    counts: Counter[str] = Counter()
    value = ctypes.c_ulong()
    while name := name_of(len(counts), ctypes.byref(value)):
        counts[name.decode()] = value.value
    return counts


def waits_of(call: Callable[[], object]) -> tuple[int, Counter[str]]:
    """Kernels that a call launches, and how often it waits; of its third time."""
    for _ in range(2):
        call()
    launched, waited = driver_counts(), torch_device.WAITS.copy()
    call()
    counts = driver_counts()
    waits = torch_device.WAITS - waited
    waits.update({f"Dr.Jit {name}": counts[name] - launched[name] for name in counts if name.startswith("waits")})
    return counts["kernel launches"] - launched["kernel launches"], +waits


def scene() -> tuple[TetMesh, torch.Tensor, torch.Tensor]:
    """A mesh on the device, and colours and densities of its vertices."""
    mesh = TetMesh.grid((5, 4, 6), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), dtype=torch.float32).to("cuda")
    color, density = torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices)
    return mesh, color.to("cuda"), density.to("cuda")


def fitted(renderer: str, *wanted: str, rays: Rays | None = None) -> Callable[[], object]:
    """An image and, if any are wanted, its gradients."""
    mesh, color, density = scene()
    parts = {"vertices": mesh.vertices, "color": color, "density": density}
    leaves = {name: part.clone().requires_grad_(name in wanted) for name, part in parts.items()}

    def call() -> object:
        moved = mesh.with_vertices(leaves["vertices"])
        image = render(moved, Field(leaves["color"], leaves["density"]), rays or CAMERA, renderer=renderer)
        return torch.autograd.grad(image.color.sum(), [leaves[name] for name in wanted]) if wanted else image

    return call


def modelled() -> Callable[[], object]:
    """What an image says about changes of the mesh."""
    mesh, color, density = scene()
    truth = torch.zeros(CAMERA.height, CAMERA.width, 3, device="cuda")
    return lambda: model_image(mesh, Field(color, density), CAMERA, truth)


def calls() -> dict[str, Callable[[], object]]:
    """Kinds of calls by their names."""
    kinds: dict[str, Callable[[], object]] = {}
    for renderer in ("marching", "linked-list", "projected"):
        kinds[f"{renderer}, image"] = fitted(renderer)
        kinds[f"{renderer}, by colours and densities"] = fitted(renderer, "color", "density")
        kinds[f"{renderer}, by vertices, too"] = fitted(renderer, "vertices", "color", "density")
    there = CAMERA.rays().to("cuda")
    kinds["bundle of rays, image"] = fitted("marching", rays=there)
    kinds["bundle of rays that begin among cells, image"] = fitted(
        "marching", rays=Rays(0.2 * there.origins, there.directions)
    )
    kinds["model by hats"] = modelled()
    kinds.update(others())
    return kinds


def others() -> dict[str, Callable[[], object]]:
    """Calls with other cameras and for other quantities than images of colours by a pinhole on the host."""
    mesh, color, density = scene()
    field = Field(color, density)
    harmonics = Field(color, density, harmonics=torch.zeros(mesh.num_vertices, 3, 3, device="cuda"))
    scalars = ScalarField(density, TransferFunction([0.0, 1.0], [0.0, 0.9], torch.rand(2, 3)), 3.0)
    numbers = (CAMERA.world_to_camera, 40.0, 40.0, 24.0, 16.0, 48, 32)
    near = Camera.look_at((1.2, -1.0, 0.9), (0.0, 0.0, 0.0), fov_y=0.8, width=40, height=32)
    there = Camera(CAMERA.world_to_camera.to("cuda"), *numbers[1:])
    lens = LensCamera(*numbers, coefficients=torch.tensor([0.1, -0.05]))
    return {
        "cameras of one size": lambda: render(mesh, field, [CAMERA, CAMERA]),
        "cameras of several sizes": lambda: render(mesh, field, [CAMERA, near]),
        "camera on the device": lambda: render(mesh, field, there),
        "lens": lambda: render(mesh, field, lens),
        "parallel": lambda: render(mesh, field, ParallelCamera(CAMERA.world_to_camera, (0.03, 0.03), 48, 32)),
        "clip plane": lambda: render(mesh, field, CAMERA, clip_plane=(0.0, 0.0, 1.0, 0.1)),
        "scalars": lambda: render(mesh, scalars, CAMERA),
        "harmonics": lambda: render(mesh, harmonics, CAMERA),
        "normals": lambda: render_normals(mesh, field, CAMERA),
        "depth_at": lambda: depth_at(mesh, field, CAMERA, (0.3, 0.5)),
        "transmittance_at": lambda: transmittance_at(mesh, field, CAMERA, 1.5),
    }


def main() -> None:
    """Print a line for each kind of call."""
    for name, call in calls().items():
        launches, waits = waits_of(call)
        told = ", ".join(f"{waits[kind]} {kind}" for kind in sorted(waits))
        print(f"{name:44} {waits.total():3} waits, {launches:3} kernels: {told}", flush=True)


if __name__ == "__main__":
    main()
