"""Abaqus input files: what they include, number, and leave to others."""

import numpy as np
import pytest
from mesh.io.abaqus_files import FIRST, NODES, SECOND

import difftetvr as dtv
from difftetvr.errors import MeshError
from difftetvr.mesh.io import load_data


def test_sets_types_and_rows_that_go_on(tmp_path):
    shells = "*ELEMENT, TYPE=S3, ELSET=shell\n7, 1,2,3\n*ELEMENT, TYPE=COH3D8\n8, 1,2,3,4,1,2,3,4\n"
    shells += "*ELEMENT, TYPE=B31\n9, 1,2\n"
    (tmp_path / "a.inp").write_text(
        f"** made by hand\n*HEADING\nBone, of 2 = two parts\n{NODES}{shells}{FIRST}{SECOND}"
    )
    found = load_data(tmp_path / "a.inp")
    assert found.mesh.tets.sort(1).values.tolist() == [[0, 1, 2, 3], [1, 2, 3, 4]]
    assert found.cell_data["abaqus:elset"].tolist() == [2, 3]
    assert found.warnings == (
        "Of the sets in abaqus:elset, 1 is 'shell', 2 is 'BONE', 3 is 'skin'.",
        "Left out: the sets 'other'.",
    )


SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
TOWER = "*NODE\n" + "".join(f"{4 * z + i + 1}, {x}, {y}, {z}\n" for z in range(3) for i, (x, y) in enumerate(SQUARE))


@pytest.mark.parametrize(
    ("kind", "nodes", "volume"),
    [
        ("SC8R", "5,6,7,8,9,10,11,12", 1.0),
        ("CSS8", "5,6,7,8,9,10,11,12", 1.0),
        ("COH3D8P", "5,6,7,8,9,10,11,12,1,2,3,4", 1.0),
        ("GK3D8N", "5,6,7,8,9,10,11,12", 1.0),
        ("SC6RT", "5,6,7,9,10,11", 0.5),
        ("COH3D6", "5,6,7,9,10,11", 0.5),
        ("COH3D8", "5,6,7,8,5,6,7,8", 0.0),
        ("GK3D6L", "5,6,7,9,10,11", None),
        ("U1", "5,6,7,8,9,10,11,12", None),
        ("CIN3D8", "5,6,7,8,9,10,11,12", None),
        ("CPE4R", "5,6,7,8", 0.0),
    ],
)
def test_elements_of_layers_are_read_and_unknown_ones_said(tmp_path, kind, nodes, volume):
    text = f"{TOWER}*ELEMENT, TYPE=C3D8\n1, 1,2,3,4,5,6,7,8\n*ELEMENT, TYPE={kind}\n2, {nodes}\n"
    (tmp_path / "a.inp").write_text(text)
    found = load_data(tmp_path / "a.inp", split=True, flat="refuse")
    assert float(found.mesh.volumes().sum()) == pytest.approx(1.0 + (volume or 0.0))
    said = (f"Left out 1 element of type '{kind}', whose shape is not known.",)
    assert found.warnings == (said if volume is None else ())
    if volume:
        (tmp_path / "a.inp").write_text(text.replace(nodes, "5,6,7"))
        with pytest.raises(MeshError, match=f"type '{kind}' has 3 nodes"):
            load_data(tmp_path / "a.inp", split=True)


def test_keywords_that_go_on_and_numbers_of_fortran(tmp_path):
    nodes = NODES.replace("1, 0., 0, 0", "1, 0.0D+00, 0.d0, 0").replace("2, 1,", "2, 1.0D+00,")
    (tmp_path / "a.inp").write_text(
        f"{nodes.replace('NSET=ALL', '')}*ELEMENT, TYPE=C3D4,\n** a comment\n ELSET=BONE\n1, 1,2,3,4\n"
        "*ELEMENT,\nTYPE=C3D4,\nELSET=SKIN,\n2, 2,3,4,70\n*STEP,\n"
    )
    found = load_data(tmp_path / "a.inp")
    assert np.allclose(found.mesh.volumes(), [1 / 6, 1 / 3]) and found.cell_data["abaqus:elset"].tolist() == [1, 2]


def test_files_that_are_included(tmp_path):
    """Nodes in one file and elements in another; a file in a folder includes beside itself, too."""
    inside = tmp_path / "inside"
    (inside / "more").mkdir(parents=True)
    (inside / "nodes.inp").write_text(NODES)
    (inside / "more" / "first.inp").write_text("*INCLUDE, INPUT=second.inp\n" + FIRST)
    (inside / "more" / "second.inp").write_text(SECOND)
    (inside / "rows.txt").write_text("3, 1, 2, 3, 70\n")
    path = inside / "a.inp"
    path.write_text('*Include, input=nodes.inp\n*INCLUDE,INPUT="more/first.inp"\n')
    assert load_data(path).mesh.num_cells == 2
    path.write_text(f"{NODES}*ELEMENT, INPUT=rows.txt, TYPE=C3D4\n")
    assert load_data(path).mesh.num_cells == 1
    (tmp_path / "nodes.inp").write_text(NODES)
    for name in ("../nodes.inp", str(tmp_path / "nodes.inp")):
        path.write_text(f"*INCLUDE, INPUT={name}\n{FIRST}")
        with pytest.raises(MeshError, match="lies outside of its folder"):
            load_data(path)
        with dtv.trusting(outside=tmp_path):
            assert load_data(path).mesh.num_cells == 1
    (inside / "link.inp").symlink_to(tmp_path / "nodes.inp")
    path.write_text(f"*INCLUDE, INPUT=link.inp\n{FIRST}")
    with pytest.raises(MeshError, match="lies outside of its folder"):
        load_data(path)


def test_parts_number_their_nodes_anew(tmp_path):
    part = "*Part, name={0}\n*Node\n1, {0}, 0, 0\n2, {1}, 0, 0\n3, {0}, 1, 0\n4, {0}, 0, 1\n" + FIRST + "*End Part\n"
    parts = part.format(0, 1) + part.format(5, 6)
    instances = "*Assembly\n*Instance, name=i, part={}\n*End Instance\n*Instance, name=j, part={}\n{}*End Instance\n"
    path = tmp_path / "a.inp"
    path.write_text(parts + instances.format(0, 5, ""))
    found = load_data(path)
    assert found.mesh.num_cells == 2 and np.allclose(found.mesh.volumes(), 1 / 6)
    for text in (instances.format(0, 5, "1., 0., 0.\n"), instances.format(0, 0, "")):
        path.write_text(parts + text)
        with pytest.raises(MeshError, match=r"moves or repeats its parts by \*INSTANCE"):
            load_data(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("*HEADING\n", "lacks its nodes"),
        (NODES, "no tetrahedra"),
        (NODES + "*ELEMENT, TYPE=C3D4\n1, 1,2,3,5\n", "'1' uses a node that is not there"),
        (NODES + "*ELEMENT, TYPE=C3D4\n1, 1,2,3\n", "an element of type 'C3D4' has 3 nodes"),
        (NODES + "*ELEMENT, TYPE=C3D4\n1, 1,2,3,4\n2, 1,2\n", "different numbers of nodes"),
        (NODES + "*ELEMENT, TYPE=C3D4\n1, 1,2,\n", "last element is incomplete"),
        (NODES.replace("0.,", "x,"), "where numbers should be"),
        (NODES.replace("70,", "7e1,"), "the number of a node"),
        (NODES + "*NGEN\n1, 2\n" + FIRST, r"by \*NGEN, which is not read"),
        (NODES.replace("NSET=ALL", "SYSTEM=C") + FIRST, "cylinders' or spheres' coordinates"),
        ("*INCLUDE, INPUT=a.inp\n", "include each other without end"),
        ("*INCLUDE, INPUT=b.inp\n", "includes the file 'b.inp', which is not there"),
        ("*INCLUDE, INPUT=/dev/zero\n", "lies outside"),
    ],
)
def test_damage_is_a_sentence(tmp_path, text, message):
    (tmp_path / "a.inp").write_text(text)
    with pytest.raises(MeshError, match=message):
        load_data(tmp_path / "a.inp")
