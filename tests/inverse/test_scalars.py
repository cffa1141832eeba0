"""Scalars of a moving, refining mesh from images through a transfer function."""

from __future__ import annotations

import signal

import pytest
import torch
from torch import Tensor

import difftetvr as dtv
from difftetvr.inverse import ScalarConfig, fit_scalar
from difftetvr.inverse.scalars.beginning import matching, ranked
from difftetvr.inverse.scalars.reconstruction import ScalarReconstruction
from difftetvr.inverse.variation import total_variation
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import ScalarField

RAMP = dtv.TransferFunction(
    torch.tensor([0.0, 0.2, 1.0]),
    torch.tensor([0.0, 0.05, 0.6]),
    torch.tensor([[0.1, 0.2, 1.0], [0.9, 0.8, 0.2], [1, 0, 0]]),
)
OTHER = dtv.TransferFunction(
    torch.tensor([0.0, 0.5, 1.0]), torch.tensor([0.0, 0.3, 0.1]), torch.tensor([[1.0, 0.0, 0.0], [0, 1, 0], [0, 0, 1]])
)
ATTENUATION = 12.0
SMALL = {"cells": 700, "iterations": 120, "evaluate_every": 0, "exchange": {"rounds": 6, "start": 0.1}}


def blob(mesh: TetMesh) -> Tensor:
    """A smooth scalar in [0, 1], 0 at the boundary."""
    return torch.exp(-8.0 * (mesh.vertices - torch.tensor([0.1, 0.0, -0.1])).square().sum(1))


def capture_of(mesh: TetMesh, field: ScalarField, views: int = 12, size: int = 32) -> dtv.Capture:
    cameras = dtv.capture.fibonacci_orbit(views, (0.0, 0.0, 0.0), 1.6, width=size, height=size)
    with torch.no_grad():
        images = torch.stack([dtv.render(mesh, field, camera).color for camera in cameras])
    test = torch.arange(views) % 4 == 1
    return dtv.Capture(cameras, images.clamp(min=0), None, test, mesh.bounds(), "blob", ATTENUATION)


@pytest.fixture(scope="module")
def scene() -> tuple[TetMesh, Tensor, dtv.Capture]:
    mesh = TetMesh.grid((10, 10, 10), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    scalar = blob(mesh)
    return mesh, scalar, capture_of(mesh, ScalarField(scalar, RAMP, ATTENUATION, (0.0, 1.0)))


def test_scalars_show_the_right_thing_through_other_functions_too(scene) -> None:
    mesh, scalar, capture = scene
    result = fit_scalar(capture, RAMP, ScalarConfig.from_json(SMALL))
    assert result.evaluation.mean_psnr > 27.0
    assert len(result.history.refinements) == 6 and result.mesh.num_cells <= 700
    result.mesh.validate()
    assert float(result.field.scalar.min()) >= 0.0 and float(result.field.scalar.max()) <= 1.0
    unseen = capture_of(mesh, ScalarField(scalar, OTHER, ATTENUATION, (0.0, 1.0)))
    through = ScalarField(result.field.scalar, OTHER, ATTENUATION, (0.0, 1.0))
    errors = [
        float((dtv.render(result.mesh, through, camera).color - image).square().mean())
        for camera, image in zip(unseen.cameras, unseen.images, strict=True)
    ]
    assert max(errors) < 10**-2.2
    assert result.metrics["psnr"] == result.evaluation.mean_psnr


def test_a_constant_start_and_a_fixed_mesh_will_do(scene) -> None:
    _, _, capture = scene
    options = SMALL | {"colors_first": 0, "move": False, "refine": "none", "rate": 0.03}
    result = fit_scalar(capture, RAMP, ScalarConfig.from_json(options))
    assert result.evaluation.mean_psnr > 24.0


def test_total_variation_makes_scalars_flatter_and_is_part_of_the_loss(scene) -> None:
    *_, capture = scene
    still = SMALL | {"iterations": 40, "colors_first": 0, "move": False, "refine": "none"}
    results = [fit_scalar(capture, RAMP, ScalarConfig.from_json(still | {"total_variation": w})) for w in (0.0, 3e-3)]
    rough, flat = (float(total_variation(result.mesh, result.field.scalar).value) for result in results)
    assert flat < 0.95 * rough
    mesh, values = TetMesh.grid((4, 4, 4), *capture.bounds.tolist()), torch.rand(125)
    runs = [
        ScalarReconstruction(
            capture, RAMP, ScalarConfig(total_variation=w, refine="none"), ATTENUATION, mesh, values.clone()
        )
        for w in (0.0, 3e-3)
    ]
    for run in runs:
        run.step()
    # The box's side is 1.
    variation = float(total_variation(mesh, values).value)
    assert runs[1].history.loss[0] - runs[0].history.loss[0] == pytest.approx(3e-3 * variation, rel=0.02)


def test_an_unknown_function_is_found_along_with_the_scalars(scene) -> None:
    _, _, capture = scene
    result = fit_scalar(capture, None, ScalarConfig.from_json(SMALL | {"unknown": "both", "knots": 8}))
    assert result.evaluation.mean_psnr > 24.0
    assert len(result.transfer_function.scalar) == 8


@pytest.mark.parametrize("unknown", ["scalar", "both"])
def test_a_run_that_was_interrupted_ends_as_if_it_had_not(scene, tmp_path, unknown: str) -> None:
    _, _, capture = scene
    options = SMALL | {"iterations": 30, "unknown": unknown, "exchange": {"rounds": 3}}
    function, config = RAMP if unknown == "scalar" else None, ScalarConfig.from_json(options)
    whole, path, seen = fit_scalar(capture, function, config), tmp_path / "run.safetensors", []

    def stop(progress) -> None:
        if progress.iterations == 30 and progress.iteration == 17:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        fit_scalar(capture, function, config, checkpoint=path, on_progress=stop)
    pictures = []

    def look(progress) -> None:
        seen.append(progress)
        if progress.iteration == 30:
            pictures.append((progress.picture(1), progress.field))

    resumed = fit_scalar(capture, function, config, checkpoint=path, resume=True, on_progress=look)
    assert [progress.iteration for progress in seen] == list(range(18, 31))
    picture, field = pictures[0]
    assert torch.equal(field.scalar, resumed.field.scalar)
    assert torch.equal(picture.rendered, dtv.render(resumed.mesh, resumed.field, capture.cameras[1]).color)
    assert torch.equal(resumed.field.scalar, whole.field.scalar)
    assert torch.equal(resumed.mesh.vertices, whole.mesh.vertices)
    assert torch.equal(resumed.transfer_function.opacity, whole.transfer_function.opacity)
    if unknown == "scalar":
        with pytest.raises(dtv.FitError, match="function"):
            fit_scalar(capture, OTHER, config, checkpoint=path, resume=True)
        with pytest.raises(dtv.FitError, match="cells"):
            fit_scalar(capture, RAMP, ScalarConfig.from_json(options | {"cells": 900}), checkpoint=path, resume=True)


def test_matching_finds_the_scalars_that_made_a_field(scene) -> None:
    mesh, scalar, _ = scene
    field = ScalarField(scalar, RAMP, ATTENUATION, (0.0, 1.0)).as_field()
    found = matching(mesh, field, RAMP, ATTENUATION)
    visible = scalar > 0.2
    assert float((found - scalar)[visible].abs().max()) < 0.05


def test_ranks_grow_with_the_density_and_their_function_makes_the_field() -> None:
    density = torch.linspace(0.0, 6.0, 200)[torch.randperm(200, generator=torch.Generator().manual_seed(0))]
    field = Field(torch.rand(200, 3, generator=torch.Generator().manual_seed(1)), density)
    scalars, function = ranked(field, ATTENUATION, 16)
    assert torch.equal(scalars.argsort(), density.argsort())
    _, opacity = function(scalars)
    assert float((ATTENUATION * opacity - density).abs().max()) < 0.4


def test_what_cannot_be_is_refused_in_a_sentence(scene) -> None:
    _, _, capture = scene
    with pytest.raises(dtv.FitError, match="known transfer function"):
        fit_scalar(capture)
    flat = dtv.TransferFunction(torch.tensor([0.0, 1.0]), torch.tensor([0.3, 0.3]), torch.ones(2, 3))
    with pytest.raises(dtv.FitError, match="same for all scalars"):
        fit_scalar(capture, flat, ScalarConfig(cells=100, iterations=1, colors_first=0))
    with pytest.raises(dtv.FitError, match="capture is"):
        fit_scalar("tooth", RAMP)  # type: ignore[arg-type]
    for options, word in (({"knots": 1}, "knots"), ({"unknown": "nothing"}, "unknown"), ({"rate": 0.0}, "rate")):
        with pytest.raises(dtv.FitError, match=word):
            ScalarConfig.from_json(options)
