"""The same kernels on a GPU give what they give on the CPU."""

import pytest
import torch

from difftetvr.backend import BackendWarning, default_device, dr, get_backend
from difftetvr.errors import BackendError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, render

CAMERAS = {
    "outside": Camera.look_at((1.5, -1.2, 0.9), (0, 0, 0), fov_y=0.8, width=70, height=50),
    "inside": Camera.look_at((0.11, -0.07, 0.05), (1, 0.3, 0.2), fov_y=1.4, width=70, height=50),
}


def loss_and_gradients(device: str, dtype: torch.dtype, camera: Camera) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    mesh = TetMesh.grid((5, 4, 6), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), dtype=dtype)
    color = torch.rand(mesh.num_vertices, 3, generator=generator, dtype=dtype)
    density = 5.0 * torch.rand(mesh.num_vertices, generator=generator, dtype=dtype)
    vertices, color, density = (t.to(device).requires_grad_() for t in (mesh.vertices, color, density))
    image = render(mesh.to(device).with_vertices(vertices), Field(color, density), camera)
    (image.color.square().sum() + image.depth.sum()).backward()
    grads = [t.grad for t in (vertices, color, density)]
    return [t.detach().cpu().double() for t in (image.color, image.alpha, image.depth, *grads) if t is not None]


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", CAMERAS)
def test_cuda_agrees_with_the_cpu(name: str, dtype: torch.dtype) -> None:
    tolerance = 1e-4 if dtype == torch.float32 else 1e-10
    results = zip(
        loss_and_gradients("cpu", dtype, CAMERAS[name]),
        loss_and_gradients("cuda", dtype, CAMERAS[name]),
        strict=True,
    )
    for cpu, cuda in results:
        assert (cpu - cuda).norm() <= tolerance * cpu.norm()


def test_other_gpus_than_the_first_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dr.Jit knows the first one only; a picture of the wrong memory would be no error."""
    with pytest.raises(BackendError, match=r"'cuda:1'; start one process .* CUDA_VISIBLE_DEVICES=1"):
        get_backend("cuda:1")


def test_a_gpu_that_is_left_unused_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("difftetvr.backend._present_devices", lambda: ["cuda", "cpu"])
    if dr.has_backend(dr.JitBackend.CUDA):
        assert default_device().type == "cuda"
        return
    with pytest.warns(BackendWarning, match="GPU is left unused: The CUDA back end cannot start .*DRJIT_LIBCUDA_PATH"):
        assert default_device().type == "cpu"
