"""Options of captures and runs of the wrong kind: one short sentence that names the option, never a traceback."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from capture.photos import photo_scene

import difftetvr as dtv
from difftetvr.capture import Capture, PhotoCapture, Volume, VolumeCapture
from difftetvr.errors import CaptureError, DiffTetError
from difftetvr.fitting import FitConfig
from difftetvr.fitting.motion import Motion
from difftetvr.fitting.refinement import Exchange, Grow, Star

JUNK: dict[str, Any] = {
    "text": "abc" * 99,
    "number": 10**6000,
    "class": dict,
    "list": [[1, 2], [3]],
    "objects": np.array([None, "a"]),
    "tensor": torch.rand(6, 6, 3),
    "complex": torch.ones(3, dtype=torch.complex64),
    "meta": torch.empty(3, device="meta"),
    "dict": {"a": 1},
    "square": [[0, 0], [1, 1]],
    "bytes": b"x",
}


def names_of(kind: type, *but: str) -> tuple[str, ...]:
    return tuple(item.name for item in fields(kind) if item.name not in but)


@pytest.fixture(scope="module")
def calls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    folder = tmp_path_factory.mktemp("capture")
    photo_scene.write_transforms(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        capture = dtv.load_capture(folder)
    np.save(folder / "v.npy", np.arange(120.0).reshape(4, 5, 6))
    dtv.TransferFunction.default().save(folder / "f.json")
    values = {item.name: getattr(capture, item.name) for item in fields(Capture)}
    volume = {"path": str(folder / "v.npy"), "transfer_function": str(folder / "f.json")}
    return {
        "load_capture": (dtv.load_capture, {"source": folder}),
        "PhotoCapture": (lambda **options: PhotoCapture(**options).build(), {"path": str(folder)}),
        "fitting_downscale": (PhotoCapture(str(folder)).fitting_downscale, {}),
        "VolumeCapture": (lambda **options: VolumeCapture(**options).build(device="cpu"), volume),
        "Volume": (Volume, {"values": np.ones((3, 4, 5))}),
        "Volume.load": (Volume.load, {"path": folder / "v.npy"}),
        "Capture": (Capture, values),
        "Capture.load": (Capture.load, {}),
        "free_space": (capture.free_space, {}),
        "FitConfig": (FitConfig, {}),
        "Motion": (Motion, {}),
        "Exchange": (Exchange, {}),
        "Grow": (Grow, {}),
        "Star": (Star, {}),
        "fit": (dtv.fit, {"capture": capture, "config": FitConfig(device="cpu", iterations=1)}),
    }


OPTIONS: dict[str, tuple[str, ...]] = {
    "load_capture": ("source", "downscale", "bounds", "test_every", "format"),
    "PhotoCapture": names_of(PhotoCapture),
    "fitting_downscale": ("longest_side",),
    "VolumeCapture": names_of(VolumeCapture, "seed"),
    "Volume": names_of(Volume),
    "Volume.load": ("path", "shape", "dtype", "spacing", "value_range"),
    "Capture": names_of(Capture),
    "Capture.load": ("path",),
    "free_space": ("share",),
    "FitConfig": names_of(FitConfig),
    "Motion": names_of(Motion),
    "Exchange": names_of(Exchange),
    "Grow": names_of(Grow),
    "Star": names_of(Star),
    "fit": ("capture", "config", "mesh", "strategy", "checkpoint", "on_progress"),
}
ACCEPTED = {
    # What is no junk in these places: names and files that need not be there yet, and values of any number.
    ("FitConfig", "initial_mesh"): ("text",),
    ("FitConfig", "device"): ("text",),
    ("fit", "checkpoint"): ("text",),
    ("fit", "on_progress"): ("class",),
    ("Capture", "name"): ("text",),
    ("Volume", "name"): ("text",),
    ("Volume", "values"): ("tensor",),
    ("fitting_downscale", "longest_side"): ("number",),
    **{(kind, "test_every"): ("number",) for kind in ("load_capture", "PhotoCapture", "VolumeCapture")},
}


@pytest.mark.parametrize("call", OPTIONS)
def test_junk_is_refused_in_one_sentence(call: str, calls) -> None:
    function, arguments = calls[call]
    for name in OPTIONS[call]:
        for what, value in JUNK.items():
            if what in ACCEPTED.get((call, name), ()):
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with pytest.raises(DiffTetError) as error:
                    function(**{**arguments, name: value})
            text = str(error.value)
            assert text.endswith(".") and "\n" not in text and "tensor([" not in text, (name, what, text)
            assert len(text) < (900 if what == "text" else 400), (name, what, text)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"downscale": 1.5}, r"The downscale is 1\.5; it must be a whole number\."),
        ({"downscale": True}, r"The downscale is True"),
        ({"bounds": "abc"}, r"The bounds is 'abc'; it must be 6 numbers or 2 times 3 numbers or None\."),
        ({"bounds": [[0, 0], [1, 1]]}, r"The bounds is \[\[0, 0\], \[1, 1\]\]"),
        ({"test_every": "x"}, r"The test_every is 'x'; it must be a whole number or None\."),
        ({"format": "lidar"}, r"The format is 'lidar'; it must be nerf-synthetic, "),
        ({"source": None}, r"The source is None; pass the path of a capture"),
    ],
)
def test_the_option_is_named(calls, options: dict[str, Any], words: str) -> None:
    function, arguments = calls["load_capture"]
    with pytest.raises(CaptureError, match=words):
        function(**{**arguments, **options})


def test_numbers_of_numpy_lists_and_paths_are_taken(calls) -> None:
    path = Path(calls["PhotoCapture"][1]["path"])
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    for bounds in (box, box.ravel(), torch.from_numpy(box), [-1, -1, -1, 1, 1, 1], ((-1, -1, -1), (1, 1, 1))):
        capture = dtv.load_capture(path, downscale=np.int64(2), test_every=np.int32(3), bounds=bounds)
        assert torch.equal(capture.bounds, torch.from_numpy(box).float())
    config = FitConfig(iterations=np.int64(7), rate=torch.tensor(0.5), background=np.ones(3), grid=[1, 2, 3])
    assert (config.iterations, config.rate, config.background, config.grid) == (7, 0.5, (1.0, 1.0, 1.0), (1, 2, 3))
    assert VolumeCapture(path, spacing=[1, 2, 3]).path == str(path)


def test_names_too_long_for_a_file_are_no_capture() -> None:
    with pytest.raises(CaptureError, match="is no capture"):
        dtv.load_capture("a" * 300)
