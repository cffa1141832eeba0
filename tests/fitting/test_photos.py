"""Reconstruction from photographs: choices, directional colours, masks, losses."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import difftetvr as dtv
from difftetvr.capture.orbit import fibonacci_orbit
from difftetvr.fitting.losses import l1, l1_ssim, sparsity
from difftetvr.fitting.metrics import ssim
from difftetvr.fitting.records.checkpoint import Checkpoint
from difftetvr.fitting.refinement import Exchange, Refinement
from difftetvr.fitting.trainer import Trainer
from difftetvr.mesh.harmonics import COUNTS

FAST = {"cells": 400, "iterations": 60, "evaluate_every": 0, "device": "cpu", "rate": 0.05}


@pytest.fixture(scope="module")
def shiny() -> dtv.Capture:
    """Views of a ball whose colour depends on the direction, with alpha."""
    mesh = dtv.TetMesh.grid((4, 4, 4), (-1, -1, -1), (1, 1, 1))
    radius = mesh.vertices.norm(dim=1)
    generator = torch.Generator().manual_seed(0)
    harmonics = 0.25 * torch.randn(COUNTS[1], 3, generator=generator).expand(mesh.num_vertices, -1, -1)
    color = torch.full((mesh.num_vertices, 3), 0.5)
    field = dtv.Field(color, 6.0 * (radius < 0.9).float(), "vertex", harmonics)
    cameras = fibonacci_orbit(24, torch.zeros(3), 4.0, 0.7, 24, 24)
    with torch.no_grad():
        images = [dtv.render(mesh, field, camera) for camera in cameras]
    test = torch.zeros(24, dtype=torch.bool)
    test[::6] = True
    return dtv.Capture(
        list(cameras),
        torch.stack([image.color for image in images]).clamp(0, 1),
        torch.stack([image.alpha for image in images]).clamp(0, 1),
        test,
        torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
        "shiny",
        encoding="srgb",
    )


def test_what_is_left_open_is_chosen_for_the_images(shiny: dtv.Capture) -> None:
    chosen = dtv.FitConfig().for_capture(shiny)
    assert (chosen.background, chosen.harmonics, chosen.density_rate, chosen.pace) == ("random", 2, 5.0, 8.0)
    assert chosen.evaluation_background() == (1.0, 1.0, 1.0)
    assert chosen.start == "hull" and chosen.strategy().rounds == 32
    for few, rounds in ((600, 10), (9600, 64)):
        assert dataclasses.replace(chosen, iterations=few).strategy().rounds == rounds
    given = dataclasses.replace(chosen, exchange=dtv.fitting.Exchange(rounds=7))
    assert (given.strategy().rounds, given.strategy().pixels) == (7, 36)
    assert dataclasses.replace(chosen, start="grid").strategy().rounds is None
    opaque = dataclasses.replace(shiny, alphas=None)
    of_opaque = dtv.FitConfig().for_capture(opaque)
    assert (of_opaque.background, of_opaque.density_rate, of_opaque.pace) == ("black", 1.0, 8.0)
    light = dataclasses.replace(shiny, encoding="linear")
    of_light = dtv.FitConfig().for_capture(light)
    assert (light.encoding, of_light.harmonics, of_light.density_rate, of_light.pace) == ("linear", 0, 1.0, 8.0)
    options = {"background": "white", "harmonics": 0, "cells": 500, "start": "grid", "iterations": 9}
    given = dtv.FitConfig(**options, free_space=0.1, density_rate=2.0, pace=3.0, averaging=0.5)
    assert given.for_capture(shiny) == given
    assert dtv.FitConfig.from_json(chosen.to_json()) == chosen


def test_directional_colours_are_recovered(shiny: dtv.Capture) -> None:
    options = FAST | {"move": False, "refine": "none", "iterations": 200, "harmonics_rate": 0.5}
    options |= {"grid": (4, 4, 4), "start": "grid", "density_rate": 1.0}  # the truth's, and it is no surface
    flat = dtv.fit(shiny, dtv.FitConfig(harmonics=0, **options))
    directional = dtv.fit(shiny, dtv.FitConfig(harmonics=1, **options))
    assert flat.field.harmonics is None
    assert directional.field.harmonics.shape == (directional.mesh.num_vertices, 3, 3)
    assert directional.metrics["psnr"] > flat.metrics["psnr"] + 8.0


def test_bands_are_switched_on_one_after_the_other() -> None:
    config = dtv.FitConfig(iterations=100, harmonics=2)
    assert [config.bands_at(i) for i in (0, 4, 5, 9, 10, 99)] == [0, 0, 1, 1, 2, 2]
    assert dtv.FitConfig(iterations=100, harmonics=0).bands_at(99) == 0


@pytest.fixture(scope="module")
def room(shiny: dtv.Capture) -> dtv.Capture:
    """The same views, taken through fog that is a little different before each camera, and without alpha."""
    fog = 0.1 + 0.3 * torch.rand(len(shiny.cameras), 1, 1, 3, generator=torch.Generator().manual_seed(1))
    return dataclasses.replace(shiny, images=0.7 * shiny.images + 0.3 * fog, alphas=None, surroundings=9.0)


@pytest.mark.parametrize("start", ["grid", "points"])
def test_nothing_is_put_before_the_cameras(room: dtv.Capture, start: str, monkeypatch: pytest.MonkeyPatch) -> None:
    points = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(2)), dim=1)
    capture = dataclasses.replace(room, points=0.9 * points)
    exchange = Exchange(rounds=6, views=3, until=0.5)
    options = FAST | {"cells": 3000, "iterations": 30, "start": start, "exchange": exchange}
    config = dtv.FitConfig(**options, harmonics=0, pace=1.0)  # few vertices come out or in within a step
    assert config.for_capture(capture).free_space == 0.8 and config.for_capture(room).free_space == 0.5
    assert config.for_capture(dataclasses.replace(capture, surroundings=1.0)).free_space == 0.0
    trainer = Trainer(capture, config)
    space, apply, refined = capture.free_space(0.8), Trainer._apply, []

    def applied(self: Trainer, refinement: Refinement) -> None:
        apply(self, refinement)
        refined.append(torch.equal(space.vertices_of(self.mesh), self.parameters.is_free))

    monkeypatch.setattr(Trainer, "_apply", applied)
    for _ in range(30):
        trainer.step()
    assert refined == [True] * len(trainer.history.refinements)
    is_free = trainer.parameters.is_free
    assert int(is_free.sum()) > 30 and trainer.history.refinements
    assert (trainer.parameters.detached_field().density[is_free] == 0.0).all()
    foggy = dtv.fit(capture, dataclasses.replace(config, free_space=0.0, refine="none"))
    assert float(foggy.field.density[space.contains(foggy.mesh.vertices)].mean()) > 0.0


def test_free_space_lies_before_the_training_cameras(room: dtv.Capture) -> None:
    space = room.free_space(0.5)
    assert space.cameras == [room.cameras[view] for view in room.train_indices.tolist()]
    beyond = dataclasses.replace(room, points=torch.full((1, 3), 1e6))
    assert beyond.free_space(0.5).reaches == space.reaches


def test_free_space_empties_an_initial_field(room: dtv.Capture) -> None:
    mesh = dtv.TetMesh.grid((6, 6, 6), (-5, -5, -5), (5, 5, 5))
    trainer = Trainer(room, dtv.FitConfig(**FAST, harmonics=0), mesh)
    is_free = room.free_space(0.5).vertices_of(mesh)
    assert is_free.any() and ((trainer.parameters.density == 0.0) == is_free).all()


@pytest.mark.parametrize("name", ["shiny", "room"])
@pytest.mark.usefixtures("kernel_threads")
def test_resuming_gives_the_same_bits(name: str, tmp_path, request) -> None:  # type: ignore[no-untyped-def]
    capture = request.getfixturevalue(name)
    options = FAST | {"cells": 3000, "iterations": 16, "exchange": Exchange(rounds=3, views=3)}
    config = dtv.FitConfig(harmonics=2, **options)

    def advance(trainer: Trainer, count: int) -> Trainer:
        for _ in range(count):
            trainer.step()
        return trainer

    whole = advance(Trainer(capture, config), 16)
    assert whole.history.refinements
    half = advance(Trainer(capture, config), 7)
    half.checkpoint().save(tmp_path / "half.safetensors")
    again = advance(Trainer.resume(capture, config, Checkpoint.load(tmp_path / "half.safetensors")), 9)
    expected, found = whole.checkpoint().tensors, again.checkpoint().tensors
    assert expected.keys() == found.keys() and "harmonics.exp_avg" in expected
    assert bool(expected["is_free"].any()) == (name == "room")
    for name, tensor in expected.items():
        assert torch.equal(tensor, found[name]), name


def test_masked_pixels_do_not_count(shiny: dtv.Capture) -> None:
    """What they show is neither learnt from nor judged by, nor does refinement look at it."""
    valid = torch.ones(shiny.images.shape[:3], dtype=torch.bool)
    valid[:, 8:14, 6:20] = False
    wrong = torch.where(valid[..., None], shiny.images, 0.9)
    options = FAST | {"iterations": 12, "exchange": Exchange(rounds=2, views=3)}
    results = []
    for images in (shiny.images, wrong):
        capture = dataclasses.replace(shiny, images=images, valid=valid, alphas=None)
        results.append(dtv.fit(capture, dtv.FitConfig(harmonics=0, **options)))
    assert torch.equal(results[0].field.color, results[1].field.color)
    assert results[0].metrics["psnr"] == pytest.approx(results[1].metrics["psnr"], abs=1e-4)
    unmasked = dtv.fit(dataclasses.replace(shiny, images=wrong, alphas=None), dtv.FitConfig(harmonics=0, **options))
    assert not torch.equal(unmasked.field.color, results[0].field.color)


def test_masked_psnr_is_that_of_the_other_pixels(shiny: dtv.Capture) -> None:
    from difftetvr.fitting.metrics import psnr_of_mse
    from difftetvr.fitting.records.evaluation import evaluate

    valid = torch.ones(shiny.images.shape[:3], dtype=torch.bool)
    valid[:, :12] = False
    mesh = dtv.TetMesh.grid((1, 1, 1), (-1, -1, -1), (1, 1, 1))
    field = dtv.Field(torch.full((8, 3), 0.5), torch.ones(8))
    seen = evaluate(mesh, field, dataclasses.replace(shiny, valid=valid), [3])
    image = dtv.render(mesh, field, shiny.cameras[3]).color
    error = (image - shiny.images[3])[valid[3]].double().square().mean()
    assert seen.psnr[0] == pytest.approx(psnr_of_mse(float(error)), abs=1e-4)


def test_loss_with_ssim() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(16, 20, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    truth = torch.rand(16, 20, 3, generator=generator, dtype=torch.float64)
    expected = 0.8 * float(l1(image, truth).detach()) + 0.2 * (1.0 - ssim(image, truth))
    assert float(l1_ssim(image, truth).detach()) == pytest.approx(expected, abs=1e-12)
    assert float(l1_ssim(truth, truth)) == pytest.approx(0.0, abs=1e-12)
    assert torch.autograd.gradcheck(lambda x: l1_ssim(x, truth), image)


def test_sparsity_empties_fog(shiny: dtv.Capture) -> None:
    assert float(sparsity(torch.tensor([0.0, 1.0]))) == pytest.approx(0.5 * torch.log(torch.tensor(3.0)))
    options = FAST | {"move": False, "refine": "none", "harmonics": 0, "haze_penalty": 0.0}
    dense, sparse = (dtv.fit(shiny, dtv.FitConfig(sparsity=weight, **options)) for weight in (0.0, 0.1))
    assert float(sparse.field.density.mean()) < float(dense.field.density.mean())


@pytest.mark.parametrize("option", [{"harmonics": 4}, {"harmonics": -1}, {"harmonics_rate": 0.0}, {"sparsity": -1.0}])
def test_bad_options(option: dict[str, float]) -> None:
    with pytest.raises(dtv.FitError, match=f"^The option {next(iter(option))} is "):
        dtv.FitConfig(**option)  # type: ignore[arg-type]


def test_masked_pixels_do_not_dilute_errors(shiny: dtv.Capture) -> None:
    """Nor do they dilute the errors of the others; views without any other pixel are left out."""
    valid = torch.zeros(24, 24, 24, dtype=torch.bool)
    valid[:, :, :3] = True
    masked = dataclasses.replace(shiny, valid=valid)
    cropped = dataclasses.replace(
        shiny,
        cameras=[dataclasses.replace(c, width=3) for c in shiny.cameras],
        images=shiny.images[:, :, :3].contiguous(),
        alphas=shiny.alphas[:, :, :3].contiguous(),
    )
    options = {"iterations": 3, "start": "grid", "haze_penalty": 0.0, "refine": "none", "background": "white"}
    config = dtv.FitConfig(**FAST | options)
    ours, theirs = (dtv.fit(capture, config) for capture in (masked, cropped))
    torch.testing.assert_close(torch.tensor(ours.history.loss), torch.tensor(theirs.history.loss))
    assert ours.metrics["train_psnr"] == pytest.approx(theirs.metrics["train_psnr"], abs=1e-3)
    assert ours.metrics["psnr"] == pytest.approx(theirs.metrics["psnr"], abs=1e-3)
    blank = valid & (torch.arange(24) > 0)[:, None, None]
    assert dtv.fit(dataclasses.replace(shiny, valid=blank), config).evaluation.views == [6, 12, 18]
