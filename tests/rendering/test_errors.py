"""Bad input to ``render``: one sentence that says what is wrong, never a crash of the kernels."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from oracle.scenes import SCENES
from rendering.helpers import assert_sentence

from difftetvr.errors import CameraError, DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import render
from difftetvr.rendering.cameras.pinhole import Camera


@pytest.fixture
def inputs() -> tuple[TetMesh, Field, Camera]:
    scene = SCENES["single"]()
    return TetMesh(scene.vertices, scene.tets), Field(scene.color, scene.density), scene.camera


Inputs = tuple[TetMesh, Field, Camera]


def _with(tensor: torch.Tensor, index: tuple[int, ...], value: float) -> torch.Tensor:
    changed = tensor.clone()
    changed[index] = value
    return changed


BAD_FIELDS: dict[str, Callable[[Field], Field]] = {
    "too few values": lambda f: Field(f.color[:3], f.density[:3]),
    "too many values": lambda f: Field(f.color.repeat(2, 1), f.density.repeat(2)),
    "cell values declared per vertex": lambda f: Field(f.color[:1], f.density[:1], "vertex"),
    "vertex values declared per cell": lambda f: Field(f.color, f.density, "cell"),
    "NaN color": lambda f: Field(_with(f.color, (2, 1), math.nan), f.density),
    "infinite color": lambda f: Field(_with(f.color, (2, 1), math.inf), f.density),
    "NaN density": lambda f: Field(f.color, _with(f.density, (3,), math.nan)),
    "infinite density": lambda f: Field(f.color, _with(f.density, (3,), math.inf)),
    "negative density": lambda f: Field(f.color, _with(f.density, (3,), -0.1)),
    "lengths that differ": lambda f: Field(f.color, f.density[:2]),
    "matrix of densities": lambda f: Field(f.color, f.density[:, None]),
}


@pytest.mark.parametrize("what", BAD_FIELDS)
def test_bad_field(inputs: Inputs, what: str) -> None:
    mesh, field, camera = inputs
    with pytest.raises(MeshError) as error:
        render(mesh, BAD_FIELDS[what](field), camera)
    assert_sentence(error.value)


@pytest.mark.parametrize("what", ["NaN color", "negative density"])
def test_bad_value_is_named(inputs: Inputs, what: str) -> None:
    mesh, field, camera = inputs
    index = {"NaN color": "2", "negative density": "3"}[what]
    with pytest.raises(MeshError, match=rf"\b{index}\b"):
        render(mesh, BAD_FIELDS[what](field), camera)


def test_unknown_renderer_names_those_that_exist(inputs: Inputs) -> None:
    with pytest.raises(DiffTetError, match=r"'raymarch'.*marching") as error:
        render(*inputs, renderer="raymarch")
    assert_sentence(error.value)


@pytest.mark.parametrize("background", [torch.zeros(4), torch.zeros(1, 3), torch.zeros(()), (1.0, 2.0)])
def test_bad_background(inputs: Inputs, background: object) -> None:
    with pytest.raises(DiffTetError, match="background") as error:
        render(*inputs, background=background)  # type: ignore[arg-type]
    assert_sentence(error.value)


def test_background_may_be_three_numbers(inputs: Inputs) -> None:
    image = render(*inputs, background=(0.5, 0.25, 1.0))
    corner = image.color[image.alpha == 0][0]
    assert corner.tolist() == [0.5, 0.25, 1.0]


@pytest.mark.parametrize("threshold", [-0.1, 1.0, 2.0, math.nan])
def test_bad_threshold(inputs: Inputs, threshold: float) -> None:
    with pytest.raises(DiffTetError, match="transmittance_threshold") as error:
        render(*inputs, transmittance_threshold=threshold)
    assert_sentence(error.value)


def test_half_precision_mesh_is_refused(inputs: Inputs) -> None:
    mesh, field, camera = inputs
    with pytest.raises(DiffTetError) as error:
        render(mesh.with_vertices(mesh.vertices.half()), field, camera)
    assert_sentence(error.value)


def test_bad_camera() -> None:
    with pytest.raises(CameraError, match="rigid") as error:
        Camera(2.0 * torch.eye(4), 10.0, 10.0, 5.0, 5.0, 10, 10)
    assert_sentence(error.value)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("inside", [False, True])
def test_positions_that_have_blown_up_end_in_an_error_or_an_image(inputs: Inputs, value: float, inside: bool) -> None:
    """``with_vertices`` does not validate; a diverged optimisation must not hang the kernels."""
    scene = SCENES["inside" if inside else "porous"]()
    mesh = TetMesh(scene.vertices, scene.tets)
    broken = mesh.with_vertices(_with(scene.vertices, (5, 1), value))
    try:
        image = render(broken, Field(scene.color, scene.density), scene.camera)
    except DiffTetError as error:
        assert_sentence(error)
    else:
        assert image.color.shape == (scene.camera.height, scene.camera.width, 3)
