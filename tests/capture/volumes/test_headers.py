"""What headers may leave open or say in odd ways by their formats' definitions: unknown distances, scales, units."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import nibabel
import numpy as np
import pytest

from difftetvr.capture import Volume
from difftetvr.capture.volumes.volume import load_raw
from difftetvr.capture.volumes.volume_file import RawVolume
from difftetvr.errors import CaptureError

VALUES = np.random.default_rng(0).integers(-1000, 3000, (3, 4, 5)).astype(np.int16)


def raw(path: Path) -> RawVolume:
    return load_raw(path, None, None)


def nrrd(folder: Path, fields: str) -> RawVolume:
    head = f"NRRD0005\ntype: int16\ndimension: 3\nsizes: 5 4 3\nendian: little\nencoding: raw\n{fields}\n\n"
    (folder / "v.nrrd").write_bytes(head.encode() + VALUES.tobytes())
    return raw(folder / "v.nrrd")


def metaimage(folder: Path, fields: str) -> RawVolume:
    head = f"NDims = 3\nDimSize = 5 4 3\nElementType = MET_SHORT\n{fields}\nElementDataFile = LOCAL\n"
    (folder / "v.mha").write_bytes(head.encode() + VALUES.tobytes())
    return raw(folder / "v.mha")


def nifti(folder: Path, kind: type, slope: float, intercept: float) -> Path:
    image = kind(VALUES.T, np.eye(4))
    image.header.set_data_dtype(np.int16)
    nibabel.save(image, folder / "v.nii")
    content = bytearray((folder / "v.nii").read_bytes())
    place, form = (112, "<ff") if kind is nibabel.Nifti1Image else (176, "<dd")
    struct.pack_into(form, content, place, slope, intercept)
    (folder / "v.nii").write_bytes(content)
    return folder / "v.nii"


@pytest.mark.parametrize(
    ("fields", "spacing", "words"),
    [
        ("spacings: nan nan nan", (1, 1, 1), "along x, y and z; it is taken as 1"),
        ("spacings: 2 2 nan", (2, 2, 2), "along z; it is taken as that along x, 2"),
        ("axis mins: 0 0 nan\naxis maxs: 5 8 nan", (1, 2, 1), "along z; it is taken as that along x, 1"),
        ('spacings: 200 200 1\nunits: "nm" "nm" "um"', (200, 200, 1000), "in nm and um; all are taken in nm"),
        ('spacings: 200 200 nan\nunits: "nm" "nm" ""', (200, 200, 200), "along z"),
        ('spacings: 2 2 3\nunits: "mm" "mm" "pixel"', (1, 1, 1), "in mm and pixel, which cannot be compared"),
        (
            'space dimension: 3\nspace directions: (2,0,0) (0,2,0) (0,0,3)\nspace units: "mm" "mm" "cm"',
            (2, 2, 30),
            "in mm and cm",
        ),
    ],
)
def test_nrrd_of_unknown_distances_and_several_units(tmp_path: Path, fields: str, spacing: tuple, words: str) -> None:
    volume = nrrd(tmp_path, fields)
    np.testing.assert_allclose(volume.spacing, spacing)
    (note,) = volume.notes
    assert words in note


def test_nrrd_that_tells_its_distances_needs_no_words(tmp_path: Path) -> None:
    assert nrrd(tmp_path, 'spacings: 1 2 3\nunits: "mm" "mm" "mm"').notes == ()
    with pytest.raises(CaptureError, match="gives the sample distances '1 2 three'; it needs a number for each axis"):
        nrrd(tmp_path, "spacings: 1 2 three")


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
@pytest.mark.parametrize(
    ("slope", "intercept"), [(0.0, 7.0), (0.0, math.nan), (math.nan, math.nan), (math.nan, 0.0), (math.inf, 1.0)]
)
def test_nifti_without_a_scale(tmp_path: Path, kind: type, slope: float, intercept: float) -> None:
    volume = raw(nifti(tmp_path, kind, slope, intercept))
    assert np.array_equal(volume.values, VALUES) and volume.values.dtype == np.int16


def test_nifti_with_a_slope_only(tmp_path: Path) -> None:
    """What adds no number adds nothing, which is said, because the slope counts."""
    volume = raw(nifti(tmp_path, nibabel.Nifti1Image, 2.0, math.nan))
    assert np.array_equal(volume.values, 2.0 * VALUES)
    assert "intercept" in volume.notes[0]


def test_metaimage_scales_its_values(tmp_path: Path) -> None:
    volume = metaimage(tmp_path, "ElementToIntensityFunctionSlope = 0.5\nElementToIntensityFunctionOffset = -1024")
    assert np.array_equal(volume.values, 0.5 * VALUES - 1024.0)
    # Hounsfield units of a range mean what they say.
    scalars = Volume.load(tmp_path / "v.mha", value_range=(-2000, 1000)).values
    np.testing.assert_allclose(scalars, (np.clip(volume.values, -2000, 1000) + 2000) / 3000, atol=1e-6)
    assert metaimage(tmp_path, "ElementToIntensityFunctionOffset = 0").values.dtype == np.int16
    with pytest.raises(CaptureError, match="ElementToIntensityFunctionSlope 'steep', which is no number it can be"):
        metaimage(tmp_path, "ElementToIntensityFunctionSlope = steep")
    with pytest.raises(CaptureError, match="ElementToIntensityFunctionSlope '0'"):
        metaimage(tmp_path, "ElementToIntensityFunctionSlope = 0")
