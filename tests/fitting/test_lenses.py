"""Reconstruction from photographs whose lenses are kept."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import difftetvr as dtv
from difftetvr.capture.orbit import fibonacci_orbit
from difftetvr.fitting.records.checkpoint import describe_capture
from difftetvr.fitting.refinement import Exchange
from difftetvr.fitting.trainer import Trainer

COEFFICIENTS = [-0.35, 0.1]


def with_lens(camera: dtv.Camera) -> dtv.LensCamera:
    numbers = (camera.world_to_camera, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    return dtv.LensCamera(*numbers, coefficients=torch.tensor(COEFFICIENTS, dtype=torch.float64))


def without_lens(capture: dtv.Capture) -> dtv.Capture:
    """As if the lens did not distort."""
    cameras = [dtv.Camera(c.world_to_camera, c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in capture.cameras]
    return dataclasses.replace(capture, cameras=cameras)


@pytest.fixture(scope="module")
def barrel() -> dtv.Capture:
    """Views of a colourful cube from near, through a lens that makes a barrel of it."""
    mesh = dtv.TetMesh.grid((4, 4, 4), (-1, -1, -1), (1, 1, 1))
    generator = torch.Generator().manual_seed(0)
    color = torch.rand(mesh.num_vertices, 3, generator=generator)
    field = dtv.Field(color, torch.full((mesh.num_vertices,), 8.0))
    cameras = [with_lens(camera) for camera in fibonacci_orbit(30, torch.zeros(3), 3.4, 1.2, 24, 24)]
    with torch.no_grad():
        images = [dtv.render(mesh, field, camera) for camera in cameras]
    test = torch.zeros(30, dtype=torch.bool)
    test[::6] = True
    return dtv.Capture(
        list(cameras),
        torch.stack([image.color for image in images]).clamp(0, 1),
        torch.stack([image.alpha for image in images]).clamp(0, 1),
        test,
        torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
        "barrel",
        encoding="srgb",
    )


OPTIONS = {"cells": 700, "iterations": 100, "evaluate_every": 0, "device": "cpu", "rate": 0.05, "background": "black"}


def test_fits_see_through_the_lens(barrel: dtv.Capture) -> None:
    """With refinement, motion and the visual hull; whoever ignores the lens loses decibels."""
    config = dtv.FitConfig(**OPTIONS, harmonics=1, start="hull", exchange=Exchange(rounds=4, views=4))
    kept = dtv.fit(barrel, config)
    ignored = dtv.fit(without_lens(barrel), config)
    assert kept.history.refinements and kept.history.moves.steps > 0
    assert kept.metrics["psnr"] > ignored.metrics["psnr"] + 4.0
    assert kept.metrics["psnr"] > 24.0


def test_runs_go_on_with_the_lens_they_began_with(barrel: dtv.Capture, tmp_path) -> None:
    config = dtv.FitConfig(**OPTIONS | {"iterations": 8}, harmonics=0, refine="none", start="grid")
    path = tmp_path / "run.safetensors"
    whole = dtv.fit(barrel, config, checkpoint=path)
    again = dtv.fit(barrel, config, checkpoint=path, resume=True)
    assert torch.equal(again.field.color, whole.field.color)
    with pytest.raises(dtv.FitError, match="lenses = 30, these have 0"):
        dtv.fit(without_lens(barrel), config, checkpoint=path, resume=True)
    assert describe_capture(barrel)["lenses"] == 30


@pytest.mark.usefixtures("kernel_threads")
def test_saved_captures_give_the_same_bits(barrel: dtv.Capture, tmp_path) -> None:
    barrel.save(tmp_path / "barrel.npz")
    again = dtv.load_capture(tmp_path / "barrel.npz")
    config = dtv.FitConfig(
        **OPTIONS | {"iterations": 6}, harmonics=0, start="hull", deterministic=True, exchange=Exchange(rounds=1)
    )
    one, other = (dtv.fit(capture, config) for capture in (barrel, again))
    assert torch.equal(one.field.color, other.field.color) and torch.equal(one.mesh.vertices, other.mesh.vertices)


def test_no_vertex_is_put_before_the_cameras(barrel: dtv.Capture) -> None:
    room = dataclasses.replace(barrel, alphas=None, surroundings=9.0)
    options = OPTIONS | {"cells": 1500, "iterations": 2}
    trainer = Trainer(room, dtv.FitConfig(**options, harmonics=0, free_space=0.5, start="grid"))
    for _ in range(2):
        trainer.step()
    is_free = room.free_space(0.5).vertices_of(trainer.mesh)
    assert bool(is_free.any()) and bool((trainer.parameters.detached_field().density[is_free] == 0.0).all())
