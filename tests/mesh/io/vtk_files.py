"""Small files of VTK's, written by hand or by VTK."""

import numpy as np


def numbers(values):
    return " ".join(map(repr, np.asarray(values).ravel().tolist()))


def data_array(name, values, kind=None, attributes=""):
    values = np.asarray(values)
    kind = kind or {"f": "Float64", "i": "Int64", "u": "UInt8"}[values.dtype.kind]
    columns = f'NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    return f'<DataArray type="{kind}" Name="{name}" {columns} {attributes} format="ascii">{numbers(values)}</DataArray>'


def piece(points, cells, types, point_data=(), cell_data=(), faces=""):
    """A piece of an unstructured grid; data are pairs of a name and values."""
    offsets = np.cumsum([len(cell) for cell in cells])
    connectivity = [i for cell in cells for i in cell]
    data = [
        f"<{place}>{''.join(data_array(*item) for item in items)}</{place}>"
        for place, items in (("PointData", point_data), ("CellData", cell_data))
    ]
    return (
        f'<Piece NumberOfPoints="{len(points)}" NumberOfCells="{len(cells)}">{"".join(data)}'
        f"<Points>{data_array('Points', np.asarray(points, float))}</Points><Cells>"
        f"{data_array('connectivity', np.array(connectivity, int))}{data_array('offsets', offsets)}"
        f"{data_array('types', types, 'UInt8')}{faces}</Cells></Piece>"
    )


def file(kind, content, attributes="", head=""):
    return f'{head}<VTKFile type="{kind}" {attributes}><{kind}>{content}</{kind}></VTKFile>'


def vtu(*pieces, attributes=""):
    return file("UnstructuredGrid", "".join(pieces), attributes)


def list_of(kind, entries):
    return f'<VTKFile type="{kind}"><{kind}>{"".join(entries)}</{kind}></VTKFile>'
