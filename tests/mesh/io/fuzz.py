"""Damaged mesh files: every one must give a valid mesh or one sentence, in little time and memory.

    python tests/mesh/io/fuzz.py 10000 [SEED]

runs that many files; the tests run fewer. A failure prints the seed of its file, with which `one` makes it again.
"""

import re
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

import meshio
import numpy as np
import torch

from difftetvr.errors import MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import load_data, save

SECONDS_A_FILE = 5
MEMORY = 2**30  # more than what the process has when it begins; the files are a few kB
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
WORDS = [
    b"-1",
    b"0",
    b"1",
    b"7",
    b"255",
    b"65536",
    b"2147483647",
    b"4294967295",
    b"9223372036854775807",
    b"1e308",
    b"nan",
]
WORDS += [
    b"1000000",
    b"123456789012345678901234567890",
    b"inf",
    b"x",
    b"",
    b"-2147483648",
    b"0.5",
    b"18446744073709551615",
]
BINARY = [0, 1, 2, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1]

STRUCTURED = b"""# vtk DataFile Version 3.0
grid
ASCII
DATASET STRUCTURED_POINTS
DIMENSIONS 3 3 2
ORIGIN 0 0 0
SPACING 1 1 2
POINT_DATA 18
SCALARS s float 1
LOOKUP_TABLE default
""" + b" ".join(b"%d" % i for i in range(18))


BINARY_XDMF = """<Xdmf Version="3.0"><Domain><Grid Name="g">
<Geometry Type="XYZ">
<DataItem DataType="Float" Precision="4" Dimensions="12 3" Format="Binary">binary0.bin</DataItem>
</Geometry>
<Topology Type="Tetrahedron">
<DataItem DataType="Int" Precision="4" Dimensions="12 4" Format="Binary">binary1.bin</DataItem>
</Topology>
</Grid></Domain></Xdmf>
"""


POLYHEDRA = """<VTKFile type="UnstructuredGrid"><UnstructuredGrid><Piece NumberOfPoints="5" NumberOfCells="2">
<CellData><DataArray type="UInt8" Name="vtkGhostType" format="ascii">0 4</DataArray></CellData>
<Points><DataArray type="Float64" NumberOfComponents="3" format="ascii">
0 0 0 1 0 0 0 1 0 0 0 1 1 1 1</DataArray></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3 1 2 3 4</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">4 8</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">42 42</DataArray>
<DataArray type="Int64" Name="faces" format="ascii">{}</DataArray>
<DataArray type="Int64" Name="faceoffsets" format="ascii">17 34</DataArray></Cells></Piece></UnstructuredGrid></VTKFile>
"""


def seeds(folder: Path) -> list[Path]:
    """Intact small files of all formats."""
    folder.mkdir(exist_ok=True)
    mesh = TetMesh.grid((2, 1, 1))
    files = []
    for location, count in (("vertex", mesh.num_vertices), ("cell", mesh.num_cells)):
        generator = torch.Generator().manual_seed(1)
        color, density = torch.rand(count, 3, generator=generator), torch.rand(count, generator=generator)
        for suffix in (".vtu", ".vtk", ".msh", ".xdmf", ".npz", ".bintet", ".ovm", ".node"):
            files.append(folder / f"{location}{suffix}")
            save(files[-1], mesh, Field(color, density, location=location))
    files.append(folder / "geometry.mesh")
    save(files[-1], mesh)
    files += [_written_by_meshio(folder, mesh, *case) for case in _CASES]
    files += [folder / "binary.xdmf", folder / "structured.vtk", folder / "plain.npz"]
    files[-3].write_text(BINARY_XDMF)
    mesh.vertices.numpy().tofile(folder / "binary0.bin")
    mesh.tets.numpy().tofile(folder / "binary1.bin")
    files[-2].write_bytes(STRUCTURED)
    np.savez(files[-1], points=mesh.vertices.numpy(), cells=mesh.tets.numpy(), pressure=np.ones(mesh.num_vertices))
    return files + vtk_seeds(folder)


def vtk_seeds(folder: Path) -> list[Path]:
    """Pieces, time steps, images and polyhedra of VTK's XML files."""
    (folder / "beside0.vtu").write_bytes((folder / "vertex.vtu").read_bytes())
    faces = "4 3 0 1 2 3 0 1 3 3 1 2 3 3 0 2 3 4 3 1 2 3 3 2 3 4 3 1 2 4 3 1 3 4"
    piece = '<Piece Source="beside0.vtu"/>'
    steps = "".join(f'<DataSet timestep="{time}" file="beside0.vtu"/>' for time in (0, 1))
    values = (
        '<PointData><DataArray type="Int8" Name="p" format="ascii">0 1 2 3 4 5 6 7 8 9 10 11</DataArray></PointData>'
    )
    image = f'<Piece Extent="0 2 0 1 0 1">{values}</Piece>'
    contents = {
        "pieces.pvtu": f'<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid>{piece}</PUnstructuredGrid></VTKFile>',
        "steps.pvd": f'<VTKFile type="Collection"><Collection>{steps}</Collection></VTKFile>',
        "image.vti": f'<VTKFile type="ImageData"><ImageData Spacing="1 2 3">{image}</ImageData></VTKFile>',
        "polyhedra.vtu": POLYHEDRA.format(faces),
    }
    for name, text in contents.items():
        (folder / name).write_text(text)
    return [folder / name for name in contents]


_CASES = [
    ("ascii.vtk", "vtk", {"binary": False}),
    ("old.vtk", "vtk42", {"binary": False}),
    ("old-binary.vtk", "vtk42", {"binary": True}),
    ("ascii.msh", "gmsh", {"binary": False}),
    ("old.msh", "gmsh22", {"binary": False}),
    ("old-binary.msh", "gmsh22", {"binary": True}),
    ("ascii.vtu", "vtu", {"binary": False}),
    ("plain.vtu", "vtu", {"binary": True, "compression": None}),
]


def _written_by_meshio(folder, mesh, name, file_format, options):
    hexahedra = [[0, 1, 4, 3, 6, 7, 10, 9]]
    points = mesh.vertices.double().numpy()
    cells = [("triangle", [[0, 1, 3]]), ("tetra", mesh.tets.numpy()[6:]), ("hexahedron", hexahedra)]
    cells = cells[1:2] if file_format == "gmsh" else cells  # meshio writes one kind only in format 4.1
    sizes = [len(nodes) for _, nodes in cells]
    content = meshio.Mesh(
        points,
        cells,
        point_data={"p": np.arange(len(points), dtype=float)},
        cell_data={"c": [np.arange(n, dtype=float) for n in sizes]},
    )
    if file_format.startswith("gmsh") and not options["binary"]:
        # meshio writes data as "np.float64(0.0)" there.
        content.point_data, content.cell_data = {}, {}
    content.write(str(folder / name), file_format=file_format, **options)
    if file_format.startswith("gmsh") and not options["binary"]:
        with open(folder / name, "a") as file:
            file.write('$NodeData\n1\n"p"\n1\n0.0\n3\n0\n1\n2\n1 0.5\n2 1.5\n$EndNodeData\n')
    return folder / name


def damage(rng: np.random.Generator, content: bytes) -> bytes:
    """A few random changes to a file's content."""
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        content = [_cut, _flip, _overwrite, _number, _number, _integer, _integer, _copy, _delete][rng.integers(9)](
            rng, bytearray(content)
        )
    return bytes(content)


def _place(rng, content):
    return int(rng.integers(0, len(content) + 1))


def _cut(rng, content):
    return content[: _place(rng, content)]


def _flip(rng, content):
    for _ in range(rng.integers(1, 9)):
        if content:
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    return content


def _overwrite(rng, content):
    place = _place(rng, content)
    content[place : place + 16] = rng.bytes(int(rng.integers(0, 17)))
    return content


def _number(rng, content):
    # Counts stand at the beginning of sections; the head of the file has most of them.
    found = list(NUMBER.finditer(bytes(content)))
    if not found:
        return content
    last = len(found) if rng.random() < 0.5 else min(len(found), 24)
    chosen = found[int(rng.integers(last))]
    content[chosen.start() : chosen.end()] = WORDS[int(rng.integers(len(WORDS)))]
    return content


def _integer(rng, content):
    size = int(rng.choice([1, 4, 8]))
    place = _place(rng, content) if rng.random() < 0.5 else min(4 * int(rng.integers(16)), len(content))
    value = BINARY[int(rng.integers(len(BINARY)))] % 256**size
    content[place : place + size] = value.to_bytes(size, "little" if rng.random() < 0.7 else "big")
    return content


def _copy(rng, content):
    start, place = _place(rng, content), _place(rng, content)
    return content[:place] + content[start : start + int(rng.integers(64))] + content[place:]


def _delete(rng, content):
    place = _place(rng, content)
    del content[place : place + int(rng.integers(1, 64))]
    return content


def one(files: list[Path], seed: int, folder: Path) -> Path:
    """Writes the damaged file of a seed."""
    rng = np.random.default_rng(seed)
    source = files[int(rng.integers(len(files)))]
    target = folder / f"damaged{source.suffix}"
    pair = [source, source.with_suffix(".ele")] if source.suffix == ".node" else [source]
    broken = int(rng.integers(len(pair)))
    for i, file in enumerate(pair):
        content = file.read_bytes()
        target.with_suffix(file.suffix).write_bytes(damage(rng, content) if i == broken else content)
    for beside in (*source.parent.glob(f"{source.stem}*.bin"), source.parent / "beside0.vtu"):
        (folder / beside.name).write_bytes(beside.read_bytes())
    return target


def check(path: Path, split: bool) -> str:
    """What became of a file: "mesh" or "sentence".

    Raises:
        AssertionError: The mesh is not valid or the error no sentence.
    """
    try:
        data = load_data(path, split=split, flat="drop" if split else "refuse")
    except MeshError as error:
        text = str(error)
        assert path.stem in text and text.endswith(".") and "\n" not in text, text
        return "sentence"
    mesh = data.mesh
    mesh.validate()
    assert int(mesh.tets.min()) >= 0 and int(mesh.tets.max()) < mesh.num_vertices
    assert all(len(values) == mesh.num_vertices for values in data.point_data.values())
    assert all(len(values) == mesh.num_cells for values in data.cell_data.values())
    return "mesh"


def run(count: int, first_seed: int, folder: Path) -> Counter:
    """Checks damaged files, prints failures, and counts what became of the files of each format."""
    files = seeds(folder / "intact")
    for file in files:
        assert check(file, split=True) == "mesh", file
    outcomes: Counter = Counter()
    for seed in range(first_seed, first_seed + count):
        path = one(files, seed, folder)
        begin = time.perf_counter()
        signal.setitimer(signal.ITIMER_REAL, SECONDS_A_FILE)
        try:
            outcome = check(path, split=bool(seed % 2))
        except BaseException:
            outcome = "FAILURE"
            print(f"seed {seed}, {path.suffix}:\n{traceback.format_exc()}", flush=True)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        outcomes[path.suffix, outcome] += 1
        outcomes["slowest, ms"] = max(outcomes["slowest, ms"], round(1000 * (time.perf_counter() - begin)))
    return outcomes


def _too_slow(*_):
    raise TimeoutError(f"it took more than {SECONDS_A_FILE} s")


def main() -> int:
    """Runs as many files as the first argument says."""
    torch.set_num_threads(1)
    signal.signal(signal.SIGALRM, _too_slow)
    warnings.simplefilter("error")
    if sys.platform.startswith("linux"):
        now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    with tempfile.TemporaryDirectory() as folder:
        outcomes = run(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0, Path(folder))
    for key, number in sorted(outcomes.items(), key=str):
        print(*key if isinstance(key, tuple) else (key,), number)
    return int(any(key[1] == "FAILURE" for key in outcomes if isinstance(key, tuple)))


if __name__ == "__main__":
    sys.exit(main())
