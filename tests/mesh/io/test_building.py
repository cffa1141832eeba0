"""From a file's cells to a mesh: what is decided before rounding, and what becomes of broken ones."""

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.mesh.frame import WORLD

ECEF = np.array([4.2e6, 1.7e5, 4.78e6])


def write(path, vertices, tets, **data):
    np.savez(path, vertices=vertices, tets=tets, **data)
    return path


def grid(cells=3):
    mesh = dtv.TetMesh.grid((cells,) * 3, dtype=torch.float64)
    return mesh.vertices.numpy(), mesh.tets.numpy()


def test_a_file_in_map_coordinates_goes_round_to_the_bit(tmp_path):
    vertices, tets = grid()
    far = np.round(vertices + ECEF, 6)
    mesh = dtv.load_mesh(write(tmp_path / "far.npz", far, tets))
    assert mesh.vertices.dtype == torch.float32 and mesh.origin != WORLD
    dtv.save(tmp_path / "again.npz", mesh)
    again = dtv.load_mesh(tmp_path / "again.npz")
    assert again.origin == mesh.origin and torch.equal(again.vertices, mesh.vertices)
    single = (10 * vertices + ECEF).astype(np.float32)
    dtv.save(tmp_path / "single.vtu", dtv.load_mesh(write(tmp_path / "in.npz", single, tets)))
    stored = dtv.load_mesh(tmp_path / "single.vtu", torch.float64)
    assert np.array_equal(stored.vertices.numpy(), single.astype(np.float64))


def test_cells_that_single_precision_would_flatten_are_kept_in_double(tmp_path):
    vertices, tets = grid()
    vertices[:, 2] *= 1e-9
    vertices[:, 2] += 0.5
    path = write(tmp_path / "thin.npz", vertices, tets)
    data = dtv.load_data(path)
    assert data.mesh.vertices.dtype == torch.float64 and data.flat_cells == 0
    assert any("double precision" in said for said in data.warnings)
    with pytest.raises(dtv.MeshError, match=r"thin\.npz: in single precision, Cell \d+.*dtype=torch\.float64"):
        dtv.load_mesh(path, torch.float32)


def test_data_keep_the_precision_of_the_file(tmp_path):
    vertices, tets = grid()
    pressure = 101325.0 + 1e-3 * vertices[:, 0]
    data = dtv.load_data(write(tmp_path / "p.npz", vertices.astype(np.float32), tets, pressure=pressure))
    assert torch.equal(data.point_data["pressure"], torch.from_numpy(pressure))
    function = dtv.TransferFunction([0.0, 1.0], [0.0, 1.0], [[0, 0, 1], [1, 0, 0]])
    camera = dtv.Camera.look_at((2.0, -2.0, 2.0), (0.5, 0.5, 0.5), width=24, height=24)
    image = dtv.render(data.mesh, dtv.ScalarField(data.point_data["pressure"], function, 5.0), camera).color
    plain = dtv.render(data.mesh, dtv.ScalarField(data.mesh.vertices[:, 0], function, 5.0), camera).color
    assert (image - plain).abs().max() < 1e-4 < plain.max()


def broken_arrays():
    """Two boxes that overlap by a layer of cells, on common vertices; then flat, repeated and lost cells."""
    vertices, tets = grid(4)
    mirrored = vertices * [-1, 1, 1] + [1.75, 0, 0]
    points, index = np.unique(np.round(np.concatenate((vertices, mirrored)), 9), axis=0, return_inverse=True)
    cells = index.ravel()[np.concatenate((tets, tets + len(vertices)))]
    extra = [[0, 1, 2, 2], [0, 1, 5, len(points)], *cells[:2].tolist()]
    return np.vstack((points, [[np.nan, 0, 0]])), np.concatenate((cells, extra))


def test_broken_meshes_are_refused_unless_their_cells_may_be_loose(tmp_path):
    points, cells = broken_arrays()
    path = write(tmp_path / "broken.npz", points, cells, p=np.nan_to_num(points[:, 0]))
    with pytest.raises(dtv.MeshError, match="finite"):
        dtv.load_data(path, flat="drop")
    data = dtv.load_data(path, flat="drop", loose=True)
    assert (data.mesh.num_cells, data.mesh.is_conforming) == (768, False)
    found = data.defects
    assert (found.flat, found.not_finite, found.repeated) == (1, 1, 2)
    assert found.crowded_faces > 0 and found.folded_faces > 0
    assert len(data.warnings) == 4 and "Cells overlap" in data.warnings[-1]
    camera = dtv.Camera.look_at((3.0, -2.0, 2.0), (0.9, 0.5, 0.5), width=16, height=16)
    field = dtv.Field(torch.ones(data.mesh.num_vertices, 3), torch.ones(data.mesh.num_vertices))
    assert dtv.render(data.mesh, field, camera, renderer="linked-list").alpha.max() > 0.5


def test_bodies_that_were_pushed_into_each_other_are_named(tmp_path):
    vertices, tets = grid(4)
    both = np.concatenate((vertices, vertices * 0.5 + 0.7))
    data = dtv.load_data(write(tmp_path / "two.npz", both, np.concatenate((tets, tets + len(vertices)))))
    assert data.defects.doubled_places > 0
    assert [said for said in data.warnings if "no neighbours" in said]
    apart = np.concatenate((vertices, vertices * 0.5 + 1.7))
    data = dtv.load_data(write(tmp_path / "apart.npz", apart, np.concatenate((tets, tets + len(vertices)))))
    assert data.warnings == () and data.defects.doubled_places == 0


@pytest.mark.parametrize("suffix", ["vtu", "vtk", "xdmf", "npz"])
def test_named_data_are_saved_and_scalar_fields_first_of_all(tmp_path, suffix):
    mesh = dtv.TetMesh.grid((3, 2, 2))
    scalar = torch.rand(mesh.num_vertices, dtype=torch.float64)
    velocity, group = torch.rand(mesh.num_vertices, 3), torch.arange(mesh.num_cells)
    field = dtv.ScalarField(scalar.requires_grad_(), dtv.TransferFunction.default())
    path = tmp_path / f"a.{suffix}"
    dtv.save(path, mesh, field, point_data={"velocity": velocity}, cell_data={"group": group})
    data = dtv.load_data(path)
    assert torch.equal(data.point_data["scalar"], scalar.detach())
    assert torch.equal(data.point_data["velocity"], velocity) and torch.equal(data.cell_data["group"], group)
    per_cell = dtv.ScalarField(torch.rand(mesh.num_cells), dtv.TransferFunction.default(), location="cell")
    dtv.save(path, mesh, per_cell)
    assert torch.equal(dtv.load_data(path).cell_data["scalar"], per_cell.scalar)


def test_what_cannot_be_saved_is_refused(tmp_path):
    mesh = dtv.TetMesh.grid((3, 2, 2))
    field = dtv.ScalarField(torch.rand(mesh.num_vertices), dtv.TransferFunction.default())
    for suffix in ("ovm", "bintet", "node"):
        with pytest.raises(dtv.MeshError, match=r"holds no data but colour and density; use one of \.vtu"):
            dtv.save(tmp_path / f"a.{suffix}", mesh, field)
    with pytest.raises(dtv.MeshError, match="have the name of what the field is saved as"):
        dtv.save(tmp_path / "a.vtu", mesh, field, point_data={"scalar": torch.zeros(mesh.num_vertices)})
    for wrong in (
        torch.zeros(5),
        torch.zeros(mesh.num_vertices, 0),
        torch.zeros(mesh.num_vertices).cfloat(),
        np.array(["a"] * mesh.num_vertices),
    ):
        with pytest.raises(dtv.MeshError, match="the data 'x' are"):
            dtv.save(tmp_path / "a.vtu", mesh, point_data={"x": wrong})
    assert not list(tmp_path.iterdir())
