"""Fields: where they live, and what they refuse."""

import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh

MESH = TetMesh.grid((2, 2, 2))


def field(count, **kwargs):
    return Field(torch.rand((count, 3)), torch.rand(count), **kwargs)


def test_location_follows_from_the_length():
    assert field(MESH.num_vertices).location_on(MESH) == "vertex"
    assert field(MESH.num_cells).location_on(MESH) == "cell"
    with pytest.raises(MeshError, match="5 values, but this mesh needs 27 for one per vertex or 48 for one per cell"):
        field(5).location_on(MESH)
    with pytest.raises(MeshError, match="27 values, but this mesh needs 48 for one per cell"):
        field(MESH.num_vertices, location="cell").location_on(MESH)


def test_ambiguous_length_is_per_vertex_unless_said():
    unused = torch.zeros((MESH.num_cells - MESH.num_vertices, 3))
    square = TetMesh(torch.cat((MESH.vertices, unused)), MESH.tets)
    assert square.num_vertices == square.num_cells
    assert field(square.num_cells).location_on(square) == "vertex"
    assert field(square.num_cells, location="cell").location_on(square) == "cell"


@pytest.mark.parametrize(
    ("color", "density", "message"),
    [
        (torch.rand(5), torch.rand(5), r"color has shape \(5,\)"),
        (torch.rand(5, 65), torch.rand(5), r"color has shape \(5, 65\)"),
        (torch.rand(5, 3), torch.rand(4), r"density has shape \(4,\)"),
        (torch.rand(5, 3), torch.rand(5, 1), r"density has shape \(5, 1\)"),
        (torch.rand(5, 3).bool(), torch.rand(5), "torch.bool"),
        ("red", torch.rand(5), "real numbers"),
    ],
)
def test_wrong_shapes(color, density, message):
    with pytest.raises(MeshError, match=message):
        Field(color, density)


def test_unknown_location():
    with pytest.raises(MeshError, match="'face'"):
        field(5, location="face")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("color", float("nan"), "The color of vertex 7 is"),
        ("density", float("inf"), "The density of vertex 7 is inf"),
        ("density", -0.5, "The density of vertex 7 is -0.5; densities must not be negative"),
    ],
)
def test_validate_names_the_first_bad_value(name, value, message):
    bad = field(MESH.num_vertices)
    bad.validate(MESH)
    getattr(bad, name)[7:9] = value
    with pytest.raises(MeshError, match=message):
        bad.validate(MESH)


def test_array_likes_dtypes_and_graph():
    made = Field([[0, 1, 0]], [1])
    assert made.color.dtype == made.density.dtype == torch.float32
    assert len(made) == 1
    color = torch.rand((4, 3), dtype=torch.float64, requires_grad=True)
    kept = Field(color, torch.rand(4))
    assert kept.color is color
    moved = kept.to(dtype=torch.float32)
    assert moved.color.dtype == torch.float32
    moved.color.sum().backward()
    assert torch.equal(color.grad, torch.ones_like(color))
