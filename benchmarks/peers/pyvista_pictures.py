"""First pictures of simulations beside PyVista's: the same meshes, and nothing said to either but the scalar.

    python benchmarks/peers/pyvista_pictures.py FOLDER -o docs/images/first_pictures.png

FOLDER holds the meshes named below. PyVista is no dependency of the project: `pip install pyvista` into an environment
in which it is installed, too. Without a screen VTK draws by itself (OSMesa), or under `xvfb-run`.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

import difftetvr.cli as cli
from difftetvr.mesh.io import load_data, scalar_of
from difftetvr.view.pictures import below, beside, labelled, save_picture

SIZE, SHOWN = 512, 320
"""Pixels of a picture, and of it on the sheet."""


@dataclass(frozen=True)
class Subject:
    """A scalar of a mesh.

    Attributes:
        file: Of the mesh.
        scalar: Its name; of vectors the magnitude is shown.
        label: What it is.
    """

    file: str
    scalar: str
    label: str


SUBJECTS = (
    Subject("bluntfin.npz", "density", "blunt fin, density"),
    Subject("oxygen-post.npz", "momentum", "liquid-oxygen post, momentum"),
    Subject("post.vtk", "Pressure", "post, pressure"),
    Subject("hexa.vtk", "scalars", "hexahedra"),
    Subject("hand.msh", "E", "hand, E"),
)


def pyvista_grid(pyvista: Any, path: Path, subject: Subject) -> Any:
    """The mesh as PyVista reads it; what it does not read, from the tetrahedra and the scalar that we read."""
    if path.suffix == ".vtk":
        return pyvista.read(path)
    scalar = scalar_of(load_data(path, flat="drop"), subject.scalar)
    cells = {pyvista.CellType.TETRA: scalar.mesh.tets.numpy()}
    grid = pyvista.UnstructuredGrid(cells, scalar.mesh.vertices.numpy())
    data = grid.point_data if scalar.location == "vertex" else grid.cell_data
    data[subject.scalar] = scalar.values.numpy()
    return grid


def their_picture(pyvista: Any, path: Path, subject: Subject) -> Image.Image:
    """What `add_volume` shows where only the scalar is named."""
    plotter = pyvista.Plotter(off_screen=True, window_size=(SIZE, SIZE))
    plotter.add_volume(pyvista_grid(pyvista, path, subject), scalars=subject.scalar)
    picture = plotter.screenshot(None, return_img=True)
    plotter.close()
    return Image.fromarray(picture)


def our_picture(path: Path, subject: Subject) -> Image.Image:
    """What `difftetvr render` shows where only the scalar is named, on PyVista's background, with a bar as it has."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        size = ("--width", str(SIZE), "--height", str(SIZE))
        given = ("--scalar", subject.scalar, "--background", "white", "--colorbar", *size)
        if cli.main(["render", str(path), "-o", str(file), *given]) != 0:
            raise SystemExit(f"{path} could not be rendered, see above.")
        return Image.open(file).convert("RGB")


def main() -> None:
    """Writes the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    try:
        import pyvista
    except ImportError:
        raise SystemExit("PyVista is not installed; pip install pyvista into this environment.") from None
    theirs, ours = [], []
    for subject in SUBJECTS:
        path = options.folder / subject.file
        theirs.append(labelled(_shown(their_picture(pyvista, path, subject)), subject.label))
        ours.append(_shown(our_picture(path, subject)))
    save_picture(options.output, below([beside(theirs), beside(ours)]))
    print(f"Wrote {options.output}: above PyVista {pyvista.__version__}, below difftetvr")


def _shown(picture: Image.Image) -> Image.Image:
    return picture.resize((SHOWN, SHOWN), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    main()
