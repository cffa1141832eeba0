"""Parts of XDMF files, and time series as programs write them."""

import numpy as np

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=float)
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
INCLUDE = '<xi:include xpointer="xpointer({})"/>'


def item(values, attributes=""):
    values = np.asarray(values)
    kind = "Float" if values.dtype.kind == "f" else "Int"
    text = " ".join(map(repr, values.ravel().tolist()))
    return (
        f'<DataItem Dimensions="{" ".join(map(str, values.shape))}" NumberType="{kind}" Precision="8" Format="XML" '
        f"{attributes}>{text}</DataItem>"
    )


def topology(cells=TETS, kind="Tetrahedron"):
    return f'<Topology TopologyType="{kind}" NumberOfElements="{len(cells)}">{item(cells)}</Topology>'


def geometry(points=POINTS, kind="XYZ"):
    return f'<Geometry GeometryType="{kind}">{item(points)}</Geometry>'


def attribute(name, values, center="Node"):
    return f'<Attribute Name="{name}" Center="{center}">{item(values)}</Attribute>'


def grid(*content, name="g", kind="Uniform"):
    return f'<Grid Name="{name}" GridType="{kind}">{"".join(content)}</Grid>'


def collection(kind, *grids, name="c"):
    return f'<Grid Name="{name}" GridType="Collection" CollectionType="{kind}">{"".join(grids)}</Grid>'


def time(value):
    return f'<Time Value="{value}"/>'


MESH = topology() + geometry()
STEPS = [time(0.5 * k) + attribute("u", POINTS[:, :1] + k) for k in range(3)]
SERIES = {
    "dolfinx": grid(MESH, name="mesh")
    + collection(
        "Temporal",
        *[
            grid(INCLUDE.format("/Xdmf/Domain/Grid[@GridType='Uniform'][1]/*[self::Topology or self::Geometry]"), s)
            for s in STEPS
        ],
        name="u",
    ),
    "mesh in every step": collection("Temporal", *[grid(MESH, s) for s in STEPS]),
    "FEniCS": collection(
        "Temporal",
        grid(MESH, STEPS[0]),
        *[
            grid(INCLUDE.format("//Grid[@Name=&quot;c&quot;]/*[1]/*[self::Topology or self::Geometry]"), s)
            for s in STEPS[1:]
        ],
    ),
    "meshio": grid(MESH, name="mesh")
    + collection(
        "Temporal", *[grid(INCLUDE.format("//Grid[@Name='mesh']/*[self::Topology|self::Geometry]"), s) for s in STEPS]
    ),
    "references": collection(
        "Temporal",
        grid(MESH, STEPS[0]),
        *[
            grid(
                '<Topology Reference="XML">/Xdmf/Domain/Grid/Grid[1]/Topology</Topology>',
                '<Geometry Reference="/Xdmf/Domain/Grid/Grid[1]/Geometry"/>',
                s,
            )
            for s in STEPS[1:]
        ],
    ),
    "times of the collection": collection(
        "Temporal",
        '<Time TimeType="List"><DataItem Dimensions="3">0 0.5 1</DataItem></Time>',
        *[grid(MESH, s[s.index("<Attribute") :]) for s in STEPS],
    ),
    "two quantities": collection("Temporal", *[grid(MESH, s) for s in STEPS], name="u")
    + collection("Temporal", *[grid(MESH, s.replace('"u"', '"p"')) for s in STEPS], name="p"),
}
