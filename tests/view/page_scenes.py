"""Volumes that pages are tried on, and what their pictures have to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from view.browser import Browser, rendered

import difftetvr as dtv
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, ScalarField, render

Scene = tuple[TetMesh, Field | ScalarField]


def jittered(*shape: int) -> TetMesh:
    torch.manual_seed(1)
    mesh = TetMesh.grid(shape, (3.0, -1.0, 5.0), (5.0, 1.0, 6.0))
    return mesh.with_vertices(mesh.vertices + 0.06 * torch.rand(mesh.vertices.shape))


def with_holes(mesh: TetMesh) -> TetMesh:
    """Every sixth group of cells taken away, so that rays leave the mesh and enter again."""
    kept = (torch.arange(mesh.num_cells) // 24) % 6 != 0
    return TetMesh(mesh.vertices, mesh.tets[kept])


def directional_colors() -> Scene:
    """Of a mesh with holes; from nothing to cells that are opaque: all branches of the integral."""
    mesh = with_holes(jittered(6, 6, 6))
    count = mesh.num_vertices
    color, harmonics = torch.rand(count, 3), 0.3 * torch.randn(count, 15, 3)
    return mesh, Field(color, 10.0 ** (4 * torch.rand(count) - 2), harmonics=harmonics)


def scalars_with_a_jump() -> Scene:
    mesh = jittered(5, 5, 5)
    function = TransferFunction([0.1, 0.3, 0.3, 0.6, 0.62, 0.9], [0.0, 0.05, 0.6, 0.0, 1.0, 0.2], torch.rand(6, 3))
    return mesh, ScalarField((mesh.vertices - 4.0).square().sum(1), function, 4.0)


def constant_colors() -> Scene:
    """Of each cell."""
    mesh = jittered(4, 4, 4)
    count = mesh.num_cells
    return mesh, Field(torch.rand(count, 3), 3.0 * torch.rand(count), "cell", torch.randn(count, 3, 3))


def constant_scalars() -> Scene:
    """Of each cell."""
    mesh = jittered(4, 4, 4)
    scalar = torch.arange(mesh.num_cells).double()
    return mesh, ScalarField(scalar, TransferFunction.default(), 20.0, location="cell")


def camera_at(*eye: float, width: int = 64, height: int = 48) -> Camera:
    return Camera.look_at(eye, (4.0, 0.0, 5.5), (0.0, 0.0, 1.0), 0.8, width, height)


CAMERAS = [camera_at(1.5, -3.5, 6.5), camera_at(5.5, 1.0, 9.0), camera_at(4.1, 0.1, 5.6)]
BACKGROUND = (0.2, 0.5, 0.1)


def psnr(image: np.ndarray, truth: np.ndarray | torch.Tensor) -> float:
    return float(dtv.fitting.metrics.psnr(torch.as_tensor(image).float(), torch.as_tensor(truth).float()))


def require_alike(
    browser: Browser, scene: Scene, cameras: list[Camera], clip: tuple[float, ...] | None = None
) -> list[np.ndarray]:
    """At least 50 dB between the page and `render`, and no ray lost; the page's pictures."""
    mesh, field = scene
    pictures = []
    for camera in cameras:
        pixels, audit = rendered(browser, camera, BACKGROUND, clip)
        with torch.no_grad():
            truth = render(mesh, field, camera, torch.tensor(BACKGROUND), clip_plane=clip).color.clamp(0.0, 1.0)
        assert truth.std() > 0.02
        assert psnr(pixels, truth) > 50.0
        assert audit["lost"] == audit["bounded"] == 0 and audit["rays"] == camera.width * camera.height
        assert 0 < audit["mostSteps"] <= mesh.num_cells
        pictures.append(pixels)
    return pictures


def require_webgpu(browser: Browser, folder: Path) -> None:
    """Skips what needs WebGPU where this Chromium has none to offer."""
    (folder / "empty.html").write_text("<script>window.difftetvr = {}</script>")
    browser.open(folder / "empty.html")
    if not browser.run("navigator.gpu ? navigator.gpu.requestAdapter().then(Boolean) : false"):
        pytest.skip("this Chromium offers no WebGPU adapter, not even one that computes on the CPU")


def require_no_complaints(browser: Browser) -> None:
    """Nothing in the log, and nothing asked of a network."""
    assert not browser.errors, browser.errors
    assert not [r for r in browser.requests if not r.startswith(("file:", "data:", "blob:"))]
