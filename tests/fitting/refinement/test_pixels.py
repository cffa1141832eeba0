"""Pixels that refinements are judged on."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.capture import Capture
from difftetvr.capture.truth import Truth
from difftetvr.fitting.records.evaluation import true_image
from difftetvr.fitting.refinement import pixels
from difftetvr.fitting.refinement.pixels import JudgedPixels, Judgement
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering.gauss_newton import HatChoice, model_image

VIEWS = [0, 3, 5]
BACKGROUND = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def capture() -> Capture:
    return dtv.VolumeCapture(views=8, width=24, height=20).build()


@pytest.fixture(scope="module")
def scene(capture: Capture) -> tuple[TetMesh, Field]:
    low, high = capture.bounds.tolist()
    mesh = TetMesh.grid((4, 3, 5), low, high, dtype=torch.float32)
    generator = torch.Generator().manual_seed(3)
    density = 20.0 * torch.rand(mesh.num_vertices, generator=generator)
    return mesh, Field(torch.rand(mesh.num_vertices, 3, generator=generator), density)


def truth_of(capture: Capture) -> Truth:
    return Truth(capture, torch.device("cpu"))


def judgement(capture: Capture, mesh: TetMesh) -> Judgement:
    return Judgement.of(truth_of(capture), VIEWS, mesh, BACKGROUND, np.random.default_rng(0))


def test_all_pixels_of_a_view_are_its_image(capture: Capture) -> None:
    every = JudgedPixels.of(truth_of(capture), 2, BACKGROUND)
    assert every.count == 24 * 20
    every = every.in_a_row
    directions = capture.cameras[2].rays().directions.reshape(-1, 3)
    places = [int((directions == direction).all(1).nonzero()[0]) for direction in every.rays.directions[0]]
    assert sorted(places) == list(range(24 * 20))
    assert torch.equal(every.truth[0], true_image(capture, 2, BACKGROUND).reshape(-1, 3)[places])


@pytest.mark.parametrize("count", [1, 7, 100, 479, 480, 1000])
@pytest.mark.parametrize("begin", [0.0, 0.999])
def test_chosen_pixels_are_different_and_spread(capture: Capture, count: int, begin: float) -> None:
    every = JudgedPixels.of(truth_of(capture), 2, BACKGROUND)
    some = every.spread(count, begin)
    assert some.count == min(count, every.count)
    assert len(torch.unique(some.in_a_row.rays.directions[0], dim=0)) == some.count


def test_models_are_means_over_the_views(
    capture: Capture, scene: tuple[TetMesh, Field], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, field = scene
    monkeypatch.setattr(pixels, "_CROSSINGS", 1e6)
    judged = judgement(capture, mesh)
    assert [part.count for part in judged.parts] == [24 * 20] * len(VIEWS)
    images = [model_image(mesh, field, capture.cameras[view], true_image(capture, view)) for view in VIEWS]
    expected = (images[0] + images[1] + images[2]).scaled(1 / 3)
    dealt = Judgement.of(truth_of(capture), VIEWS, mesh, BACKGROUND, np.random.default_rng(0), shares=2)
    assert [len(share) for share in dealt.shares] == [2, 1]
    for found in (one.model(mesh, field, True) for one in (judged, judged.together(), dealt, dealt.together())):
        for kind in ("vertices", "edges", "faces"):
            one, other = getattr(found, kind), getattr(expected, kind)
            assert float((one.gradient - other.gradient).norm()) <= 1e-3 * float(other.gradient.norm())
            assert float((one.absorption - other.absorption).norm()) <= 1e-3 * float(other.absorption.norm())
        assert found.error == pytest.approx(expected.error, rel=1e-4)
        assert judged.error(mesh, field) == pytest.approx(expected.error, rel=1e-4)
    assert dealt.together().error(mesh, field) == pytest.approx(expected.error, rel=1e-4)


@pytest.mark.parametrize("has_steps", [False, True])
def test_a_process_without_pixels_has_a_model_that_changes_no_sum(
    capture: Capture, scene: tuple[TetMesh, Field], has_steps: bool
) -> None:
    mesh, field = scene
    hats = HatChoice(face_steps=torch.ones(mesh.topology.faces.shape[0], 4)) if has_steps else None
    model = judgement(capture, mesh).together().model(mesh, field, True, hats)
    nothing = Judgement([], len(VIEWS)).model(mesh, field, True, hats)
    total, known = model + nothing, model.face_steps if has_steps else model.faces
    assert total.error == model.error and Judgement([], len(VIEWS)).error(mesh, field) == 0.0
    for one, other in ((total.vertices, model.vertices), (total.edges, model.edges)):
        assert torch.equal(one.gradient, other.gradient) and torch.equal(one.coupling, other.coupling)
    found = total.face_steps if has_steps else total.faces
    assert type(found) is type(known) and (total.faces is None) == has_steps
    name = "slope" if has_steps else "gradient"
    assert torch.equal(getattr(found, name), getattr(known, name))


def test_no_more_pixels_than_the_cells_need(
    capture: Capture, scene: tuple[TetMesh, Field], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, field = scene
    monkeypatch.setattr(pixels, "_CROSSINGS", 3.0)
    judged = judgement(capture, mesh)
    wanted = 3.0 * mesh.num_cells ** (2 / 3) / len(VIEWS)
    assert [part.count for part in judged.parts] == [round(wanted)] * len(VIEWS)
    assert round(wanted) < 24 * 20
    model = judged.together().model(mesh, field, True)
    assert model.error == pytest.approx(judged.error(mesh, field), rel=1e-4)


@pytest.mark.parametrize(("limit", "each"), [(0.5, 80), (1.0, 160), (3.0, 480), (math.inf, 480)])
def test_a_limit_is_of_all_views_together(
    capture: Capture, scene: tuple[TetMesh, Field], monkeypatch: pytest.MonkeyPatch, limit: float, each: int
) -> None:
    monkeypatch.setattr(pixels, "_CROSSINGS", 1e6)
    judged = Judgement.of(truth_of(capture), VIEWS, scene[0], BACKGROUND, np.random.default_rng(0), limit)
    assert [part.count for part in judged.parts] == [each] * len(VIEWS)


def test_masked_pixels_have_no_error(capture: Capture, scene: tuple[TetMesh, Field]) -> None:
    mesh, field = scene
    spoilt = capture.images.clone()
    spoilt[:, :, :12] = 7.0
    valid = torch.ones(8, 20, 24, dtype=torch.bool)
    valid[:, :, :12] = False
    masked = replace(capture, images=spoilt, valid=valid)
    found, half = (judgement(one, mesh).error(mesh, field) for one in (masked, replace(capture, valid=valid)))
    assert found == pytest.approx(half)
    assert judgement(masked, mesh).model(mesh, field, True).error == pytest.approx(found, rel=1e-4)
