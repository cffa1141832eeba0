"""Several pieces as one mesh: in one file, in files that list others, at time steps; and lists that lead astray."""

import itertools
import json

import numpy as np
import pytest
from mesh.io.vtk_files import data_array, file, list_of, numbers, piece, vtu

from difftetvr.errors import MeshError
from difftetvr.mesh import TetMesh
from difftetvr.mesh.io import load_data


def slabs(count):
    """The unit cubes from 0 to `count` along x, each with its points, tetrahedra, and the points' x."""
    grid = TetMesh.grid((1, 1, 1))
    points, tets = grid.vertices.double().numpy(), grid.tets.tolist()
    return [(points + np.array([i, 0, 0]), tets) for i in range(count)]


def pieces(count=3, **data):
    return [
        piece(points, tets, [10] * len(tets), [("x", points[:, 0])], [("slab", np.full(len(tets), i))], **data)
        for i, (points, tets) in enumerate(slabs(count))
    ]


def write_pieces(folder, count=3):
    for i, text in enumerate(pieces(count)):
        (folder / f"part_{i}.vtu").write_text(vtu(text))


def check_slabs(data, count=3):
    assert data.mesh.is_conforming and data.mesh.num_vertices == 4 * (count + 1)
    assert float(data.mesh.volumes().sum()) == pytest.approx(count)
    assert data.point_data["x"].tolist() == data.mesh.vertices[:, 0].tolist()
    assert sorted(set(data.cell_data["slab"].tolist())) == list(range(count))
    assert len(data.mesh.topology.boundary_faces) == 2 * (2 + 4 * count)


MERGED = ("Merged 8 points at which its 3 pieces meet.",)


def test_pieces_in_one_file_and_in_several_are_one_mesh(tmp_path):
    write_pieces(tmp_path)
    names = [f"part_{i}.vtu" for i in range(3)]
    empty = '<Piece NumberOfPoints="0" NumberOfCells="0"/>'
    (tmp_path / "a.vtu").write_text(vtu(empty, *pieces(), empty))
    (tmp_path / "a.pvtu").write_text(list_of("PUnstructuredGrid", [f'<Piece Source="{name}"/>' for name in names]))
    entries = [f'<Block index="{i}"><DataSet index="0" file="{name}"/></Block>' for i, name in enumerate(names)]
    (tmp_path / "a.vtm").write_text(list_of("vtkMultiBlockDataSet", entries))
    entries = [f'<Partitions index="0"><DataSet file="{name}"/></Partitions>' for name in names]
    (tmp_path / "a.vtpc").write_text(list_of("vtkPartitionedDataSetCollection", entries))
    entries = [f'<DataSet timestep="0" part="{i}" file="{name}"/>' for i, name in enumerate(names)]
    (tmp_path / "a.pvd").write_text(list_of("Collection", entries))
    for suffix in (".vtu", ".pvtu", ".vtm", ".vtpc", ".pvd"):
        data = load_data(tmp_path / f"a{suffix}")
        check_slabs(data)
        assert data.warnings == MERGED


def test_time_steps_of_a_list(tmp_path):
    write_pieces(tmp_path, 4)
    (tmp_path / "pair.pvtu").write_text(
        list_of("PUnstructuredGrid", ['<Piece Source="part_2.vtu"/>', '<Piece Source="part_3.vtu"/>'])
    )
    files = {"10": "part_0.vtu", "2.5": "pair.pvtu", "-1e-3": "part_1.vtu"}
    entries = [f'<DataSet timestep="{time}" file="{name}"/>' for time, name in files.items()]
    (tmp_path / "a.pvd").write_text(list_of("Collection", entries))
    last = load_data(tmp_path / "a.pvd")
    assert last.point_data["x"].max() == 1
    assert last.warnings == ("Of 3 time steps the last was read, number 2 at time 10; --step chooses another.",)
    for step, slab in ((0, [1]), (1, [2, 3]), (2, [0]), (-1, [0]), (-2, [2, 3])):
        data = load_data(tmp_path / "a.pvd", step=step)
        assert sorted(set(data.cell_data["slab"].tolist())) == slab
        assert len(data.warnings) == len(slab) - 1
    with pytest.raises(MeshError, match="no time step 3; its 3 steps have the numbers 0 to 2"):
        load_data(tmp_path / "a.pvd", step=3)
    with pytest.raises(MeshError, match="has no time steps"):
        load_data(tmp_path / "part_0.vtu", step=0)
    (tmp_path / "a.pvd").write_text(list_of("Collection", ['<DataSet timestep="soon" file="part_0.vtu"/>']))
    with pytest.raises(MeshError, match="timestep is 'soon'"):
        load_data(tmp_path / "a.pvd")


def test_lists_without_times(tmp_path):
    write_pieces(tmp_path)
    names = [f"part_{i}.vtu" for i in range(3)]
    entries = [f'<DataSet timestep="" part="{i}" file="{name}"/>' for i, name in enumerate(names)]
    (tmp_path / "a.pvd").write_text(list_of("Collection", entries + entries[1:2]))
    data = load_data(tmp_path / "a.pvd")
    check_slabs(data)
    assert data.warnings == ("part_1.vtu is named several times, and was read once.", *MERGED)


def test_series(tmp_path):
    write_pieces(tmp_path, 2)
    (tmp_path / "old.vtk").write_text(
        "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n0 0 0 9 0 0 0 1 0 0 0 1\n"
        "CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n"
    )
    path = tmp_path / "a.vtu.series"

    def write(*files, **others):
        entries = [{"name": name, **({} if time is None else {"time": time})} for name, time in files]
        path.write_text(json.dumps({"file-series-version": "1.0", "files": entries, **others}))

    write(("old.vtk", 7), ("part_0.vtu", 0.5), ("part_1.vtu", 2))
    last = load_data(path)
    assert last.mesh.bounds()[1, 0] == 9
    assert last.warnings == ("Of 3 time steps the last was read, number 2 at time 7; --step chooses another.",)
    assert [float(load_data(path, step=i).mesh.bounds()[1, 0]) for i in (0, 1, -1)] == [1, 2, 9]
    write(("part_0.vtu", None))
    assert load_data(path).warnings == ()
    (tmp_path / "inside").mkdir()
    for files, sentence in (
        ([("none.vtu", 0)], "names none.vtu, which is not there"),
        ([("inside", 0)], "it is a folder"),
        ([("../part_0.vtu", 0)], "outside of its folder"),
        ([("part_0.vtu", "soon")], "no list of files with their times"),
        ([("part_0.vtu", float("nan"))], "no list of files with their times"),
        ([], "names no files"),
    ):
        write(*files)
        with pytest.raises(MeshError, match=sentence):
            load_data(path)
    for text in ("", "[]", '{"files": [3]}', '{"files": 3}', "[" * 100_000, '{"files": [{"time": 1}]}'):
        path.write_text(text)
        with pytest.raises(MeshError, match="no list of files with their times"):
            load_data(path)


def test_time_steps_in_one_file(tmp_path):
    (points, tets), *_ = slabs(1)
    steps = "".join(data_array("p", np.full(8, 10 * i), attributes=f'TimeStep="{i}"') for i in range(3))
    text = vtu(piece(points, tets, [10] * 6).replace("<PointData>", f"<PointData>{steps}"))
    (tmp_path / "a.vtu").write_text(text.replace("<UnstructuredGrid>", '<UnstructuredGrid TimeValues="0 1 5">'))
    assert set(load_data(tmp_path / "a.vtu").point_data["p"].tolist()) == {20}
    assert set(load_data(tmp_path / "a.vtu", step=1).point_data["p"].tolist()) == {10}


def test_what_pieces_do_not_share_is_told(tmp_path):
    (a, tets), (b, _) = slabs(2)
    first = piece(a, tets, [10] * 6, [("p", a[:, 1]), ("q", a[:, 1]), ("v", a)])
    second = piece(b, tets, [10] * 6, [("p", b[:, 1] + 0.5), ("v", b[:, 1])], [("c", np.arange(6))])
    (tmp_path / "a.vtu").write_text(vtu(first, second))
    data = load_data(tmp_path / "a.vtu")
    assert set(data.point_data) == {"p"} and not data.cell_data
    where = data.mesh.vertices
    assert data.point_data["p"].tolist() == [y + 0.5 * (x > 1) for x, y, _ in where.tolist()]
    assert data.warnings == (
        "Merged 4 points at which its 2 pieces meet; those of the first piece were kept of data that differ there: p.",
        "Left out data that not all of its 2 pieces have alike: c, q, v.",
    )


def test_ghosts_give_way_to_the_cells_and_points_they_stand_for(tmp_path):
    """Each piece has a layer of its neighbour's cells, with data that are not up to date."""
    (a, tets), (b, _) = slabs(2)
    points = np.unique(np.concatenate((a, b)), axis=0)
    index = {tuple(p): i for i, p in enumerate(points.tolist())}
    cells = [[index[tuple(own[i].tolist())] for i in tet] for own in (a, b) for tet in tets]
    for i, wrong in enumerate((points[:, 0] > 1, points[:, 0] < 1)):
        ghosts = ("vtkGhostType", np.repeat([i, 1 - i], 6).astype(np.uint8))
        x = np.where(wrong, -7, points[:, 0])
        text = piece(points, cells, [10] * 12, [("x", x)], [ghosts, ("slab", np.repeat([0, 1], 6))])
        (tmp_path / f"{i}.vtu").write_text(vtu(text))
    (tmp_path / "a.pvtu").write_text(list_of("PUnstructuredGrid", [f'<Piece Source="{i}.vtu"/>' for i in (0, 1)]))
    data = load_data(tmp_path / "a.pvtu")
    check_slabs(data, 2)
    assert data.warnings == (
        "Merged 4 points at which its 2 pieces meet.",
        "Left out 12 cells marked as hidden or as another piece's (vtkGhostType).",
    )


def test_a_crack_within_a_piece_stays_open(tmp_path):
    (a, tets), (b, _) = slabs(2)
    both = piece(np.concatenate((a, b)), tets + [[i + 8 for i in t] for t in tets], [10] * 12)
    c = piece(b + np.array([1, 0, 0]), tets, [10] * 6)
    (tmp_path / "a.vtu").write_text(vtu(both, c))
    assert load_data(tmp_path / "a.vtu").mesh.num_vertices == 8 + 8 + 4


def test_surfaces_beside_volumes(tmp_path):
    write_pieces(tmp_path, 1)
    (tmp_path / "wall.vtp").write_text('<VTKFile type="PolyData"><PolyData/></VTKFile>')
    (tmp_path / "patch.vtu").write_text(vtu(piece(np.eye(3), [[0, 1, 2]], [5])))
    entries = [f'<DataSet file="{name}"/>' for name in ("wall.vtp", "patch.vtu", "part_0.vtu")]
    (tmp_path / "a.vtm").write_text(list_of("vtkMultiBlockDataSet", entries))
    data = load_data(tmp_path / "a.vtm")
    assert set(data.point_data) == {"x"}
    assert data.warnings == ("Left out 1 piece that only holds surfaces.",)
    with pytest.raises(MeshError, match="holds a surface; fill it"):
        load_data(tmp_path / "wall.vtp")


def test_lists_that_lead_astray(tmp_path):
    inside = tmp_path / "inside"
    inside.mkdir()
    write_pieces(tmp_path, 1)
    path = inside / "a.vtm"
    for name, sentence in (
        ("../part_0.vtu", "lies outside of its folder"),
        ("/dev/zero", "lies outside"),
        ("none.vtu", "names none.vtu, which is not there"),
        ("a.vtm", "a.vtm is named by itself"),
        ("b.vtm", "b.vtm is named by itself"),
    ):
        path.write_text(list_of("vtkMultiBlockDataSet", [f'<DataSet file="{name}"/>']))
        (inside / "b.vtm").write_text(list_of("vtkMultiBlockDataSet", ['<DataSet file="b.vtm"/>']))
        with pytest.raises(MeshError, match=sentence):
            load_data(path)
    (inside / "p.vtu").write_text(vtu(*pieces(1)))
    path.write_text(list_of("vtkMultiBlockDataSet", ['<DataSet file="p.vtu"/>'] * 2))
    assert load_data(path).warnings == ("p.vtu is named several times, and was read once.",)
    path.write_text(list_of("vtkMultiBlockDataSet", []))
    with pytest.raises(MeshError, match="holds no cells"):
        load_data(path)
    path.write_text('<VTKFile type="HyperTreeGrid"><HyperTreeGrid/></VTKFile>')
    with pytest.raises(MeshError, match="kind 'HyperTreeGrid'"):
        load_data(path)


@pytest.mark.parametrize("kind", ["ImageData", "RectilinearGrid", "StructuredGrid"])
def test_structured_grids_in_pieces(tmp_path, kind):
    """Two pieces of a grid with other spacing along each axis; the common points have the same bits."""
    spacing, origin = np.array([0.1, 0.7, 1.3]), np.array([1.1, -3.3, 0.7])
    parts = []
    for low, high in ((-1, 3), (3, 5)):
        ranges = [np.arange(low, high + 1), np.arange(4), np.arange(3)]
        axes = [o + s * r for o, s, r in zip(origin, spacing, ranges)]
        points = [(x, y, z) for z, y, x in itertools.product(*reversed(axes))]
        data = f"<PointData>{data_array('x', [p[0] for p in points])}</PointData>"
        where = {
            "ImageData": "",
            "RectilinearGrid": f"<Coordinates>{''.join(data_array('', axis) for axis in axes)}</Coordinates>",
            "StructuredGrid": f"<Points>{data_array('', np.array(points))}</Points>",
        }[kind]
        parts.append(f'<Piece Extent="{low} {high} 0 3 0 2">{data}{where}</Piece>')
    head = f'<{kind} WholeExtent="-1 5 0 3 0 2" Origin="{numbers(origin)}" Spacing="{numbers(spacing)}">'
    suffix = {"ImageData": "vti", "RectilinearGrid": "vtr", "StructuredGrid": "vts"}[kind]
    for i, part in enumerate(parts):
        (tmp_path / f"{i}.{suffix}").write_text(f'<VTKFile type="{kind}">{head}{part}</{kind}></VTKFile>')
    names = [f'<Piece Source="{i}.{suffix}"/>' for i in range(2)]
    (tmp_path / f"a.p{suffix}").write_text(list_of(f"P{kind}", names))
    data = load_data(tmp_path / f"a.p{suffix}", split=None)
    assert data.mesh.is_conforming and data.mesh.num_vertices == 7 * 4 * 3
    assert float(data.mesh.volumes().sum()) == pytest.approx(6 * 3 * 2 * np.prod(spacing), rel=1e-5)
    assert np.array_equal(data.point_data["x"].float(), data.mesh.vertices[:, 0])
    assert data.warnings == ("Merged 12 points at which its 2 pieces meet.", "Split 36 hexahedra into 216 tetrahedra.")


def test_an_image_may_be_turned(tmp_path):
    text = file("ImageData", '<Piece Extent="0 1 0 1 0 1"/>').replace(
        "<ImageData>", '<ImageData Spacing="1 2 3" Origin="5 5 5" Direction="0 1 0 -1 0 0 0 0 1">'
    )
    (tmp_path / "a.vti").write_text(text)
    lower, upper = load_data(tmp_path / "a.vti", split=True).mesh.bounds().tolist()
    assert (lower, upper) == ([5, 4, 5], [7, 5, 8])


def test_links_in_a_circle_are_no_pieces(tmp_path):
    (tmp_path / "a.vtu").symlink_to(tmp_path / "b.vtu")
    (tmp_path / "b.vtu").symlink_to(tmp_path / "a.vtu")
    path = tmp_path / "list.pvtu"
    path.write_text(
        '<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid><Piece Source="a.vtu"/></PUnstructuredGrid></VTKFile>'
    )
    with pytest.raises(MeshError, match=r"list\.pvtu names .*a\.vtu"):
        load_data(path)
