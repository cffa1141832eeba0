"""Volumes lie in the world as their files say: every exchange and reversal of axes, in every format that tells them."""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.capture import Volume
from difftetvr.capture.volumes.orientation import in_world_axes
from difftetvr.capture.volumes.volume_file import RawVolume
from difftetvr.errors import CaptureError, CaptureWarning

pytestmark = pytest.mark.filterwarnings("ignore:.*stand for 0 to 1:difftetvr.errors.CaptureWarning")

# values[z, y, x], all of them different, no axis as long as another.
VALUES = np.random.default_rng(0).permutation(60).reshape(3, 4, 5).astype(np.uint8)
SPACING = np.array([1.0, 2.0, 3.0])
TURNS = [
    np.eye(3)[list(axes)] * np.array(signs)[:, None]
    for axes in itertools.permutations(range(3))
    for signs in itertools.product((1, -1), repeat=3)
]
"""Every way in which the axes of a file can run along the world's; row a is the direction of the file's axis a."""


def in_world(directions: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """The samples by the world's coordinates, found by sorting the place of each; and the spacing along these."""
    indices = np.stack(np.meshgrid(*map(np.arange, VALUES.shape[::-1]), indexing="ij"), -1).reshape(-1, 3)
    places = (indices * SPACING) @ directions
    order = np.lexsort(places.T)  # z last, so it counts most
    resolution = [len(np.unique(places[:, axis])) for axis in range(3)]
    values = VALUES[tuple(indices[order, ::-1].T)].reshape(resolution[::-1])
    return values, [float(np.diff(np.unique(places[:, axis]))[0]) for axis in range(3)]


def assert_lies_there(path: Path, directions: np.ndarray) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        volume = Volume.load(path)
    values, spacing = in_world(directions)
    np.testing.assert_array_equal(np.rint(volume.values * 255), values)
    np.testing.assert_allclose(volume.spacing, spacing)


def vectors(directions: np.ndarray) -> str:
    return " ".join("({},{},{})".format(*step) for step in directions * SPACING[:, None])


def nrrd(space: str, axes: str) -> bytes:
    head = f"NRRD0005\ntype: uint8\ndimension: 3\nspace: {space}\nsizes: 5 4 3\nspace directions: {axes}\n"
    return f"{head}encoding: raw\n\n".encode() + VALUES.tobytes()


@pytest.mark.parametrize("turn", TURNS[::5])
def test_every_format_tells_the_same_world(tmp_path: Path, turn: np.ndarray) -> None:
    (tmp_path / "v.nrrd").write_bytes(nrrd("left-posterior-superior", vectors(turn)))
    assert_lies_there(tmp_path / "v.nrrd", turn)

    matrix = " ".join(str(v) for v in turn.T.ravel())  # VTK's columns are the axes
    text = " ".join(str(v) for v in VALUES.ravel())
    (tmp_path / "v.vti").write_text(
        f'<VTKFile type="ImageData"><ImageData WholeExtent="0 4 0 3 0 2" Spacing="1 2 3" Direction="{matrix}">'
        '<Piece Extent="0 4 0 3 0 2"><PointData><DataArray type="UInt8" Name="a" format="ascii">'
        f"{text}</DataArray></PointData></Piece></ImageData></VTKFile>"
    )
    assert_lies_there(tmp_path / "v.vti", turn)

    image = SimpleITK.GetImageFromArray(VALUES)
    image.SetSpacing(SPACING.tolist())
    image.SetDirection(turn.T.ravel().tolist())
    SimpleITK.WriteImage(image, tmp_path / "v.mha")
    assert_lies_there(tmp_path / "v.mha", turn)

    affine = np.eye(4)
    affine[:3, :3] = (turn * SPACING[:, None]).T
    nibabel.save(nibabel.Nifti1Image(VALUES.T, affine), tmp_path / "v.nii")
    assert_lies_there(tmp_path / "v.nii", turn)


@pytest.mark.parametrize("turn", TURNS)
def test_all_exchanges_and_reversals(turn: np.ndarray) -> None:
    turned = in_world_axes(RawVolume(VALUES, (1.0, 2.0, 3.0), turn), "v")
    values, spacing = in_world(turn)
    np.testing.assert_array_equal(turned.values, values)
    assert list(turned.spacing) == spacing and not turned.notes


def test_spaces_that_are_left_handed_themselves_are_no_mirrors(tmp_path: Path) -> None:
    """The same scan, told in a right-handed and in two left-handed systems, whose first axis runs the other way."""
    (tmp_path / "right.nrrd").write_bytes(nrrd("RAS", "(-1,0,0) (0,2,0) (0,0,3)"))
    expected = Volume.load(tmp_path / "right.nrrd").values
    for name in ("left-anterior-superior", "3D-left-handed"):
        (tmp_path / "left.nrrd").write_bytes(nrrd(name, "(1,0,0) (0,2,0) (0,0,3)"))
        np.testing.assert_array_equal(Volume.load(tmp_path / "left.nrrd").values, expected)


def test_ends_of_axes_give_distances_and_senses(tmp_path: Path) -> None:
    head = "NRRD0005\ntype: uint8\ndimension: 3\nsizes: 5 4 3\naxis mins: 5 0 0\naxis maxs: 0 8 4\n"
    (tmp_path / "v.nrrd").write_bytes(f"{head}centers: cell cell node\nencoding: raw\n\n".encode() + VALUES.tobytes())
    volume = Volume.load(tmp_path / "v.nrrd")
    np.testing.assert_allclose(volume.spacing, (1, 2, 2))
    np.testing.assert_array_equal(np.rint(volume.values * 255), VALUES[:, :, ::-1])


def test_nifti_without_an_orientation_is_as_its_definition_says(tmp_path: Path) -> None:
    """And not with x reversed, as nibabel reads it."""
    image = nibabel.Nifti1Image(VALUES.T, None)
    image.header["pixdim"][1:4] = SPACING
    image.to_file_map({"image": nibabel.FileHolder(tmp_path / "v.nii")})
    header = nibabel.load(tmp_path / "v.nii").header
    assert header["sform_code"] == header["qform_code"] == 0
    assert_lies_there(tmp_path / "v.nii", np.eye(3))


def test_turned_axes_are_taken_for_the_nearest_and_it_is_said(tmp_path: Path) -> None:
    cos, sin = 4 / 5, 3 / 5
    (tmp_path / "v.nrrd").write_bytes(nrrd("LPS", f"(0,0,1) ({cos},{sin},0) ({3 * sin},{-3 * cos},0)"))
    with pytest.warns(CaptureWarning, match=r"turned by 36\.9 degrees against the world's; .* the nearest ones"):
        volume = Volume.load(tmp_path / "v.nrrd")
    np.testing.assert_allclose(volume.spacing, (1, 3, 1))
    # The file's y is the world's x, its z the world's -y, and its x the world's z.
    np.testing.assert_array_equal(np.rint(volume.values * 255), VALUES.transpose(2, 0, 1)[:, ::-1])


IN_WORLD = [in_world(turn)[0] for turn in TURNS]


@given(st.integers(0, 47), st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3))
def test_a_turned_volume_keeps_its_handedness(index: int, angles: list[float]) -> None:
    directions = TURNS[index].copy()
    for axis, angle in enumerate(angles):
        rotation = np.eye(3)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        rotation[[a, a, b, b], [a, b, a, b]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        directions = directions @ rotation
    turned = in_world_axes(RawVolume(VALUES, (1.0, 1.0, 1.0), directions), "v").values
    senses = {np.linalg.det(turn) > 0 for turn, values in zip(TURNS, IN_WORLD) if np.array_equal(values, turned)}
    assert senses == {np.linalg.det(TURNS[index]) > 0}


@pytest.mark.parametrize(
    "axes, message",
    [
        ("(1,0,0) (1,1,0) (0,0,1)", "axes x and y .* meet at 45 degrees; resample"),
        ("(1,0,0) (0,0,0) (0,0,1)", "three vectors that differ from 0"),
        ("(1,0,0) (0,1) (0,0,1)", "three vectors"),
        ("(1,0,0) (0,nan,0) (0,0,1)", "three vectors"),
        ("(1,0,0) (0,1e999,0) (0,0,1)", "three vectors"),
        ("(1,0,0) (0,1,0)", "all axes"),
    ],
)
def test_axes_that_are_no_right_angles_are_refused(tmp_path: Path, axes: str, message: str) -> None:
    (tmp_path / "v.nrrd").write_bytes(nrrd("LPS", axes))
    with pytest.raises(CaptureError, match=message):
        Volume.load(tmp_path / "v.nrrd")
