"""Files of surfaces: what other readers find in them, and what the formats' definitions ask for."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkPolyData
from vtkmodules.vtkFiltersGeometry import vtkCompositeDataGeometryFilter
from vtkmodules.vtkIOGeometry import vtkGLTFReader, vtkOBJReader, vtkSTLReader
from vtkmodules.vtkIOPLY import vtkPLYReader
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

from difftetvr import isosurface, save_surface
from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.srgb import linear_to_srgb, srgb_to_linear

READERS = {".ply": vtkPLYReader, ".vtp": vtkXMLPolyDataReader, ".obj": vtkOBJReader, ".stl": vtkSTLReader}
TYPES = [torch.float32, torch.float64]


def ball(dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A sphere around (1, 2, 3), its triangles and colours in [0, 1], a little beyond at one vertex."""
    mesh = TetMesh.grid((6, 6, 6), (-1, -1, -1), (1, 1, 1), dtype=dtype)
    places, triangles = isosurface(mesh, -mesh.vertices.norm(dim=1), -0.7)
    colors = 0.5 + 0.5 * places / 0.7
    colors[0, 0], colors[1, 1] = 1.25, -0.25
    return places + torch.tensor([1.0, 2.0, 3.0], dtype=dtype), triangles, colors


def read(path: Path) -> vtkPolyData:
    reader: Any = READERS[path.suffix]()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def points_of(data: vtkPolyData) -> np.ndarray:
    return vtk_to_numpy(data.GetPoints().GetData())


def triangles_of(data: vtkPolyData) -> np.ndarray:
    return vtk_to_numpy(data.GetPolys().GetConnectivityArray()).reshape(-1, 3)


def glb_chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and buffer of a .glb, whose layout is checked by the letter of its definition."""
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(content[20 : 20 + size])
    begin = 20 + size
    buffer_size, kind = struct.unpack_from("<I4s", content, begin)
    assert kind == b"BIN\0" and buffer_size % 4 == 0 and begin + 8 + buffer_size == len(content)
    assert document["asset"]["version"] == "2.0"
    assert [buffer["byteLength"] for buffer in document["buffers"]] == [buffer_size]
    return document, content[begin + 8 :]


def glb_array(document: dict[str, Any], buffer: bytes, index: int, target: int) -> np.ndarray:
    """Numbers of an accessor, checked against its view and what it says of their ends."""
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    code, size = {5126: ("<f4", 4), 5125: ("<u4", 4)}[accessor["componentType"]]
    columns = {"VEC3": 3, "SCALAR": 1}[accessor["type"]]
    assert view["target"] == target and view["buffer"] == 0 and "byteStride" not in view
    assert view["byteOffset"] % size == 0 and view["byteLength"] == accessor["count"] * columns * size
    assert view["byteOffset"] + view["byteLength"] <= len(buffer)
    values = np.frombuffer(buffer, code, accessor["count"] * columns, view["byteOffset"]).reshape(-1, columns)
    for name, ends in (("min", values.min(0)), ("max", values.max(0))):
        if name in accessor:
            assert accessor[name] == [float(x) for x in ends]
    return values


def rotated(quaternion: list[float], points: np.ndarray) -> np.ndarray:
    axis, scalar = np.array(quaternion[:3]), quaternion[3]
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)
    return points + 2 * np.cross(axis, np.cross(axis, points) + scalar * points)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_ply(tmp_path: Path, dtype: torch.dtype, encoding: Any) -> None:
    places, triangles, colors = ball(dtype)
    save_surface(tmp_path / "s.ply", places.requires_grad_(), triangles, colors, encoding)
    found = read(tmp_path / "s.ply")
    np.testing.assert_array_equal(triangles_of(found), triangles)
    # VTK's reader keeps float32.
    np.testing.assert_allclose(points_of(found), places.detach(), atol=1e-6)
    clamped = colors.clamp(0, 1)
    expected = 255 * (linear_to_srgb(clamped) if encoding == "linear" else clamped)
    np.testing.assert_array_equal(vtk_to_numpy(found.GetPointData().GetArray("RGB")), np.rint(expected.numpy()))
    header, _, body = (tmp_path / "s.ply").read_bytes().partition(b"end_header\n")
    kind, code = ("float", "<f4") if dtype == torch.float32 else ("double", "<f8")
    assert header.decode().split("\n")[:4] == [
        *("ply", "format binary_little_endian 1.0", f"element vertex {len(places)}", f"property {kind} x")
    ]
    row = np.dtype([("place", code, 3), ("normal", "<f4", 3), ("color", "u1", 3)])
    rows = np.frombuffer(body, row, len(places))
    np.testing.assert_array_equal(rows["place"], places.detach())
    assert len(body) == row.itemsize * len(places) + 13 * len(triangles)


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_glb(tmp_path: Path, dtype: torch.dtype, encoding: Any) -> None:
    places, triangles, colors = ball(dtype)
    save_surface(tmp_path / "s.glb", places, triangles, colors, encoding)
    document, buffer = glb_chunks((tmp_path / "s.glb").read_bytes())
    (primitive,) = document["meshes"][0]["primitives"]
    names = primitive["attributes"]
    arrays = {name: glb_array(document, buffer, index, 34962) for name, index in names.items()}
    indices = glb_array(document, buffer, primitive["indices"], 34963)
    assert {"min", "max"} <= document["accessors"][names["POSITION"]].keys()
    assert arrays.keys() == {"POSITION", "NORMAL", "COLOR_0"}
    assert primitive.get("mode", 4) == 4 and len(document["accessors"]) == 4
    np.testing.assert_array_equal(indices.reshape(-1, 3), triangles)
    np.testing.assert_allclose(np.linalg.norm(arrays["NORMAL"], axis=1), 1.0, atol=1e-6)
    clamped = colors.clamp(0, 1)
    np.testing.assert_allclose(arrays["COLOR_0"], srgb_to_linear(clamped) if encoding == "srgb" else clamped, atol=1e-6)
    root = document["nodes"][document["scenes"][document["scene"]]["nodes"][0]]
    (child,) = (document["nodes"][index] for index in root["children"])
    world = rotated(root["rotation"], arrays["POSITION"] + np.array(child["translation"]))
    # x to the right, z up, y away from who looks along -z.
    np.testing.assert_allclose(world, places.numpy()[:, [0, 2, 1]] * (1, 1, -1), atol=1e-6)


def test_vtk_reads_glb(tmp_path: Path) -> None:
    places, triangles, colors = ball()
    save_surface(tmp_path / "s.glb", places, triangles, colors)
    reader, joined = vtkGLTFReader(), vtkCompositeDataGeometryFilter()
    reader.SetFileName(str(tmp_path / "s.glb"))
    joined.SetInputConnection(reader.GetOutputPort())
    joined.Update()
    found = joined.GetOutput()
    np.testing.assert_array_equal(triangles_of(found), triangles)
    np.testing.assert_allclose(points_of(found), places.numpy()[:, [0, 2, 1]] * (1, 1, -1), atol=1e-6)
    assert found.GetPointData().HasArray("COLOR_0") and found.GetPointData().HasArray("NORMAL")


@pytest.mark.parametrize("dtype", TYPES)
def test_vtp(tmp_path: Path, dtype: torch.dtype) -> None:
    places, triangles, colors = ball(dtype)
    save_surface(tmp_path / "s.vtp", places, triangles, colors)
    found = read(tmp_path / "s.vtp")
    np.testing.assert_array_equal(points_of(found), places)
    np.testing.assert_array_equal(triangles_of(found), triangles)
    np.testing.assert_array_equal(vtk_to_numpy(found.GetPointData().GetArray("color")), colors)
    assert found.GetPointData().GetNormals().GetName() == "Normals"


@pytest.mark.parametrize("dtype", TYPES)
def test_obj(tmp_path: Path, dtype: torch.dtype) -> None:
    places, triangles, colors = ball(dtype)
    save_surface(tmp_path / "s.obj", places, triangles, colors, "srgb")
    lines = [line.split() for line in (tmp_path / "s.obj").read_text().splitlines()]
    rows = np.array([[float(word) for word in line[1:]] for line in lines if line[0] == "v"])
    np.testing.assert_array_equal(rows[:, :3].astype(places.numpy().dtype), places)
    np.testing.assert_allclose(rows[:, 3:], colors.clamp(0, 1), atol=6e-5)
    found = read(tmp_path / "s.obj")
    np.testing.assert_array_equal(triangles_of(found), triangles)
    assert found.GetPointData().GetNormals().GetNumberOfTuples() == len(places)


def test_stl(tmp_path: Path) -> None:
    places, triangles, colors = ball()
    save_surface(tmp_path / "s.stl", places, triangles, colors)
    found = read(tmp_path / "s.stl")
    # The reader joins equal places, as they are watertight.
    assert found.GetNumberOfPoints() == len(places) and found.GetNumberOfPolys() == len(triangles)
    np.testing.assert_array_equal(points_of(found)[triangles_of(found)], places[triangles])
    content = (tmp_path / "s.stl").read_bytes()
    assert not content.startswith(b"solid") and len(content) == 84 + 50 * len(triangles)
    normals = np.frombuffer(content, np.dtype([("normal", "<f4", 3), ("rest", "V38")]), offset=84)["normal"]
    middles = (places[triangles].mean(1) - torch.tensor([1.0, 2.0, 3.0])).numpy()
    assert (np.einsum("ij,ij->i", normals, middles) > 0.6).all()


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("name", ["s.ply", "s.vtp"])
def test_normals_look_outwards_at_any_size(tmp_path: Path, name: str, size: float) -> None:
    places, triangles, _ = ball(torch.float64)
    center = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    save_surface(tmp_path / name, size * places, triangles)
    normals = vtk_to_numpy(read(tmp_path / name).GetPointData().GetNormals())
    expected = torch.nn.functional.normalize(places - center, dim=1).numpy()
    assert (np.einsum("ij,ij->i", normals, expected) > 0.9).all()
    assert read(tmp_path / name).GetPointData().GetArray("RGB") is None


def test_triangles_without_area_break_nothing(tmp_path: Path) -> None:
    """Where scalars are at the level at vertices, several edges are cut at one place."""
    mesh = TetMesh.grid((4, 4, 4), dtype=torch.float64)
    places, triangles = isosurface(mesh, mesh.vertices[:, 0], 0.5)
    a, b, c = (places[triangles[:, k]] for k in range(3))
    areas = torch.linalg.cross(b - a, c - a).norm(dim=1)
    assert bool((areas == 0).any()) and bool((areas > 0).any())
    for suffix in (".ply", ".glb", ".vtp", ".obj", ".stl"):
        save_surface(tmp_path / f"s{suffix}", places, triangles)
    normals = vtk_to_numpy(read(tmp_path / "s.vtp").GetPointData().GetNormals())
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    seen = np.unique(triangles[areas > 0])
    np.testing.assert_allclose(normals[seen], np.tile([-1.0, 0.0, 0.0], (len(seen), 1)), atol=1e-6)
    save_surface(tmp_path / "point.glb", torch.ones(3, 3), torch.tensor([[0, 1, 2]]))
    glb_chunks((tmp_path / "point.glb").read_bytes())


def test_far_from_the_origin_glb_is_as_fine_as_near_it(tmp_path: Path) -> None:
    places, triangles, _ = ball(torch.float64)
    far = places + torch.tensor([4.2e5, 5.4e6, 300.0], dtype=torch.float64)
    save_surface(tmp_path / "s.glb", far, triangles)
    document, buffer = glb_chunks((tmp_path / "s.glb").read_bytes())
    local = glb_array(document, buffer, 0, 34962)
    (translation,) = (node["translation"] for node in document["nodes"] if "translation" in node)
    np.testing.assert_allclose(local + np.array(translation), far, atol=1e-6)


@pytest.mark.parametrize(
    ("suffix", "size", "shift"), [(".glb", 1e60, 0.0), (".glb", 1e-60, 0.0), (".stl", 1e60, 0.0), (".stl", 1.0, 5.4e6)]
)
def test_what_float32_would_round_away_is_refused(tmp_path: Path, suffix: str, size: float, shift: float) -> None:
    places, triangles, _ = ball(torch.float64)
    with pytest.raises(MeshError, match=rf"A {suffix} has float32 only, .* write a \.ply\."):
        save_surface(tmp_path / f"s{suffix}", size * places + shift, triangles)
    assert not list(tmp_path.iterdir())
    save_surface(tmp_path / "s.ply", size * places + shift, triangles)


def test_the_same_surface_is_the_same_bytes(tmp_path: Path) -> None:
    for suffix in (".ply", ".glb", ".vtp", ".obj", ".stl"):
        for name in ("a", "b"):
            save_surface(tmp_path / (name + suffix), *ball())
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": "s.off"}, r"no file of a surface; use one of .ply, .glb, .vtp, .obj, .stl"),
        ({"path": "nowhere/s.ply"}, "create the folder first"),
        ({"triangles": torch.empty((0, 3), dtype=torch.int64)}, "has no triangles; choose a level"),
        ({"triangles": torch.tensor([[0, 1, 3]])}, "name vertices that are none of the 3"),
        ({"triangles": torch.tensor([[0, 1, -1]])}, "name vertices that are none of the 3"),
        ({"triangles": torch.tensor([[0.0, 1.0, 2.0]])}, "are torch.float32 of shape"),
        ({"vertices": torch.zeros(3, 2)}, r"vertices have shape \(3, 2\)"),
        ({"vertices": torch.full((3, 3), math.nan)}, "finite places"),
        ({"colors": torch.zeros(3)}, r"colors have shape \(3,\)"),
        ({"colors": torch.full((3, 3), math.inf)}, "three finite numbers"),
        ({"encoding": "gamma"}, "encoding is 'gamma'"),
    ],
)
def test_mistakes_get_one_sentence(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"path": "s.ply", "vertices": torch.eye(3), "triangles": torch.tensor([[0, 1, 2]])}
    arguments |= change
    with pytest.raises(MeshError, match=message) as error:
        save_surface(tmp_path / arguments.pop("path"), **arguments)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())
