"""Intact small inputs of every reader, each in a folder of its own with all that it names."""

from __future__ import annotations

import gzip
import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import meshio
import nibabel
import numpy as np
import SimpleITK
import tifffile
import torch
from capture.photos import photo_scene
from mesh.io import abaqus_files, exodus_files, xdmf_files

import difftetvr as dtv
from difftetvr.mesh import Field, TetMesh
from difftetvr.mesh.io import save


@dataclass(frozen=True)
class Seed:
    """An intact input.

    Attributes:
        kind: What reads it; see `fuzz.judge.READERS`.
        folder: Where it lies.
        name: What is read: a file in the folder, or "." for the folder.
        files: The files to damage, relative to the folder.
        share: How often it is drawn, relative to others: less where its reader is slow.
    """

    kind: str
    folder: Path
    name: str
    files: tuple[str, ...]
    share: float = 1.0

    @property
    def label(self) -> str:
        """The kind and the suffix, for counting."""
        return f"{self.kind} {Path(self.name).suffix or self.folder.name}"


_ISOLATED = 0.03  # a process of its own for each takes a second
_PHOTOS = 0.3

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


def _mesh_files(folder: Path) -> list[Path]:
    """Intact small files of all formats that are written here or by meshio."""
    folder.mkdir()
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
    return files + _vtk_files(folder)


def _vtk_files(folder: Path) -> list[Path]:
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
        "steps.vtu.series": '{"file-series-version": "1.0", "files": [{"name": "beside0.vtu", "time": 0.5}]}',
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


def _written_by_meshio(folder: Path, mesh: TetMesh, name: str, file_format: str, options: dict[str, Any]) -> Path:
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


def write_seeds(folder: Path) -> list[Seed]:
    """All intact inputs, below a folder."""
    folder.mkdir(parents=True)
    makers: list[Callable[[Path], list[Seed]]] = [_meshes, _volumes, _photos, _saved, _others, _projections]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [seed for make in makers for seed in make(folder)]


def _meshes(folder: Path) -> list[Seed]:
    seeds = []
    files = _mesh_files(folder / "all")
    for file in files:
        beside = [file]
        beside += [
            path
            for path in sorted(file.parent.glob(f"{file.stem}*"))
            if path.suffix in (".ele", ".bin", ".h5")
            and path.suffix != file.suffix
            and (path.suffix != ".ele" or file.suffix == ".node")
        ]
        beside += [file.parent / "beside0.vtu"] * (file.suffix in (".pvtu", ".pvd", ".series"))
        own = folder / f"mesh {file.name}"
        own.mkdir()
        for path in beside:
            shutil.copy(path, own)
        share = _ISOLATED if file.suffix == ".xdmf" else 1.0
        names = tuple(path.name for path in beside)
        kinds = ("mesh", "strict mesh") if file.name.startswith(_STRICT) else ("mesh",)
        seeds += [Seed(kind, own, file.name, names, share / len(kinds)) for kind in kinds]
    own = folder / "mesh isolated"
    own.mkdir()
    exodus_files.write(own / "a.exo")
    exodus_files.write(own / "b.e", "NETCDF3_CLASSIC", old=True)
    (own / "a.xdmf").write_text(
        f'<Xdmf Version="3.0"><Domain>{xdmf_files.SERIES["mesh in every step"]}</Domain></Xdmf>', encoding="utf-8"
    )
    seeds += [Seed("mesh", own, name, (name,), _ISOLATED) for name in ("a.exo", "b.e", "a.xdmf")]
    own = folder / "mesh abaqus"
    own.mkdir()
    (own / "nodes.inp").write_text(abaqus_files.NODES)
    (own / "a.inp").write_text("*INCLUDE, INPUT=nodes.inp\n" + abaqus_files.FIRST + abaqus_files.SECOND)
    return [*seeds, Seed("mesh", own, "a.inp", ("a.inp", "nodes.inp"))]


_STRICT = ("vertex", "cell", "geometry", "plain.npz")
"""What the names of files begin with that are meshes as they stand."""


def _volumes(folder: Path) -> list[Seed]:
    own = folder / "volumes"
    own.mkdir()
    values = np.random.default_rng(0).integers(-1000, 3000, (3, 4, 5)).astype(np.int16)
    image = SimpleITK.GetImageFromArray(values)
    for name in ("a.nrrd", "b.nhdr", "c.mha", "d.mhd", "e.nii"):
        SimpleITK.WriteImage(image, own / name, name == "a.nrrd")
    (own / "e.nii.gz").write_bytes(gzip.compress((own / "e.nii").read_bytes(), mtime=0))
    nibabel.Nifti2Image(values, np.eye(4)).to_filename(own / "f.nii")
    tifffile.imwrite(own / "g.tif", values, photometric="minisblack")
    np.save(own / "h.npy", values)
    (own / "i_5x4x3_int16.raw").write_bytes(values.tobytes())
    (own / "j.raw").write_bytes(values.tobytes())
    (own / "j.dat").write_text("ObjectFileName: j.raw\nResolution: 5 4 3\nSliceThickness: 1 1 2.5\nFormat: USHORT\n")
    scalars = (
        '<PointData Scalars="p"><DataArray type="Int8" Name="p" format="ascii">0 1 2 3 4 5 6 7</DataArray></PointData>'
    )
    extent = "0 1 0 1 0 1"
    (own / "k.vti").write_text(
        f'<VTKFile type="ImageData"><ImageData WholeExtent="{extent}" Origin="0 0 0" Spacing="1 2 3">'
        f'<Piece Extent="{extent}">{scalars}</Piece></ImageData></VTKFile>'
    )
    beside = {
        "b.nhdr": next(p.name for p in own.glob("b.*") if p.suffix != ".nhdr"),
        "d.mhd": "d.raw",
        "j.dat": "j.raw",
    }
    names = [path.name for path in sorted(own.iterdir()) if path.name not in beside.values()]
    return [Seed("volume", own, name, (name, name, beside[name]) if name in beside else (name,), 2.0) for name in names]


def _photos(folder: Path) -> list[Seed]:
    writers: dict[str, Callable[[Path], object]] = {
        "nerf": photo_scene.write_nerf_synthetic,
        "transforms": photo_scene.write_transforms,
        "cameras": photo_scene.write_camera_list,
        "colmap": photo_scene.write_colmap,
        "colmap text": lambda own: photo_scene.write_colmap(own, ".txt"),
        "polycam": photo_scene.write_polycam,
        "record3d": photo_scene.write_record3d,
    }
    seeds = []
    for name, write in writers.items():
        own = folder / name
        own.mkdir()
        write(own)
        paths = [path.relative_to(own) for path in sorted(own.rglob("*")) if path.is_file()]
        files = [str(path) for path in paths if path.suffix != ".png"]
        pictures = [str(path) for path in paths if path.suffix == ".png"]
        seeds.append(Seed("capture", own, ".", (*files * 8, *pictures)[: 8 * len(files) + 3], _PHOTOS))
    return seeds


def _saved(folder: Path) -> list[Seed]:
    own = folder / "saved"
    own.mkdir()
    photo_scene.write_tiny(own / "tiny.npz")
    dtv.load_capture(folder / "transforms").save(own / "saved.npz")
    photo_scene.write_transforms(folder / "distorted", k1=-0.2, k2=0.05)
    dtv.load_capture(folder / "distorted", keep_lens=True).save(own / "lenses.npz")
    return [Seed("capture", own, name, (name,), 2 * _PHOTOS) for name in ("tiny.npz", "saved.npz", "lenses.npz")]


def _others(folder: Path) -> list[Seed]:
    own = folder / "others"
    own.mkdir()
    points = np.random.default_rng(1).random((12, 3))
    np.save(own / "p.npy", points)
    np.savez(own / "p.npz", points=points)
    np.savetxt(own / "p.xyz", points)
    np.savetxt(own / "p.csv", points, delimiter=",")
    dtv.TransferFunction.default().save(own / "f.json")
    (own / "f.xml").write_text(_FUNCTION)
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    for name in ("s.ply", "s.stl", "s.obj", "s.off"):
        meshio.Mesh(corners, [("triangle", np.array(triangles, np.int32))]).write(str(own / name))
    seeds = [Seed("points", own, name, (name,)) for name in ("p.npy", "p.npz", "p.xyz", "p.csv")]
    seeds += [Seed("transfer function", own, name, (name,), 2.0) for name in ("f.json", "f.xml")]
    return seeds + [Seed("surface", own, name, (name,), _ISOLATED) for name in ("s.ply", "s.stl", "s.obj", "s.off")]


_FUNCTION = """<TransferFunction><OpacityPoints><OpacityPoint position="0" opacity="0"/>
<OpacityPoint position="0.5" opacity="1"/></OpacityPoints><ColorPoints color_data="ubyte">
<ColorPoint position="0" r="0" g="0" b="0"/><ColorPoint position="1" r="255" g="0" b="9"/></ColorPoints>
</TransferFunction>
"""


def _projections(folder: Path) -> list[Seed]:
    """Scans of all kinds, and geometries of all dialects."""
    own = folder / "projections"
    own.mkdir()
    values = np.random.default_rng(0).random((3, 4, 5)).astype(np.float32)
    cone = {"type": "cone", "views": 3, "source_distance": 5, "detector_distance": 7, "detector": [5, 4]}
    cone |= {"detector_size": [3, 3], "volume_size": 2}
    geometry = dtv.capture.ProjectionGeometry.from_dict(cone)
    scan = dtv.capture.ProjectionCapture(geometry, torch.from_numpy(values), torch.from_numpy(values) + 1)
    scan.save(own / "a.npz")
    scan.save(own / "b.h5")
    np.savez_compressed(own / "c.npz", geometry=json.dumps(cone), intensities=values + 1, flat=2.0)
    with h5py.File(own / "d.h5", "w") as file:
        file["exchange/data"], file["exchange/data_white"] = values + 1, np.full((2, 4, 5), 2.0)
        file["exchange/theta"] = np.array([0.0, 60, 120])
    np.save(own / "e.npy", values)
    tigre = {"DSD": 7, "DSO": 5, "nDetector": [4, 5], "sDetector": [3, 3], "sVoxel": [2, 2, 2], "angles": [0, 1, 2]}
    (own / "e.json").write_text(json.dumps(tigre))
    turning = {"type": "parallel3d", "DetectorSpacingX": 1, "DetectorSpacingY": 1, "DetectorColCount": 5}
    turning |= {"DetectorRowCount": 4, "ProjectionAngles": [0, 1, 2]}
    (own / "f.json").write_text(json.dumps({"proj_geom": turning}))
    (own / "g.json").write_text(json.dumps(geometry.to_dict()))
    views = [{"file_path": f"{k}.npy", "angle": float(k)} for k in range(3)]
    for view, projection in zip(views, values):
        np.save(own / view["file_path"], projection)
    meta = {"scanner": tigre | {"mode": "cone"}, "proj_train": views[:2], "proj_test": views[2:]}
    (own / "meta_data.json").write_text(json.dumps(meta))
    files = {"a.npz": (), "b.h5": (), "c.npz": (), "d.h5": (), "e.npy": ("e.json",), "meta_data.json": ("0.npy",)}
    seeds = [Seed("scan", own, name, (name, *others)) for name, others in files.items()]
    return seeds + [Seed("geometry", own, name, (name,)) for name in ("e.json", "f.json", "g.json")]
