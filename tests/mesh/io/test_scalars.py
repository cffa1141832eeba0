"""Scalars of a file by name: components, invariants, places, and cells that have no value."""

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.mesh.io import MeshData, array_names, array_of, load_data, scalar_of

MESH = dtv.TetMesh.grid((2, 2, 2))
POINTS, CELLS = MESH.num_vertices, MESH.num_cells


def data_of(point=None, cell=None):
    return MeshData(MESH, None, point or {}, cell or {})


def test_components_and_invariants():
    velocity = torch.rand(POINTS, 3)
    stress = torch.rand(CELLS, 3, 3, dtype=torch.float64)
    symmetric = 0.5 * (stress + stress.transpose(1, 2))
    six = torch.stack([symmetric[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))], 1)
    data = data_of({"v": velocity}, {"s6": six, "s9": stress.flatten(1), "s": stress, "n": torch.arange(CELLS)})
    for name, expected in (
        ("v", velocity.norm(dim=1)),
        ("v:magnitude", velocity.norm(dim=1)),
        ("v:1", velocity[:, 1]),
        ("v:z", velocity[:, 2]),
        ("point:v:x", velocity[:, 0]),
        ("s:xy", stress[:, 0, 1]),
        ("s9:7", stress[:, 2, 1]),
        ("s6:yz", symmetric[:, 1, 2]),
        ("s6:magnitude", symmetric.flatten(1).norm(dim=1)),
        ("s9:trace", stress.diagonal(dim1=1, dim2=2).sum(1)),
        ("n", torch.arange(CELLS, dtype=torch.float64)),
    ):
        assert torch.allclose(scalar_of(data, name).values.double(), expected.double()), name
    deviator = symmetric - symmetric.diagonal(dim1=1, dim2=2).mean(1)[:, None, None] * torch.eye(3)
    mises = (1.5 * deviator.square().sum((1, 2))).sqrt()
    for name in ("s6:von-mises", "s9:von-mises", "s:von-mises"):
        found = scalar_of(data, name)
        assert torch.allclose(found.values, mises) and found.location == "cell" and "von-mises" in found.name
    for name, message in (
        ("v:3", r"no component '3'; its components are 0 to 2, x, y, z, magnitude"),
        ("v:von-mises", "no component"),
        ("n:1", "no component"),
        ("w", r"there is no scalar 'w' \(found: n, s, s6, s9, v\)"),
        (None, "several scalars"),
    ):
        with pytest.raises(dtv.MeshError, match=message):
            scalar_of(data, name)


def test_data_of_points_and_cells_with_one_name_are_told_apart():
    data = data_of({"p": torch.zeros(POINTS), "a:b": torch.ones(POINTS)}, {"p": torch.ones(CELLS)})
    assert scalar_of(data, "point:p").location == "vertex" and scalar_of(data, "cell:p").location == "cell"
    assert scalar_of(data, "a:b").values.sum() == POINTS
    with pytest.raises(dtv.MeshError, match="both its points and its cells have data 'p'"):
        scalar_of(data, "p")
    with pytest.raises(dtv.MeshError, match=r"several scalars \(a:b, cell:p, point:p\)"):
        scalar_of(data)


def test_cells_without_a_value_are_taken_out():
    values = MESH.vertices[:, 0].clone()
    values[5], values[9] = torch.nan, torch.inf
    found = scalar_of(data_of({"p": values}))
    lost = ((MESH.tets == 5) | (MESH.tets == 9)).any(1)
    assert found.missing == int(lost.sum()) > 0 and found.mesh.num_cells == CELLS - found.missing
    assert torch.equal(found.values, found.mesh.vertices[:, 0])
    found.mesh.topology.cell_adjacency  # noqa: B018  must be that of a valid mesh
    per_cell = torch.arange(CELLS).double()
    per_cell[3] = -torch.inf
    found = scalar_of(data_of(cell={"p": per_cell}))
    assert found.missing == 1 and 3.0 not in found.values.tolist()
    with pytest.raises(dtv.MeshError, match="finite in no cell"):
        scalar_of(data_of({"p": torch.full((POINTS,), torch.nan)}))


@pytest.mark.parametrize("size", [1e-300, 1e-30, 1e19, 3e38, 1e200, 1e307])
def test_invariants_neither_overflow_nor_underflow(size):
    dtype = torch.float32 if 1e-40 < size < 1e39 else torch.float64
    generator = torch.Generator().manual_seed(0)
    for columns, names in ((3, ["magnitude"]), (6, ["magnitude", "trace", "von-mises"]), (9, ["trace", "von-mises"])):
        values = torch.rand(POINTS, columns, generator=generator, dtype=torch.float64)
        values[0] = 0.0
        for name in names:
            expected = size * scalar_of(data_of({"a": values}), f"a:{name}").values
            found = scalar_of(data_of({"a": (size * values).to(dtype)}), f"a:{name}")
            assert found.missing == 0 and torch.allclose(found.values, expected, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize(
    ("kind", "least"), [("i8", 1_700_000_000_000_000_000), ("i8", -(2**63)), ("u8", 2**63 - 3), ("u8", 2**64 - 2**12)]
)
def test_large_integers_lose_their_offset_before_they_are_rounded(kind, least, tmp_path):
    expected = 3 * np.arange(POINTS)
    values = np.array([least + n for n in expected.tolist()], kind)
    np.savez(tmp_path / "a.npz", vertices=MESH.vertices.numpy(), tets=MESH.tets.numpy(), p=values)
    data = load_data(tmp_path / "a.npz")
    assert data.point_data["p"].tolist() == values.tolist()
    found = scalar_of(data)
    assert found.values.tolist() == expected.tolist() and found.offset == least
    assert found.counted_from_offset(float(2**60)) == float(2**60 - least)
    both = scalar_of(data_of({"p": torch.from_numpy(np.stack((values, values[::-1].copy()), 1))}), "p:1")
    assert both.values.tolist() == expected[::-1].tolist()


def test_integers_over_their_whole_range_and_small_ones():
    ends = torch.full((POINTS,), 2**63 - 1)
    ends[0] = -(2**63)
    found = scalar_of(data_of({"p": ends}))
    assert found.values[0] == 0.0 and found.values[1] == 2.0**64
    found = scalar_of(data_of({"p": torch.arange(POINTS) + 2**53 - POINTS + 1}))
    assert found.offset == 0 and found.values[-1] == 2.0**53 and found.counted_from_offset(0.1) == 0.1


def test_arrays_keep_their_components():
    velocity, stress = torch.rand(POINTS, 3), torch.rand(CELLS, 3, 3)
    data = data_of({"v": velocity, "p": torch.rand(POINTS)}, {"s": stress, "p": torch.arange(CELLS)})
    assert array_names(data) == ["v", "point:p", "s", "cell:p"]
    assert [tuple(array_of(data, name).values.shape) for name in array_names(data)] == [
        *((POINTS, 3), (POINTS,), (CELLS, 9), (CELLS,))
    ]
    assert torch.equal(array_of(data, "v").values, velocity) and array_of(data, "v").name == "v"
    assert torch.equal(array_of(data, "s").values, stress.flatten(1))
    assert torch.equal(array_of(data, "v:x").values, velocity[:, 0])
    assert torch.equal(array_of(data, "v:magnitude").values, scalar_of(data, "v").values)
    with pytest.raises(dtv.MeshError, match="several scalars"):
        array_of(data)
    assert array_of(data_of({"v": velocity})).name == "v"


def test_cells_without_all_of_a_vector_are_left_out():
    velocity = torch.rand(POINTS, 3)
    velocity[5, 1] = torch.nan
    found = array_of(data_of({"v": velocity}), "v")
    assert found.missing == int((MESH.tets == 5).any(1).sum()) > 0
    assert found.mesh.num_cells == CELLS - found.missing
    assert torch.equal(found.values, velocity[found.vertices])
    assert torch.equal(found.mesh.vertices, MESH.vertices[found.vertices])
    assert array_of(data_of({"v": velocity}), "v:x").vertices is None
