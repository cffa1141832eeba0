"""Arrays in HDF5: what lies in the file or beside it is read, what leads elsewhere or is a bomb is refused."""

import os
import sys

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.errors import MeshError
from difftetvr.mesh.io import hdf5, load_data

h5py = pytest.importorskip("h5py")
meshio = pytest.importorskip("meshio")

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])

XDMF = """<Xdmf Version="3.0"><Domain><Grid Name="g"><Geometry Type="XYZ">
<DataItem Dimensions="5 3" Format="HDF">a.h5:/points</DataItem></Geometry><Topology Type="Tetrahedron">
<DataItem Dimensions="2 4" NumberType="Int" Format="HDF"> a.h5:/cells/0 </DataItem></Topology>
<Attribute Name="p" Center="Node"><DataItem Dimensions="5 1" Format="HDF">a.h5:/p</DataItem></Attribute>
</Grid></Domain></Xdmf>"""


@pytest.fixture
def inside(tmp_path):
    """A folder with a file, in which ``p`` is missing."""
    folder = tmp_path / "inside"
    folder.mkdir()
    (folder / "a.xdmf").write_text(XDMF)
    with h5py.File(folder / "a.h5", "w") as file:
        file["points"] = POINTS
        file["cells/0"] = TETS
        file["q"] = np.arange(5.0)[:, None]
    return folder


def change(path):
    return h5py.File(path, "a")


def test_arrays_in_the_file_and_beside_it(inside):
    """Links in the file, and links to files that may be read, are followed."""
    with h5py.File(inside / "b.h5", "w") as file:
        file["group/x"] = np.arange(5.0)[:, None]
    for link in (h5py.SoftLink("/q"), h5py.SoftLink("there/x"), h5py.ExternalLink("b.h5", "group/x")):
        with change(inside / "a.h5") as file:
            if "there" not in file:
                file["there"] = h5py.ExternalLink("b.h5", "/group")
            if "p" in file:
                del file["p"]
            file["p"] = link
        found = load_data(inside / "a.xdmf", torch.float64)
        assert torch.equal(found.mesh.vertices, torch.from_numpy(POINTS))
        assert found.point_data["p"].tolist() == [0, 1, 2, 3, 4]


def external(file, outside):
    file["p"] = h5py.ExternalLink(str(outside), "x")


def relative(file, outside):
    file["p"] = h5py.ExternalLink(f"../{outside.name}", "x")


def soft_to_external(file, outside):
    file["links/out"] = h5py.ExternalLink(str(outside), "/")
    file["p"] = h5py.SoftLink("/links/out/x")


def raw(file, outside):
    file.create_dataset("p", (5, 1), "f8", external=[(str(outside), 0, 40)])


def virtual(file, outside):
    layout = h5py.VirtualLayout((5, 1), "f8")
    layout[:] = h5py.VirtualSource(str(outside), "x", (5, 1))
    file.create_virtual_dataset("p", layout)


def through_group(file, outside):
    file["g"] = h5py.ExternalLink(str(outside), "/")
    file["p"] = h5py.SoftLink("g/x")


def huge(file, _):
    file.create_dataset("p", (4 * 10**8,), "f8", fillvalue=1.0, chunks=(10**6,))


def huge_but_begun(file, _):
    file.create_dataset("p", (4 * 10**8,), "f8", fillvalue=1.0, chunks=(10,))[:5] = 1.0


def circle(file, _):
    file["p"], file["other"] = h5py.SoftLink("/other"), h5py.SoftLink("/p")


def words(file, _):
    file["p"] = np.array([b"x"] * 5)


LEADS_OUT = "lies outside of its folder|from another file"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *((make, LEADS_OUT) for make in (external, relative, soft_to_external, raw, virtual, through_group)),
        (huge, "announced but never written"),
        (huge_but_begun, "--allow-large|of memory can be used"),
        (circle, "its links go in circles"),
        (words, "no array of numbers"),
        (lambda file, _: file.create_group("p"), "no array of numbers"),
        (lambda file, _: None, "there is no array '/p'"),
    ],
)
def test_what_leads_elsewhere_is_refused(inside, tmp_path, make, message):
    outside = tmp_path / "secret.h5"
    with h5py.File(outside, "w") as file:
        file["x"] = np.full((5, 1), 42.0)
    with change(inside / "a.h5") as file:
        make(file, outside)
    with hdf5.PlainFile(inside / "a.h5") as file, pytest.raises(MeshError, match=message):
        file.array("/p")


def test_a_root_that_the_user_gives_is_followed(inside, tmp_path):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = np.full((5, 1), 42.0)
    with change(inside / "a.h5") as file:
        file["p"] = h5py.ExternalLink("../b.h5", "x")
    with pytest.raises(MeshError, match="lies outside"):
        load_data(inside / "a.xdmf")
    with dtv.trusting(outside=tmp_path):
        assert load_data(inside / "a.xdmf").point_data["p"].tolist() == [42] * 5


def test_damaged_files_are_a_sentence(inside):
    with change(inside / "a.h5") as file:
        file["p"] = file["q"]
    content = (inside / "a.h5").read_bytes()
    for damage in (content[:100], content[: len(content) // 2], b"", os.urandom(500)):
        (inside / "a.h5").write_bytes(damage)
        with pytest.raises(MeshError, match=r"a\.h5 cannot be read"):
            hdf5.PlainFile(inside / "a.h5").array("/p")
    (inside / "a.h5").unlink()
    with pytest.raises(MeshError, match=r"'a\.h5', which is not there; put it beside it"):
        load_data(inside / "a.xdmf")


def test_missing_packages_are_named(inside, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    (inside / "a.med").write_bytes(b"x")
    for name in ("a.xdmf", "a.med"):
        with pytest.raises(MeshError, match=r"h5py reads; install it with pip install 'difftetvr\[hdf5\]'"):
            load_data(inside / name)


@pytest.mark.parametrize("make", [None, external, raw, virtual, huge_but_begun])
def test_files_of_meshios_formats_are_looked_through_first(tmp_path, make):
    path = tmp_path / "a.med"
    meshio.Mesh(POINTS, [("tetra", TETS)]).write(path)
    if make is None:
        assert load_data(path).mesh.num_cells == 2
        return
    with change(path) as file:
        make(file, tmp_path.parent / "secret.h5")
    with hdf5.PlainFile(path) as file, pytest.raises(MeshError, match=f"{LEADS_OUT}|--allow-large|memory can be used"):
        file.require_plain()
    with pytest.raises(MeshError, match=r"a\.med"):
        load_data(path)


def test_what_meshio_writes_in_steps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with meshio.xdmf.TimeSeriesWriter("a.xdmf") as writer:
        writer.write_points_cells(POINTS, [("tetra", TETS)])
        for step in range(3):
            writer.write_data(step / 4, point_data={"u": POINTS[:, 0] * step}, cell_data={"c": [np.full(2, step)]})
    found = load_data("a.xdmf")
    assert found.point_data["u"].tolist() == [0, 2, 0, 0, 2] and found.cell_data["c"].tolist() == [2, 2]
    assert "number 2 at time 0.5" in found.warnings[0]
    assert load_data("a.xdmf", step=0).cell_data["c"].tolist() == [0, 0]
