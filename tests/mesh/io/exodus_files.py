"""A file of Exodus, written as its definition says."""

import netCDF4
import numpy as np

POINTS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0.5, 0.5, 2], [3, 3, 3]],
    dtype=float,
)
BLOCKS = [("HEX8", [[0, 1, 2, 3, 4, 5, 6, 7]]), ("PYRAMID", [[4, 5, 6, 7, 8]]), ("SHELL4", [[0, 1, 2, 3]])]


def names(file, variable, dimension, words):
    file.createDimension(dimension, len(words))
    table = file.createVariable(variable, "S1", (dimension, "len_string"))
    for i, word in enumerate(words):
        table[i] = np.array([*word.ljust(33, "\0")], "S1")


def write(path, form="NETCDF4", blocks=BLOCKS, points=POINTS, times=(0.0, 0.5, 1.5), old=False):
    """Node variables are p = 10 step + node and q = -step; e is 100 step + element, f only in the second block."""
    with netCDF4.Dataset(path, "w", format=form) as file:
        for name, size in (
            ("len_string", 33),
            ("num_dim", points.shape[1]),
            ("num_nodes", len(points)),
            ("time_step", None),
        ):
            file.createDimension(name, size)
        file.createDimension("num_el_blk", len(blocks))
        if old:
            file.createVariable("coord", "f8", ("num_dim", "num_nodes"))[:] = points.T
        else:
            for axis, values in zip("xyz", points.T):
                file.createVariable(f"coord{axis}", "f8", ("num_nodes",))[:] = values
        file.createVariable("eb_prop1", "i4", ("num_el_blk",))[:] = [10 * (i + 1) for i in range(len(blocks))]
        for i, (kind, nodes) in enumerate(blocks, 1):
            file.createDimension(f"num_el_in_blk{i}", len(nodes))
            if nodes:
                file.createDimension(f"num_nod_per_el{i}", len(nodes[0]))
                cells = file.createVariable(f"connect{i}", "i4", (f"num_el_in_blk{i}", f"num_nod_per_el{i}"))
                cells.elem_type = kind
                cells[:] = np.array(nodes) + 1
        file.createVariable("time_whole", "f8", ("time_step",))[:] = times
        names(file, "name_nod_var", "num_nod_var", ["p", "q"])
        names(file, "name_elem_var", "num_elem_var", ["e", "f"])
        file.createDimension("num_node_sets", 2)
        file.createDimension("num_glo_var", 1)
        if old:
            both = file.createVariable("vals_nod_var", "f8", ("time_step", "num_nod_var", "num_nodes"))
        else:
            both = [file.createVariable(f"vals_nod_var{k}", "f8", ("time_step", "num_nodes")) for k in (1, 2)]
        first = 0
        for i, (_, nodes) in enumerate(blocks, 1):
            for k in (1, 2) if i == 2 else (1,):
                if nodes:
                    values = file.createVariable(f"vals_elem_var{k}eb{i}", "f8", ("time_step", f"num_el_in_blk{i}"))
                    values[:] = 100.0 * np.arange(len(times))[:, None] + first + np.arange(len(nodes))
            first += len(nodes)
        for step in range(len(times)):
            for k, values in enumerate((10.0 * step + np.arange(len(points)), np.full(len(points), -step))):
                if old:
                    both[step, k] = values
                else:
                    both[k][step] = values
