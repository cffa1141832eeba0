"""Colours that depend on the direction: the basis, the field, files."""

import itertools
import math

import numpy as np
import pytest
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.harmonics import COUNTS, harmonic_basis, seen_colors
from difftetvr.mesh.io import load, load_data, save


def directions(count: int = 4000) -> torch.Tensor:
    """Points of a Fibonacci spiral, which integrates smooth functions over the sphere well."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * index / count
    angle = index * math.pi * (1.0 + math.sqrt(5.0))
    radius = (1.0 - z * z).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z), 1)


def test_the_basis_is_orthonormal_and_has_mean_zero():
    basis = harmonic_basis(directions(), 3)
    assert basis.shape[1] == COUNTS[3]
    products = 4.0 * math.pi * basis.T @ basis / len(basis)
    assert torch.allclose(products, torch.eye(15, dtype=torch.float64), atol=2e-3)
    assert float(basis.mean(0).abs().max()) < 1e-3


def test_bands_are_spanned_after_any_rotation():
    """A rotation mixes functions within their bands only, as it does for harmonics and no other polynomials."""
    points = directions(500)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    before, after = harmonic_basis(points, 3), harmonic_basis(points @ rotation.T, 3)
    for first, last in itertools.pairwise(COUNTS):
        band = before[:, first:last]
        fit = torch.linalg.lstsq(band, after[:, first:last]).solution
        assert torch.allclose(band @ fit, after[:, first:last], atol=1e-10)


@pytest.mark.parametrize("degree", range(4))
def test_lower_degrees_are_the_beginning(degree):
    points = directions(50)
    assert torch.equal(harmonic_basis(points, degree), harmonic_basis(points, 3)[:, : COUNTS[degree]])


def directional_field(mesh: TetMesh, location: str, degree: int = 2) -> Field:
    count = mesh.num_vertices if location == "vertex" else mesh.num_cells
    generator = torch.Generator().manual_seed(0)
    color, density = torch.rand(count, 3, generator=generator), torch.rand(count, generator=generator)
    return Field(color, density, location, 0.1 * torch.randn(count, COUNTS[degree], 3, generator=generator))


@pytest.mark.parametrize("location", ["vertex", "cell"])
def test_a_field_seen_from_a_point(location):
    mesh = TetMesh.grid((2, 2, 2))
    field = directional_field(mesh, location)
    eye = torch.tensor([3.0, -1.0, 0.5])
    places = mesh.vertices if location == "vertex" else mesh.vertices[mesh.tets.long()].mean(1)
    for i in (0, 5, 11):
        direction = (places[i] - eye) / (places[i] - eye).norm()
        expected = field.color[i] + harmonic_basis(direction[None], 2)[0] @ field.harmonics[i]
        assert torch.allclose(field.seen_from(mesh, eye).color[i], expected.clamp(min=0), atol=1e-6)
    assert field.seen_from(mesh, eye).harmonics is None
    plain = Field(field.color, field.density, location)
    assert plain.seen_from(mesh, eye) is plain


@pytest.mark.parametrize("vectors", [1, 12])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_derivatives_of_seen_colours(degree, vectors):
    generator = torch.Generator().manual_seed(degree)
    color, harmonics, along = (
        torch.randn(shape, generator=generator, dtype=torch.float64).requires_grad_()
        for shape in ((12, 3), (12, COUNTS[degree], 3), (vectors, 3))
    )
    seen = seen_colors(color, harmonics, along)
    assert (seen == 0).any() and (seen > 0).any()
    assert torch.autograd.gradcheck(seen_colors, (color, harmonics, along))


def test_a_colour_at_0_can_rise_and_one_below_cannot():
    color = torch.tensor([[0.0, -1.0, 1.0]], requires_grad=True)
    seen_colors(color, torch.zeros(1, 3, 3), torch.ones(1, 3)).sum().backward()
    assert color.grad.tolist() == [[1.0, 0.0, 1.0]]


def test_seen_colours_that_are_not_numbers_none_at_all_and_no_direction():
    color = torch.tensor([[torch.nan, 0.5, 0.5]])
    assert seen_colors(color, torch.zeros(1, 3, 3), torch.ones(1, 3)).isnan().tolist() == [[True, False, False]]
    assert seen_colors(color[:0], torch.zeros(0, 3, 3), torch.ones(1, 3)).shape == (0, 3)
    nowhere = torch.zeros(1, 3, requires_grad=True)
    seen = seen_colors(torch.rand(1, 3), torch.ones(1, 8, 3), nowhere)
    seen.sum().backward()
    assert seen.isfinite().all() and nowhere.grad.isfinite().all()


@pytest.mark.parametrize("suffix", [".vtu", ".npz"])
@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("location", ["vertex", "cell"])
def test_files_keep_every_bit(tmp_path, location, degree, suffix):
    mesh = TetMesh.grid((2, 1, 1))
    field = directional_field(mesh, location, degree)
    save(tmp_path / f"a{suffix}", mesh, field)
    loaded = load(tmp_path / f"a{suffix}")[1]
    assert loaded.location_on(mesh) == location
    for name in ("color", "density", "harmonics"):
        assert torch.equal(getattr(loaded, name), getattr(field, name)), name


def test_formats_without_directions_say_so(tmp_path):
    mesh = TetMesh.grid((1, 1, 1))
    for suffix in (".vtk", ".msh", ".bintet", ".ovm", ".node", ".xdmf"):
        with pytest.raises(MeshError, match="harmonics"):
            save(tmp_path / f"a{suffix}", mesh, directional_field(mesh, "vertex"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("shape", [(8, 3, 2), (8, 4, 3), (7, 3, 3), (8, 3)])
def test_wrong_shapes(shape):
    with pytest.raises(MeshError, match="harmonics have shape"):
        Field(torch.ones(8, 3), torch.ones(8), harmonics=torch.zeros(shape))


def test_harmonics_must_be_finite():
    mesh = TetMesh.grid((1, 1, 1))
    harmonics = torch.zeros(8, 3, 3)
    harmonics[5, 1, 2] = torch.inf
    with pytest.raises(MeshError, match="harmonics of vertex 5"):
        Field(torch.ones(8, 3), torch.ones(8), "vertex", harmonics).validate(mesh)


def test_a_damaged_array_of_harmonics(tmp_path):
    mesh = TetMesh.grid((1, 1, 1))
    arrays = {"vertices": mesh.vertices.numpy(), "tets": mesh.tets.numpy()}
    arrays |= {"color": torch.ones(8, 3).numpy(), "density": torch.ones(8).numpy()}
    np.savez(tmp_path / "a.npz", harmonics=torch.ones(8, 10).numpy(), **arrays)
    with pytest.raises(MeshError, match="harmonics"):
        load(tmp_path / "a.npz")
    assert load_data(tmp_path / "a.npz").field is None


def test_moving_to_another_precision():
    field = directional_field(TetMesh.grid((1, 1, 1)), "vertex").to(dtype=torch.float64)
    assert field.harmonics.dtype == torch.float64
