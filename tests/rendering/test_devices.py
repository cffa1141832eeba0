"""The same kernels on a GPU give what they give on the CPU."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from difftetvr import libcuda
from difftetvr.backend import BackendWarning, default_device, dr, get_backend
from difftetvr.errors import BackendError, CameraError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, Detector, render

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


def test_a_gpu_that_pytorch_cannot_use_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(libcuda, "count_gpus", lambda: 1)
    for version, reason in ((None, "built without CUDA"), ("12.8", "cannot start CUDA")):
        monkeypatch.setattr(torch.version, "cuda", version)
        with pytest.warns(BackendWarning, match=f"The GPU is left unused: .*{reason}"):
            assert default_device().type == "cpu"


def test_gpus_that_are_hidden_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """What this process calls cuda:1 has another name outside where the variable hides some."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-5a")
    with pytest.raises(BackendError, match="CUDA_VISIBLE_DEVICES=GPU-5a, and"):
        get_backend("cuda:1", torch.float64)


def leaf(shape: tuple[int, ...], seed: int) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.gpu
def test_cameras_of_which_a_part_is_on_the_gpu() -> None:
    mesh, pose = TetMesh.grid((2, 2, 2), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), CAMERAS["outside"].world_to_camera
    field = Field(torch.ones(27, 3), torch.ones(27))
    focal = torch.tensor(60.0, device="cuda", requires_grad=True)
    render(mesh, field, Camera(pose, focal, 60.0, 35.0, 25.0, 70, 50)).color.sum().backward()
    assert focal.grad is not None and float(focal.grad) != 0.0
    listed = Detector(torch.zeros(3, device="cuda"), [0.1, 0, 0], [0, 0.1, 0], 3, 2, direction=[1, 1, 1])
    assert listed.rays().directions.device.type == "cuda"
    on_both = [CAMERAS["outside"], CAMERAS["inside"].with_pose(CAMERAS["inside"].world_to_camera.cuda())]
    with pytest.raises(CameraError, match="are on 'cpu' and 'cuda:0'; move"):
        render(mesh, field, on_both)
    with pytest.raises(CameraError, match="are on 'cpu' and 'cuda:0'; move"):
        Detector(torch.zeros(3, device="cuda"), torch.ones(3), [0, 0.1, 0], 3, 2, direction=[1, 1, 1])


@pytest.mark.gpu
def test_views_that_begin_in_the_midst_of_a_packet() -> None:
    """Kernels load packets of 16 bytes, and a GPU faults where one does not begin at a multiple of them."""
    backend = get_backend("cuda", torch.float32)
    view = torch.arange(9.0, device="cuda")[1:]
    assert view.data_ptr() % 16
    packets = dr.gather(backend.Float4, backend.floats(view), dr.arange(backend.UInt, 2))
    assert packets.numpy().T.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]


@pytest.mark.gpu
def test_reduced_precision_of_products_does_not_reach_images() -> None:
    """Products of float32 matrices in TF32 would move vertices by a thousandth of their distance."""
    before = torch.get_float32_matmul_precision()
    images = []
    try:
        for precision in ("highest", "high"):
            torch.set_float32_matmul_precision(precision)
            images.append(loss_and_gradients("cuda", torch.float32, CAMERAS["outside"])[:3])
    finally:
        torch.set_float32_matmul_precision(before)
    for exact, reduced in zip(*images, strict=True):
        assert torch.equal(exact, reduced)


@pytest.mark.gpu
def test_what_another_stream_writes_is_waited_for() -> None:
    mesh = TetMesh.grid((3, 3, 3), dtype=torch.float32).to("cuda")
    color, density = leaf((mesh.num_vertices, 3), 0).to("cuda"), leaf((mesh.num_vertices,), 1).to("cuda")
    expected = render(mesh, Field(color, density), CAMERAS["outside"]).color
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        large = torch.ones(1000, 1000, device="cuda")
        for _ in range(50):
            large = (large @ large).clamp(max=1.0)  # keeps the stream busy; all elements are 1
        written = Field(color * large[0, 0], density * large[0, 0])
        assert torch.equal(render(mesh, written, CAMERAS["outside"]).color, expected)


@pytest.mark.gpu
def test_an_order_of_sums_cannot_be_asked_of_a_gpu() -> None:
    mesh = TetMesh.grid((2, 2, 2), dtype=torch.float32).to("cuda")
    density = leaf((mesh.num_vertices,), 1).to("cuda").requires_grad_()
    field = Field(leaf((mesh.num_vertices, 3), 0).to("cuda"), density)
    image = render(mesh, field, CAMERAS["outside"], deterministic=True)
    with pytest.warns(BackendWarning, match="deterministic=True does not reach the cuda kernels"):
        image.color.sum().backward()


@pytest.mark.gpu
def test_the_driver_of_machines_without_development_packages_is_found(tmp_path: Path) -> None:
    """They have ``libcuda.so.1`` alone, and no variable that names it."""
    found = os.environ.get(libcuda.PATH_VARIABLE)
    if not found or not Path(found).is_file():
        pytest.skip("the driver's place is not known")
    (tmp_path / libcuda.REAL_NAME).symlink_to(found)
    environment = {name: value for name, value in os.environ.items() if name != libcuda.PATH_VARIABLE}
    environment |= {"LD_LIBRARY_PATH": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    code = "from difftetvr.backend import dr; print(bool(dr.has_backend(dr.JitBackend.CUDA)))"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True"]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize("part", ["color", "harmonics", "density"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_what_is_not_finite_is_named_without_a_look_at_it_first(part: str, value: float, device: str) -> None:
    """Colours that depend on the direction are cut off at 0, which must hide nothing."""
    mesh = TetMesh.grid((2, 2, 2)).to(device)
    parts = {"color": (3,), "density": (), "harmonics": (3, 3)}
    values = {name: torch.full((mesh.num_vertices, *shape), 0.5) for name, shape in parts.items()}
    values[part].view(mesh.num_vertices, -1)[3, 0] = value
    field = Field(**{name: tensor.to(device) for name, tensor in values.items()})
    for view in (CAMERAS["outside"], CAMERAS["outside"].rays()):
        with pytest.raises(MeshError, match=f"{part} of vertex 3"):
            render(mesh, field, view)
