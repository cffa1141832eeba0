"""Where samples lie: the places that files tell, against what other readers make of them, and those in views."""

from __future__ import annotations

from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK
from vtkmodules.vtkCommonCore import vtkFloatArray
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkIOXML import vtkXMLImageDataReader, vtkXMLImageDataWriter

from difftetvr.capture import Volume
from difftetvr.capture.volumes.placement import Placement
from difftetvr.errors import CaptureError

SHAPE, SPACING, ORIGIN = (5, 4, 3), (1.0, 2.0, 3.5), (-7.0, 11.0, 0.25)
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # rows: the axes
CORNERS = [(0, 0, 0), (4, 0, 0), (0, 3, 0), (0, 0, 2), (4, 3, 2)]


def place(placement: Placement, index: tuple[int, int, int]) -> np.ndarray:
    return placement.world.origin + (np.array(index) * placement.spacing) @ placement.directions


@pytest.mark.parametrize("suffix", [".nrrd", ".mha", ".nii"])
def test_places_are_those_of_itk(tmp_path: Path, suffix: str) -> None:
    image = SimpleITK.GetImageFromArray(np.arange(60, dtype=np.float32).reshape(3, 4, 5))
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(TURN.T.ravel())
    path = tmp_path / f"v{suffix}"
    SimpleITK.WriteImage(image, str(path))
    found = Placement.of(path)
    assert found.shape == SHAPE
    # ITK's world is LPS, NIfTI's RAS.
    signs = np.array([-1.0, -1.0, 1.0]) if suffix == ".nii" else np.ones(3)
    assert found.world.space == ("right-anterior-superior" if suffix == ".nii" else "left-posterior-superior")
    for index in CORNERS:
        expected = signs * np.array(image.TransformIndexToPhysicalPoint(index))
        np.testing.assert_allclose(place(found, index), expected, atol=1e-5)


def test_places_are_those_of_nibabel(tmp_path: Path) -> None:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = TURN.T * SPACING, ORIGIN
    image = nibabel.Nifti1Image(np.zeros(SHAPE, np.float32), affine)
    image.header.set_xyzt_units("micron")
    nibabel.save(image, tmp_path / "v.nii.gz")
    found = Placement.of(tmp_path / "v.nii.gz")
    assert found.world.unit == "um"
    for index in CORNERS:
        np.testing.assert_allclose(place(found, index), nibabel.affines.apply_affine(affine, index), atol=1e-5)


def test_places_are_those_of_vtk(tmp_path: Path) -> None:
    image = vtkImageData()
    image.SetExtent(2, 6, -1, 2, 0, 2)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirectionMatrix(*TURN.T.ravel())
    values = vtkFloatArray()
    values.SetName("v")
    values.SetNumberOfValues(60)
    values.Fill(1.0)
    image.GetPointData().SetScalars(values)
    path = tmp_path / "v.vti"
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(path))
    writer.SetInputData(image)
    writer.Write()
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    found, again = Placement.of(path), reader.GetOutput()
    for i, j, k in CORNERS:
        expected = again.GetPoint(again.ComputePointId([i + 2, j - 1, k]))
        np.testing.assert_allclose(place(found, (i, j, k)), expected, atol=1e-5)


def nrrd(folder: Path, fields: str) -> Placement:
    head = f"NRRD0005\ntype: uint8\ndimension: 3\nsizes: 5 4 3\nencoding: raw\n{fields}\n\n"
    (folder / "v.nrrd").write_bytes(head.encode() + bytes(60))
    return Placement.of(folder / "v.nrrd")


@pytest.mark.parametrize(
    ("fields", "origin", "space", "unit"),
    [
        ("spacings: 1 2 3", (0, 0, 0), "", ""),
        (
            'spacings: 1 2 4\naxis mins: 10 20 30\ncenters: node node cell\nunits: "mm" "mm" "mm"',
            (10, 20, 32),
            "",
            "mm",
        ),
        ("axis mins: 10 20 30\naxis maxs: 20 28 33", (11, 21, 30.5), "", ""),
        (
            "space: LAS\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (4,5,6)",
            (-4, 5, 6),
            "right-anterior-superior",
            "",
        ),
        (
            "space dimension: 3\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (4,5,6)\n"
            'space units: "mm" "mm" "cm"',
            (4, 5, 60),
            "",
            "mm",
        ),
        ("space dimension: 3\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (nan,5,6)", (0, 0, 0), "", ""),
    ],
)
def test_what_nrrd_says_of_places(tmp_path: Path, fields: str, origin: tuple, space: str, unit: str) -> None:
    world = nrrd(tmp_path, fields).world
    assert (world.space, world.unit) == (space, unit)
    np.testing.assert_allclose(world.origin, origin)


@pytest.mark.parametrize("spacing", [None, (3.0, 1.0, 2.0)])
def test_places_in_views_are_those_of_the_volume(tmp_path: Path, spacing: tuple[float, float, float] | None) -> None:
    """Each sample is found in `Volume` where its place says: in world axes, within bounds."""
    values = np.random.default_rng(0).permutation(60).reshape(3, 4, 5).astype(np.float32)
    head = "NRRD0005\ntype: float\ndimension: 3\nsizes: 5 4 3\nencoding: raw\nendian: little\n"
    head += "space dimension: 3\nspace directions: (0,-2,0) (0,0,3) (0.5,0,0)\nspace origin: (100,200,300)\n\n"
    (tmp_path / "v.nrrd").write_bytes(head.encode() + values.tobytes())
    volume = Volume.load(tmp_path / "v.nrrd", spacing=spacing, value_range=(0, 59))
    seen = Placement.of(tmp_path / "v.nrrd").in_views(spacing)
    lower = volume.bounds[0].numpy()
    for k, j, i in np.ndindex(3, 4, 5):
        x, y, z = np.rint((place(seen, (i, j, k)) - lower) / volume.cell_size).astype(int)
        np.testing.assert_allclose((place(seen, (i, j, k)) - lower) / volume.cell_size, (x, y, z), atol=1e-5)
        assert volume.values[z, y, x] == pytest.approx(values[k, j, i] / 59)


def test_the_packaged_tooth_has_places() -> None:
    tooth = Placement.of("tooth")
    assert tooth.shape == (103, 94, 161)
    assert place(tooth.in_views(), (102, 93, 160)) == pytest.approx((0.31875, 0.290625, 0.5))


def test_what_nothing_was_fitted_to_has_no_views(tmp_path: Path) -> None:
    slanted = nrrd(tmp_path, "space dimension: 3\nspace directions: (1,0,0) (0,1,0) (0,1,1)")
    with pytest.raises(CaptureError, match=r"axes y and z of .* meet at 45 degrees"):
        slanted.in_views()
    with pytest.raises(CaptureError, match="a single sample along an axis"):
        Placement("v", (5, 1, 3), SPACING, np.eye(3), slanted.world).in_views()
