"""The viewer while its camera moves: how long a frame takes, in how many pixels, and how long the picture in full.

A camera goes around cubes of several numbers of cells, without and with a transfer function; times hold drawing and
packing, not the way to a browser.

    python benchmarks/viewer.py [--width 1280] [--height 720] [--frames 60]
"""

from __future__ import annotations

import argparse
import io
import math
import time

import numpy as np
import torch
from PIL import Image

import difftetvr as dtv
from difftetvr.fitting.loop import one_torch_thread
from difftetvr.view.live.contents import MeshContent
from difftetvr.view.live.scene import Scene
from difftetvr.view.live.settings import Settings
from difftetvr.view.live.studio import STILL_SECONDS, Studio

MIDDLE, WARM_UP = (0.5, 0.5, 0.5), 30
CUBES = ((15, "20 k"), (24, "79 k"), (55, "1 M"))


def scene(side: int, is_scalar: bool, camera: dtv.Camera) -> Scene:
    """A hollow ball in a cube."""
    mesh = dtv.TetMesh.grid((side, side, side if side != 24 else 23))
    distance = (mesh.vertices - 0.5).norm(dim=1)
    density = 30.0 * torch.exp(-(((distance - 0.3) / 0.05) ** 2))
    field = dtv.Field(mesh.vertices.clone(), density)
    shown = dtv.ScalarField(distance, dtv.TransferFunction.default(), 20.0) if is_scalar else field
    content = MeshContent(mesh, shown)
    return Scene("ball", content, content.bounds, camera, (0.0, 0.0, 1.0), Settings())


def camera_at(angle: float, size: tuple[int, int]) -> dtv.Camera:
    eye = (0.5 + 1.7 * math.cos(angle), 0.5 + 1.7 * math.sin(angle), 1.1)
    return dtv.Camera.look_at(eye, MIDDLE, (0.0, 0.0, 1.0), 0.9, *size)


def measured(studio: Studio, size: tuple[int, int], frames: int) -> tuple[float, tuple[int, ...], float]:
    """Seconds of a moving frame, its pixels, and seconds from rest to the picture in full."""
    shown: list[tuple[int, ...]] = []

    def show(picture: object, is_full: bool) -> None:
        pixels: np.ndarray = picture.pixels  # type: ignore[attr-defined]
        Image.fromarray(pixels).save(io.BytesIO(), "JPEG", quality=95 if is_full else 80)
        shown.append(pixels.shape[1::-1])

    window = studio.open(show)
    for frame in range(WARM_UP + frames):
        if frame == WARM_UP:
            start = time.perf_counter()
        studio.look(window, camera_at(0.03 * frame, size))
        studio.work(1.0)
    seconds, pixels = (time.perf_counter() - start) / frames, shown[-1]
    studio.look(window, camera_at(0.0, size))
    start = time.perf_counter()
    while not window.is_done:
        studio.work(1.0)
    studio.close(window)
    return seconds, pixels, time.perf_counter() - start - STILL_SECONDS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=720)
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args()
    size = (options.width, options.height)
    print("| cells | | moving, pixels | ms | frames a second | in full, ms |\n|---|---|---|---|---|---|")
    for side, name in CUBES:
        for is_scalar in (False, True):
            shown = scene(side, is_scalar, camera_at(0.0, size))
            with one_torch_thread():
                seconds, pixels, full = measured(Studio(shown, print), size, options.frames)
            kind = "transfer function" if is_scalar else "colours"
            row = (name, kind, f"{pixels[0]} x {pixels[1]}", f"{1e3 * seconds:.0f}", f"{1 / seconds:.0f}")
            print(f"| {' | '.join(row)} | {1e3 * full:.0f} |")


if __name__ == "__main__":
    main()
