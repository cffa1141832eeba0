"""Arguments of the wrong kind, batches among them: one readable sentence that names the argument, never a traceback."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rendering.helpers import assert_sentence

from difftetvr.errors import DiffTetError
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load, load_data, load_mesh
from difftetvr.optics import ExactLinear, SubSegments, TransferFunction
from difftetvr.rendering import (
    Camera,
    CellFeatures,
    Detector,
    LensCamera,
    PanoramicCamera,
    ParallelCamera,
    Rays,
    ScalarField,
    depth_at,
    render,
    render_normals,
    transmittance_at,
)
from difftetvr.rendering.gauss_newton import model_image
from difftetvr.rendering.inspection import inspect_rays

MESH = TetMesh.grid((2, 2, 2))
COUNT = MESH.num_vertices
FIELD = Field(torch.rand(COUNT, 3), torch.rand(COUNT))
CAMERA = Camera.look_at((2.0, -2.0, 2.0), (0.5, 0.5, 0.5), width=8, height=8)
FUNCTION = TransferFunction.default()
POINTS: dict[str, Any] = {"scalar": [0, 1], "opacity": [0, 1], "color": [[0, 0, 0], [1, 1, 1]]}
RENDER: dict[str, Any] = {"mesh": MESH, "field": FIELD, "camera": CAMERA}
POSE: dict[str, Any] = {"world_to_camera": torch.eye(4), "fx": 9.0, "fy": 9.0, "cx": 4.0, "cy": 4.0}
JUNK: dict[str, Any] = {
    "text": "abc" * 999,
    "number": 10**6000,
    "class": ExactLinear,
    "list": [[1, 2], [3]],
    "objects": np.array([None, "a"]),
    "tensor": torch.rand(64, 64, 3),
    "complex": torch.ones(3, dtype=torch.complex64),
    "meta": torch.empty(3, device="meta"),
    "sparse": torch.eye(4).to_sparse(),
    "cameras": [CAMERA, CAMERA],
    "fields": (FIELD, FIELD),
}
CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any], tuple[str, ...]]] = {
    "render": (
        render,
        RENDER,
        ("mesh", "field", "camera", "background", "renderer", "optics", "transmittance_threshold", "clip_plane"),
    ),
    "depth_at": (
        depth_at,
        RENDER,
        ("mesh", "field", "camera", "transmittance", "renderer", "deterministic", "clip_plane"),
    ),
    "transmittance_at": (
        transmittance_at,
        {**RENDER, "distances": 1.0},
        ("mesh", "field", "camera", "distances", "renderer", "deterministic", "clip_plane"),
    ),
    "render_normals": (render_normals, RENDER, ("mesh", "field", "camera", "renderer", "transmittance_threshold")),
    "inspect_rays": (inspect_rays, {"mesh": MESH, "camera": CAMERA}, ("mesh", "camera", "renderer", "clip_plane")),
    "model_image": (
        model_image,
        {**RENDER, "truth": torch.zeros(8, 8, 3)},
        ("mesh", "field", "camera", "truth", "background", "transmittance_threshold", "valid", "hats"),
    ),
    "Camera": (Camera, {**POSE, "width": 8, "height": 8}, (*POSE, "width", "height")),
    "look_at": (Camera.look_at, {"eye": (1, 2, 3), "target": (0, 0, 0)}, ("eye", "target", "up", "fov_y", "width")),
    "Rays": (
        Rays,
        {"origins": (0, 0, 0), "directions": (0, 0, 1)},
        ("origins", "directions", "near", "far"),
    ),
    "LensCamera": (LensCamera, {**POSE, "width": 8, "height": 8}, ("model", "coefficients", "fx", "width")),
    "ParallelCamera": (
        ParallelCamera,
        {"world_to_camera": torch.eye(4), "pixel_size": 0.1, "width": 8, "height": 8},
        ("world_to_camera", "pixel_size", "width", "height", "near"),
    ),
    "PanoramicCamera": (
        PanoramicCamera,
        {"world_to_camera": torch.eye(4), "width": 8, "height": 8},
        ("world_to_camera", "width", "height"),
    ),
    "Detector": (
        Detector,
        {"center": (0, 0, 0), "columns": (1, 0, 0), "rows": (0, 1, 0), "width": 8, "height": 8, "source": (0, 0, 9)},
        ("center", "columns", "rows", "width", "height", "source"),
    ),
    "with_size": (CAMERA.with_size, {"width": 8, "height": 8}, ("width", "height")),
    "with_pose": (CAMERA.with_pose, {}, ("world_to_camera",)),
    "to_camera_space": (CAMERA.to_camera_space, {}, ("points",)),
    "TetMesh": (TetMesh, {"vertices": MESH.vertices, "tets": MESH.tets}, ("vertices", "tets")),
    "delaunay": (TetMesh.delaunay, {}, ("points",)),
    "load": (load, {}, ("path",)),
    "load_data": (load_data, {}, ("path",)),
    "load_mesh": (load_mesh, {}, ("path",)),
    "Field": (Field, {"color": FIELD.color, "density": FIELD.density}, ("color", "density", "location", "harmonics")),
    "ScalarField": (
        ScalarField,
        {"scalar": FIELD.density, "transfer_function": FUNCTION},
        ("scalar", "transfer_function", "attenuation", "value_range", "location"),
    ),
    "CellFeatures": (CellFeatures, {"features": torch.zeros(48, 2), "medium": FIELD}, ("features", "medium")),
    "TransferFunction": (TransferFunction, POINTS, ("scalar", "opacity", "color")),
    "TransferFunction()": (FUNCTION, {}, ("scalar",)),
    "SubSegments": (SubSegments, {}, ("count",)),
}
ACCEPTED = {
    # What is no junk in these places: scalars may be arrays or tensors of any shape, views may be many.
    ("render", "camera"): ("cameras",),
    ("depth_at", "camera"): ("cameras",),
    ("transmittance_at", "camera"): ("cameras",),
    ("render_normals", "camera"): ("cameras",),
    ("Rays", "origins"): ("tensor",),
    ("Rays", "directions"): ("tensor",),
    ("Rays", "near"): ("tensor",),
    ("Rays", "far"): ("tensor",),
    ("TransferFunction()", "scalar"): ("tensor",),
}


@pytest.mark.parametrize(("call", "name"), [(call, name) for call, (_, _, names) in CALLS.items() for name in names])
def test_junk_is_refused_in_one_sentence(call: str, name: str) -> None:
    function, arguments, _ = CALLS[call]
    for what, value in JUNK.items():
        if what in ACCEPTED.get((call, name), ()):
            continue
        with pytest.raises(DiffTetError) as error:
            function(**{**arguments, name: value})
        assert_sentence(error.value)
        assert "tensor([" not in str(error.value), what


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera": [CAMERA, None]}, r"camera is .*Camera.*; pass a difftetvr\.Camera, a list"),
        ({"camera": CAMERA.world_to_camera}, r"camera is a tensor .*; pass a difftetvr\.Camera, a list"),
        ({"background": (0.1, 0.2)}, r"background is \(0.1, 0.2\); give three finite"),
        (
            {"field": Field(FIELD.color[:, :2], FIELD.density), "background": (0.1,)},
            "one finite number for each of 2",
        ),
        ({"field": [FIELD, FIELD]}, "field is .*Field.*; pass one"),
        ({"field": FIELD.color}, "field is a tensor"),
        ({"field": None}, "field is None"),
        ({"mesh": (MESH.vertices, MESH.tets)}, "mesh is "),
        ({"optics": "exact"}, r"optics is 'exact'; .*ExactLinear\(\)"),
        ({"optics": ExactLinear}, r"optics is the class ExactLinear"),
        ({"deterministic": "no"}, "deterministic is 'no'; pass True or False"),
        ({"renderer": 3}, "no renderer 3; choose one of marching"),
        ({"transmittance_threshold": "1e-4"}, "transmittance_threshold is '1e-4'"),
        ({"background": torch.rand(8, 8, 3)}, r"background is a tensor of shape \(8, 8, 3\)"),
        ({"background": (math.nan, 0.0, 0.0)}, r"background is \(nan, 0.0, 0.0\)"),
        ({"clip_plane": torch.rand(2, 4)}, r"clip_plane is a tensor of shape \(2, 4\)"),
    ],
)
def test_the_argument_is_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(DiffTetError, match=words):
        render(**{**RENDER, **change})


@pytest.mark.parametrize("name", ["a" * 5000 + ".vtu", "/".join(["folder"] * 1000), "a\0b.vtu", "a" * 200 + ".vtu"])
def test_names_that_no_file_can_have_are_no_files(name: str) -> None:
    for path in (name, Path(name)):
        with pytest.raises(DiffTetError, match=r"There is no mesh file .*; check the path\.") as error:
            load(path)
        assert_sentence(error.value)


@pytest.mark.parametrize("vertices", [MESH.vertices.to("meta"), MESH.vertices.to_sparse()])
def test_meshes_need_tensors_that_hold_their_values(vertices: torch.Tensor) -> None:
    with pytest.raises(DiffTetError, match=r"The vertices are a torch\.\w+ tensor on '\w+'.*; pass a dense tensor"):
        TetMesh(vertices, MESH.tets)
    with pytest.raises(DiffTetError, match=r"The cells are a torch\.strided tensor on 'meta'"):
        TetMesh(MESH.vertices, MESH.tets.to("meta"))


def test_batches_of_values_are_refused() -> None:
    with pytest.raises(DiffTetError, match=r"color has shape \(5, 27, 3\); pass linear RGB of shape \(N, 3\)"):
        Field(torch.rand(5, COUNT, 3), torch.rand(5, COUNT))
    with pytest.raises(DiffTetError, match=r"scalars have shape \(5, 27\)"):
        ScalarField(torch.rand(5, COUNT), FUNCTION)
    with pytest.raises(DiffTetError, match=r"world_to_camera has shape \(5, 4, 4\)"):
        CAMERA.with_pose(torch.eye(4).expand(5, 4, 4))


def test_hats_need_a_field() -> None:
    with pytest.raises(DiffTetError, match=r"field is a tensor of shape .*; pass a difftetvr\.Field"):
        model_image(MESH, FIELD.density, CAMERA, torch.zeros(8, 8, 3))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy"])
def test_intrinsics_that_require_a_gradient_get_one(name: str) -> None:
    value = torch.tensor(4.5, requires_grad=True)
    camera = Camera(**{**POSE, name: value}, width=8, height=8).with_size(16, 8).with_pose(CAMERA.world_to_camera)
    render(MESH, FIELD, camera).color.sum().backward()
    assert value.grad is not None
    assert float(value.grad) != 0.0
    assert Camera(**{**POSE, name: value.detach()}, width=8, height=8).intrinsics is None


def test_arrays_lists_and_scalars_of_numpy_are_taken() -> None:
    camera = Camera(np.eye(4), np.float32(9), torch.tensor(9.0), np.float64(4), 4, np.int64(8), torch.tensor(8))
    assert camera.width == 8 and camera.fx == 9.0 and camera.world_to_camera.dtype == torch.float64
    field = Field(FIELD.color.numpy(), FIELD.density.tolist())
    image = render(MESH, field, CAMERA, background=np.array([1, 0, 0]), clip_plane=np.array([0, 0, 1, 5]))
    assert torch.equal(image.color, render(MESH, FIELD, CAMERA, background=(1, 0, 0)).color)
    function = TransferFunction(**{key: np.array(value) for key, value in POINTS.items()})
    assert all(t.dtype == torch.float32 for t in (function.scalar, function.opacity, function.color))
    scalar = ScalarField(FIELD.density.half(), function, np.float32(2.0), value_range=np.array([0, 1]))
    assert scalar.scalar.dtype == torch.float64 and scalar.value_range == (0.0, 1.0)
