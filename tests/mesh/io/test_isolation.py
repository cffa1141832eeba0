"""Readers in a process of their own: what they return, raise, or do to that process."""

import os
import sys

import numpy as np
import pytest

import difftetvr as dtv
from difftetvr.errors import MeshError
from difftetvr.mesh.io import isolation, load_data
from difftetvr.mesh.io.content import CellBlock, Content
from difftetvr.mesh.io.formats import through_meshio

READERS = """
import os, numpy as np
from difftetvr.errors import MeshError
from difftetvr.mesh.io.content import CellBlock, Content
from difftetvr.trust import current_trust

def good(path, step):
    print("noise")
    block = CellBlock("tetra", np.array([[0, 1, 2, 3]]), np.array([0]))
    data = {"a/b": np.arange(4, dtype=np.float32), "words": np.array(["x"] * 4, object)}
    notes = (f"step {step}", f"{current_trust()}")
    return Content(np.eye(4)[:, :3], (block,), data, {"c": np.array([[1, 2]])}, notes)

def sentence(path, step):
    raise MeshError(f"{path} is wrong.")

def other(path, step):
    raise KeyError("nothing")

def loop(path, step):
    while True:
        pass

def memory(path, step):
    return bytearray(2**40)

def crash(path, step):
    os.abort()
"""


@pytest.fixture
def readers(tmp_path, monkeypatch):
    folder = tmp_path / "readers"
    folder.mkdir()
    (folder / "readers_of_this_test.py").write_text(READERS)
    monkeypatch.syspath_prepend(str(folder))
    import readers_of_this_test

    yield readers_of_this_test
    del sys.modules["readers_of_this_test"]


@pytest.fixture
def path(tmp_path):
    (tmp_path / "a.xyz").write_bytes(b"some")
    return tmp_path / "a.xyz"


def test_what_a_reader_returns_comes_back(readers, path, capfd):
    with dtv.trusting(outside=path.parent, large=True):
        found = isolation.isolated(readers.good, path, -2)
    assert found.vertices.tolist() == np.eye(4)[:, :3].tolist()
    (block,) = found.cells
    assert (block.kind, block.nodes.tolist(), block.rows.tolist()) == ("tetra", [[0, 1, 2, 3]], [0])
    assert found.point_data["a/b"].dtype == np.float32 and found.cell_data["c"].tolist() == [[1, 2]]
    assert found.point_data["words"].shape == (4, 0)  # objects are not handed on
    assert found.notes[0] == "step -2" and "large=True" in found.notes[1] and str(path.parent) in found.notes[1]
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(os.name != "posix", reason="limits and signals are those of POSIX")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sentence", r"a\.xyz is wrong\.$"),
        ("other", r"a\.xyz cannot be read as a mesh \('nothing'\)"),
        ("loop", r"a\.xyz took its reader more than 1 s of computing"),
        pytest.param(
            "memory",
            r"a\.xyz takes its reader more memory than .* GiB; .*--allow-large",
            marks=pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits memory"),
        ),
        ("crash", r"a\.xyz made its reader break off \(exit code -6\)"),
    ],
)
def test_whatever_a_reader_does_is_one_sentence(readers, path, monkeypatch, name, message):
    monkeypatch.setattr(isolation, "SECONDS", 1.0 if name == "loop" else 60.0)
    with pytest.raises(MeshError, match=message) as caught:
        isolation.isolated(getattr(readers, name), path)
    assert "\n" not in str(caught.value)


def test_no_folder_is_left_behind(readers, path, tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    isolation.isolated(readers.good, path)
    assert list((tmp_path / "temporary").iterdir()) == []


def test_modules_beside_a_file_are_not_imported(readers, path, monkeypatch):
    """Whoever sends a folder could put a module there that has the name of one that readers import."""
    (path.parent / "numpy.py").write_text("raise SystemExit('run')")
    monkeypatch.chdir(path.parent)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    assert isolation.isolated(readers.good, path).notes[0] == "step None"


def test_files_that_meshio_would_wait_for(tmp_path):
    """Its readers ask for lines after the end, for ever; an intact file of the same kinds is read."""
    meshio = pytest.importorskip("meshio")
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
    for suffix in (".mdpa", ".tec", ".su2"):
        path = tmp_path / f"a{suffix}"
        meshio.Mesh(points, [("tetra", [[0, 1, 2, 3], [1, 2, 3, 4]])]).write(path)
        assert load_data(path).mesh.num_cells == 2
    for name, content in (("b.mdpa", b"Begin Nodes\n"), ("b.tec", (tmp_path / "a.tec").read_bytes()[:-70])):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(MeshError, match=f"{name[0]}\\{name[1:]} cannot be read as a mesh"):
            load_data(tmp_path / name)


def test_only_named_formats_reach_meshio(tmp_path, monkeypatch):
    called = []
    content = Content(np.eye(4)[:, :3], (CellBlock("tetra", np.array([[0, 1, 2, 3]]), np.array([0])),), {}, {})
    monkeypatch.setattr(through_meshio, "isolated", lambda reader, path: called.append(path.name) or content)
    for name, message in (
        ("a.svg", r"'\.svg' is no suffix of a mesh file that is read; give one of"),
        ("a", r"'' is no suffix"),
        ("a.case", "EnSight .* several files"),
        ("a.foam", "OpenFOAM, .* several files"),
        ("a.e.4.0", "one of several pieces of an Exodus file; join them with epu"),
        ("a.h5", r"give the \.xdmf"),
        ("a.vtkhdf", r"is VTK's kind of HDF5, and is not read; open it in ParaView and save it as \.vtu"),
    ):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(MeshError, match=message):
            load_data(tmp_path / name)
    for name in ("a.su2", "a.VOL.gz"):
        (tmp_path / name).write_bytes(b"x")
        assert load_data(tmp_path / name).mesh.num_cells == 1
    assert called == ["a.su2", "a.VOL.gz"]


def test_what_only_authors_understand_stays_inside(tmp_path):
    (tmp_path / "a.su2").write_text("nothing at all\n")
    with pytest.raises(MeshError, match="meshio's reader does not understand it"):
        load_data(tmp_path / "a.su2")
