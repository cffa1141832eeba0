"""XDMF as FEniCS, dolfinx, meshio, ParaView and others write it."""

import numpy as np
import pytest
import torch
from mesh.io.xdmf_files import (
    INCLUDE,
    MESH,
    POINTS,
    SERIES,
    TETS,
    attribute,
    collection,
    geometry,
    grid,
    item,
    time,
    topology,
)

import difftetvr as dtv
from difftetvr.errors import MeshError
from difftetvr.mesh.io import load_data, scalar_of

meshio = pytest.importorskip("meshio")


@pytest.fixture
def write(tmp_path):
    def write(*content, head='<!DOCTYPE Xdmf SYSTEM "Xdmf.dtd" []>'):
        path = tmp_path / "a.xdmf"
        body = f'<Xdmf Version="3.0" xmlns:xi="https://www.w3.org/2001/XInclude"><Domain>{"".join(content)}</Domain></Xdmf>'
        path.write_text(f'<?xml version="1.0"?>{head}{body}', encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize("program", SERIES)
def test_time_series(write, program):
    path = write(SERIES[program])
    found = load_data(path, torch.float64)
    assert torch.equal(found.mesh.vertices, torch.from_numpy(POINTS)) and found.mesh.num_cells == 2
    assert found.point_data["u"].tolist() == (POINTS[:, 0] + 2).tolist()
    assert found.warnings == ("Of 3 time steps the last was read, number 2 at time 1; --step chooses another.",)
    first = load_data(path, torch.float64, step=0)
    assert first.point_data["u"].tolist() == POINTS[:, 0].tolist() and not first.warnings
    assert set(first.point_data) == ({"u", "p"} if program == "two quantities" else {"u"})
    with pytest.raises(MeshError, match="no time step 3"):
        load_data(path, step=3)


def test_steps_where_there_are_none(write):
    with pytest.raises(MeshError, match="has no time steps; leave out --step"):
        load_data(write(grid(MESH)), step=0)


def test_tags_of_cells_are_no_second_mesh(write):
    """As dolfinx writes them: a grid of some cells, in another order, on the points of the first."""
    tags = topology(TETS[::-1][:, [1, 0, 3, 2]]) + INCLUDE.format("/Xdmf/Domain/Grid/Geometry")
    facets = topology([[0, 1, 2]], "Triangle") + INCLUDE.format("/Xdmf/Domain/Grid/Geometry")
    path = write(
        grid(MESH, name="mesh"),
        grid(tags, attribute("tag", [[5], [6]], "Cell"), name="tags"),
        grid(facets, attribute("side", [3], "Cell"), name="facets"),
    )
    found = load_data(path)
    assert found.mesh.num_cells == 2 and found.mesh.num_vertices == 5
    assert found.cell_data["tag"].tolist() == [6, 5]
    assert found.cell_data["side"].isnan().all()


def test_parts_of_a_collection_are_one_mesh(write):
    parts = [
        grid(
            topology(), geometry(POINTS + 2.0 * k), attribute("p", np.full(5, float(k))), attribute("c", [k, k], "Cell")
        )
        for k in range(2)
    ]
    only = attribute("only", [7.0, 8.0], "Cell") + "</Grid>"
    parts[1] = parts[1].replace("</Grid>", only)
    found = load_data(write(collection("Spatial", *parts)))
    assert (found.mesh.num_cells, found.mesh.num_vertices) == (4, 10)
    assert found.point_data["p"].tolist() == [0] * 5 + [1] * 5
    assert found.cell_data["c"].tolist() == [0, 0, 1, 1]
    assert found.cell_data["only"][:2].isnan().all() and found.cell_data["only"][2:].tolist() == [7, 8]


def test_two_meshes_side_by_side_are_said(write):
    found = load_data(write(grid(MESH), grid(topology(), geometry(POINTS + 2))))
    assert found.mesh.num_cells == 4
    assert found.warnings == ("Put 2 meshes together, each with points of its own.",)


def test_collections_in_collections(write):
    steps = [
        collection("Spatial", time(k), *[grid(topology(), geometry(POINTS + 2.0 * i + k)) for i in range(2)])
        for k in range(2)
    ]
    found = load_data(write(collection("Temporal", *steps)), step=1)
    assert found.mesh.num_cells == 4 and found.mesh.vertices.min() == 1


def test_mixed_and_structured_cells(write):
    numbers = np.array([2, 2, 0, 1, 6, *TETS[0], 4, 0, 1, 2, 3, 4, 0, 1, 2, 4, 6, *TETS[1]])
    path = write(grid(topology(numbers, "Mixed"), geometry(), attribute("c", np.arange(5), "Cell")))
    found = load_data(path)
    assert found.mesh.num_cells == 2 and found.cell_data["c"].tolist() == [1, 4]
    polyhedron = [16, 4, 3, 0, 1, 2, 3, 0, 1, 3, 3, 1, 2, 3, 3, 0, 2, 3]
    with pytest.raises(MeshError, match="1 cell of type 'polyhedron'"):
        load_data(write(grid(topology(np.array([*polyhedron, *numbers]), "Mixed"), geometry())))
    with pytest.raises(MeshError, match="ends before the last one"):
        load_data(write(grid(topology(numbers[:-1], "Mixed"), geometry())))
    axes = '<Geometry GeometryType="ORIGIN_DXDYDZ">' + item([2.0, 1.0, 0.0]) + item([0.5, 1.0, 4.0]) + "</Geometry>"
    text = grid('<Topology TopologyType="3DCoRectMesh" Dimensions="2 3 4"/>', axes, attribute("p", np.arange(24.0)))
    found = load_data(write(text), split=True)
    lower, upper = found.mesh.bounds()
    assert (lower.tolist(), upper.tolist()) == ([0, 1, 2], [12, 3, 2.5])
    x, y, z = ((found.mesh.vertices - lower) / torch.tensor([4, 1, 0.5])).T
    assert torch.equal(found.point_data["p"], x + 4 * y + 12 * z)


def test_quadratic_cells_by_any_name(write):
    points = np.concatenate(
        [POINTS[:4], [(POINTS[a] + POINTS[b]) / 2 for a, b in ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))]]
    )
    for kind in ("Tetrahedron_10", "Tet_10", "TET_10", "38"):
        found = load_data(write(grid(topology(np.arange(10)[None], kind), geometry(points))), split=True)
        assert found.mesh.num_vertices == 4 and "Straightened 1 cell" in found.warnings[0]


def test_parts_of_arrays(write):
    table = item(np.arange(40.0).reshape(4, 10))
    part = f'<DataItem ItemType="HyperSlab" Dimensions="5">{item(np.array([[2, 0], [1, 2], [1, 5]]))}{table}</DataItem>'
    found = load_data(write(grid(MESH, f'<Attribute Name="p" Center="Node">{part}</Attribute>')))
    assert found.point_data["p"].tolist() == [20, 22, 24, 26, 28]


def test_what_is_left_out_is_said(write):
    path = write(
        grid(
            MESH,
            attribute("edges", np.arange(9), "Edge"),
            attribute("short", np.arange(3)),
            attribute("p", np.arange(5)),
            '<Set Name="inlet"/>',
        )
    )
    found = load_data(path)
    assert set(found.point_data) == {"p"}
    (note,) = found.warnings
    assert all(
        name in note for name in ("'edges' (data of each Edge)", "'short' (3 numbers for 5 rows)", "set 'inlet'")
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (grid(topology(), geometry(POINTS[:, :2])), "no mesh of three dimensions"),
        (grid(topology(), geometry(POINTS[:, :2], "XY")), "no mesh of three dimensions"),
        (grid(topology()), "has no points or no cells"),
        (grid(topology(TETS, "Polyhedron"), geometry()), "cells of the kind 'polyhedron'"),
        (grid(topology(TETS + 1), geometry()), "uses a point that is not there"),
        (grid(MESH.replace('Format="XML"', 'Format="Tar"')), "unknown format 'Tar'"),
        (grid('<xi:include href="b.xdmf"/>'), "parts from another document"),
        (grid(INCLUDE.format("//Grid[position()=1]")), "is not understood"),
        (grid(INCLUDE.format("//Grid[@Name='x']/*")), "leads to nothing"),
        (collection("Temporal", '<Grid Reference="/Xdmf/Domain/Grid"/>'), "in each other without end"),
        (collection("Spatial", *['<Grid Reference="/Xdmf/Domain/Grid"/>'] * 40), "in each other without end"),
        (
            grid(topology(), '<Geometry><DataItem Reference="XML">//DataItem[2]</DataItem></Geometry>'),
            "leads to nothing",
        ),
        (
            grid(topology(), '<Geometry><DataItem Reference="XML">//Geometry/DataItem</DataItem></Geometry>'),
            "refer to each other without end",
        ),
        (grid(MESH).replace("</Geometry>", ""), "is no XML"),
        ("", "has no grid"),
    ],
)
def test_damage_is_a_sentence(write, content, message):
    with pytest.raises(MeshError, match=message):
        load_data(write(content))


def test_entities_are_refused(write):
    head = '<!DOCTYPE Xdmf [<!ENTITY a "0 0 0 0 0"><!ENTITY b SYSTEM "file:///etc/passwd">]>'
    with pytest.raises(MeshError, match="defines entities"):
        load_data(write(grid(MESH), head=head))


def test_many_references_to_one_large_array_are_refused(write, monkeypatch):
    """Each of them may be copied, so they count as often as they are named."""
    monkeypatch.setattr("difftetvr.trust.UNPACKED_BYTES", 10_000)
    monkeypatch.setattr("difftetvr.trust._USUAL_RATIO", 1)
    once = attribute("a", np.arange(5.0))
    again = (
        '<Attribute Name="{}" Center="Node"><DataItem Reference="XML">//Attribute[1]/DataItem</DataItem></Attribute>'
    )
    path = write(grid(MESH, once, *[again.format(i) for i in range(400)]))
    assert path.stat().st_size < 60_000
    assert len(load_data(path).point_data) == 401
    monkeypatch.setattr("difftetvr.trust._USUAL_RATIO", 0)
    with pytest.raises(MeshError, match="--allow-large"):
        load_data(path)
    with dtv.trusting(large=True):
        assert len(load_data(path).point_data) == 401


def test_symmetric_tensors_are_brought_into_the_order_of_vtk(write):
    tensors = np.arange(30.0).reshape(5, 6)  # xx xy xz yy yz zz
    text = attribute("s", tensors).replace("<Attribute", '<Attribute AttributeType="Tensor6"')
    data = load_data(write(grid(MESH, text, attribute("six", tensors))))
    assert data.point_data["s"].tolist() == tensors[:, [0, 3, 5, 1, 4, 2]].tolist()
    assert scalar_of(data, "s:yy").values.tolist() == tensors[:, 3].tolist()
    assert data.point_data["six"].tolist() == tensors.tolist()


@pytest.mark.parametrize("place", ["Topology", "DataItem"])
def test_indices_that_count_from_one_and_nodes_in_another_order(write, place):
    order = [3, 0, 2, 1]
    stored = np.empty_like(TETS)
    stored[:, order] = TETS + 1
    text = topology(stored).replace(f"<{place}", f'<{place} BaseOffset="1"')
    text = text.replace("<Topology", f'<Topology Order="{" ".join(map(str, order))}"')
    data = load_data(write(grid(text, geometry(), attribute("c", np.arange(2), "Cell"))))
    assert torch.equal(data.mesh.tets, dtv.TetMesh(POINTS, TETS).tets) and data.cell_data["c"].tolist() == [0, 1]
    mixed = topology(np.array([6, 1, 2, 3, 4, 6, 2, 3, 4, 5]), "Mixed").replace("<Topology", '<Topology BaseOffset="1"')
    assert torch.equal(load_data(write(grid(mixed, geometry()))).mesh.tets, data.mesh.tets)
    for wrong, message in (('Order="0 1 2 2"', "no order of 4 nodes"), ('BaseOffset="-1"', "no index of its first")):
        with pytest.raises(MeshError, match=message):
            load_data(write(grid(topology().replace("<Topology", f"<Topology {wrong}"), geometry())))


def test_cells_of_other_pieces_are_left_out(write):
    def piece(shift, flags, points=POINTS):
        return grid(
            topology(),
            geometry(points + np.array([shift, 0, 0])),
            attribute("vtkGhostType", np.array(flags), "Cell"),
            attribute("vtkGhostType", np.zeros(5, int)),
            attribute("c", np.array([shift, shift + 1.0]), "Cell"),
        )

    data = load_data(write(collection("Spatial", piece(0, [0, 0]), piece(10, [1, 0]), piece(20, [0, 32]))))
    assert sorted(data.cell_data["c"].tolist()) == [0, 1, 11, 20] and data.point_data == {}
    assert data.warnings[-1] == "Left out 2 cells marked as hidden or as another piece's (vtkGhostType)."
    # Of grids with the same points each has what is its own.
    shared = load_data(write(collection("Spatial", piece(0, [1, 0]), piece(0, [0, 1]))))
    assert shared.mesh.num_cells == 2 and shared.warnings == ()
    with pytest.raises(MeshError, match=r"All 2 cells of .* are marked as hidden or as another piece's"):
        load_data(write(piece(0, [1, 1])))
