"""Which names are those of projections: asked before anything is read, so without NumPy and PyTorch."""

from __future__ import annotations

from pathlib import Path

META_FOLDER = "meta_data.json"
"""File in a folder of projections, as R2-Gaussian and SAX-NeRF write it."""

GEOMETRY = "geometry"
"""Array of our own files that holds the geometry."""

HDF5, PICKLES = (".h5", ".hdf5", ".nxs"), (".pickle", ".pkl", ".p")


def is_projection_source(path: str | Path) -> bool:
    """Whether a name says that there are projections that `ProjectionCapture.load` reads.

    A ``.npz`` is one if it holds a geometry, a ``.npy`` if there is a ``.json`` beside it, a folder if it holds a
    ``meta_data.json``.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir():
        return (path / META_FOLDER).is_file()
    if path.name == META_FOLDER:
        return True
    if suffix == ".npz":
        from difftetvr.archive import array_names  # late: it imports NumPy, which other names do not need

        return {GEOMETRY} < array_names(path)
    if suffix == ".npy":
        return path.with_suffix(".json").is_file()
    return suffix in HDF5 or suffix in PICKLES
