"""What parameters lens models have, and in which order OpenCV, COLMAP and nerfstudio give them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LensModel:
    """A family of lenses.

    Attributes:
        coefficients: Their names, in the order of the model's own source.
        terms: What each of them is in the formulas of :class:`difftetvr.LensCamera`.
        counts: How many of them may be given; the others are 0.
        is_fisheye: Whether angles are bent, not coordinates in the plane at distance 1.
        profile: How radii are bent, one of `difftetvr.rendering.cameras.lenses.radial.PROFILES`.
        is_chained: Whether what is not radial is of coordinates that are bent already.
    """

    coefficients: tuple[str, ...]
    terms: tuple[str, ...]
    counts: tuple[int, ...]
    is_fisheye: bool = False
    profile: str = "rational"
    is_chained: bool = False


LENS_MODELS = {
    "opencv": LensModel(
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"),
        ("k1", "k2", "p1", "p2", "k3", "d1", "d2", "d3", "s1", "s2", "s3", "s4", "t1", "t2"),
        (2, 4, 5, 8, 12, 14),
    ),
    "nerfstudio": LensModel(
        ("k1", "k2", "k3", "k4", "p1", "p2"),
        ("k1", "k2", "k3", "k4", "p1", "p2"),
        (2, 6),
    ),
    "fov": LensModel(("omega",), ("omega",), (1,), profile="fov"),
    "division": LensModel(("k",), ("k",), (1,), profile="division"),
    "eucm": LensModel(("alpha", "beta"), ("alpha", "beta"), (2,), profile="eucm"),
    "fisheye": LensModel(("k1", "k2", "k3", "k4"), ("k1", "k2", "k3", "k4"), (0, 1, 2, 4), is_fisheye=True),
    "thin-prism-fisheye": LensModel(
        ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
        ("k1", "k2", "p1", "p2", "k3", "k4", "s1", "s3"),
        (8,),
        is_fisheye=True,
    ),
    "rad-tan-thin-prism-fisheye": LensModel(
        ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
        ("k1", "k2", "k3", "k4", "k5", "k6", "p2", "p1", "s1", "s2", "s3", "s4"),
        (12,),
        is_fisheye=True,
        is_chained=True,
    ),
}
"""Models by name.

Sources: OpenCV's manual, modules calib3d and fisheye; https://colmap.github.io/cameras.html and COLMAP's
sensor/models; cameras/camera_utils.py of nerfstudio.
"""


@dataclass(frozen=True)
class FileCamera:
    """A camera as a file names it.

    Attributes:
        model: Its lens, one of `LENS_MODELS`.
        parameters: Names of its numbers in the file's order.
    """

    model: str
    parameters: tuple[str, ...]


_ONE_FOCAL, _TWO_FOCALS = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")

COLMAP_CAMERAS = {
    name: FileCamera(model, (*pinhole, *LENS_MODELS[model].coefficients[:count]))
    for name, pinhole, model, count in (
        ("SIMPLE_PINHOLE", _ONE_FOCAL, "opencv", 0),
        ("PINHOLE", _TWO_FOCALS, "opencv", 0),
        ("SIMPLE_RADIAL", _ONE_FOCAL, "opencv", 1),
        ("RADIAL", _ONE_FOCAL, "opencv", 2),
        ("OPENCV", _TWO_FOCALS, "opencv", 4),
        ("FULL_OPENCV", _TWO_FOCALS, "opencv", 8),
        ("OPENCV_FISHEYE", _TWO_FOCALS, "fisheye", 4),
        ("SIMPLE_RADIAL_FISHEYE", _ONE_FOCAL, "fisheye", 1),
        ("RADIAL_FISHEYE", _ONE_FOCAL, "fisheye", 2),
        ("THIN_PRISM_FISHEYE", _TWO_FOCALS, "thin-prism-fisheye", 8),
        ("RAD_TAN_THIN_PRISM_FISHEYE", _TWO_FOCALS, "rad-tan-thin-prism-fisheye", 12),
        ("SIMPLE_FISHEYE", _ONE_FOCAL, "fisheye", 0),
        ("FISHEYE", _TWO_FOCALS, "fisheye", 0),
        ("FOV", _TWO_FOCALS, "fov", 1),
        ("SIMPLE_DIVISION", _ONE_FOCAL, "division", 1),
        ("DIVISION", _TWO_FOCALS, "division", 1),
        ("EUCM", _TWO_FOCALS, "eucm", 2),
    )
}
"""COLMAP's cameras by name. Source: https://colmap.github.io/cameras.html."""

_PERSPECTIVE = (
    FileCamera("opencv", ("k1", "k2", "p1", "p2", "k3")),
    FileCamera("nerfstudio", LENS_MODELS["nerfstudio"].coefficients),
)
_ARIA = "rad-tan-thin-prism-fisheye"

TRANSFORMS_CAMERAS = {
    **dict.fromkeys(
        ("", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"), _PERSPECTIVE
    ),
    "OPENCV_FISHEYE": (FileCamera("fisheye", LENS_MODELS["fisheye"].coefficients),),
    "FISHEYE624": (FileCamera(_ARIA, LENS_MODELS[_ARIA].coefficients),),
}
"""Cameras of a transforms.json by its ``camera_model``: coefficients alone; of several the first that has all.

Sources: nerfstudio/cameras/cameras.py and camera_utils.py of nerfstudio, docs/nerf_dataset_tips.md of instant-ngp.
"""
