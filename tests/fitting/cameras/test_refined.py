"""Poses and intrinsics as unknowns of a fit."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import signal

import pytest
import torch

import difftetvr as dtv
from difftetvr.capture.truth import BLACK, Truth
from difftetvr.fitting import CameraRefinement, RefinedCameras
from difftetvr.fitting.cameras.alignment import StillWorld, align_held_out
from difftetvr.fitting.cameras.curvature import WorldMotion, gauss_newton_steps, pose_curvature
from difftetvr.fitting.cameras.refined import rotation_of
from difftetvr.fitting.processes import ALONE
from difftetvr.fitting.records.folder import RunFolder

REPORT = importlib.import_module("difftetvr.view.report")
OPTIONS = CameraRefinement()
FIT = {"cells": 900, "iterations": 150, "evaluate_every": 0, "device": "cpu", "rate": 0.05, "refine": "none"}


def capture_of(views: int = 12, size: int = 24) -> dtv.Capture:
    """Views of a ball with stripes, which tell its place and how it is turned."""
    mesh = dtv.TetMesh.grid((8, 8, 8), (-1, -1, -1), (1, 1, 1))
    x, y, z = mesh.vertices.T
    inside = (mesh.vertices.norm(dim=1) < 0.8).float()
    color = torch.stack(
        [0.5 + 0.5 * torch.sin(5 * x), 0.5 + 0.5 * torch.sin(5 * y + 1), 0.5 + 0.5 * torch.cos(5 * z)], 1
    )
    cameras = dtv.capture.fibonacci_orbit(views, (0.0, 0.0, 0.0), 4.0, 0.7, size, size)
    images = dtv.render(mesh, dtv.Field(color, 8.0 * inside), cameras)
    test = torch.arange(views) % 6 == 2
    return dtv.Capture(list(cameras), images.color, images.alpha.clamp(0, 1), test, mesh.bounds(), "ball")


def turned(camera: dtv.Camera, motion: torch.Tensor) -> dtv.Camera:
    """The camera turned about itself and shifted."""
    pose = camera.world_to_camera.double().clone()
    pose[:3, :3] = rotation_of(motion[:3].double()) @ pose[:3, :3]
    pose[:3, 3] = rotation_of(motion[:3].double()) @ pose[:3, 3] + motion[3:].double()
    return camera.with_pose(pose.to(camera.world_to_camera))


@pytest.fixture(scope="module")
def ball() -> dtv.Capture:
    return capture_of()


@pytest.fixture(scope="module")
def shaken(ball: dtv.Capture) -> dtv.Capture:
    """The same with poses that are off by a pixel and more."""
    random = torch.Generator().manual_seed(1)
    cameras = [turned(camera, 0.02 * torch.randn(6, generator=random)) for camera in ball.cameras]
    return dataclasses.replace(ball, cameras=cameras)


def test_a_rotation_is_that_of_its_vector() -> None:
    vector = torch.tensor([0.3, -0.4, 0.5], dtype=torch.float64)
    x, y, z = vector.tolist()
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    assert torch.allclose(rotation_of(vector), torch.linalg.matrix_exp(skew))
    assert torch.autograd.gradcheck(rotation_of, vector.requires_grad_())
    assert torch.autograd.gradcheck(rotation_of, torch.zeros(3, dtype=torch.float64, requires_grad=True))


def test_at_first_cameras_are_as_given(ball: dtv.Capture) -> None:
    cameras = RefinedCameras(ball, OPTIONS, True, True)
    for found, given in zip(cameras.cameras(), ball.cameras, strict=True):
        assert torch.allclose(found.world_to_camera, given.world_to_camera, atol=1e-6)
        assert (found.fx, found.cy, found.width) == pytest.approx((given.fx, given.cy, given.width))
        assert found.world_to_camera.dtype == given.world_to_camera.dtype


def test_a_camera_is_differentiable_in_its_motion_and_intrinsics(ball: dtv.Capture) -> None:
    cameras = RefinedCameras(ball, OPTIONS, True, True)
    points = torch.tensor([[0.1, 0.2, 0.3], [-0.4, 0.1, 0.0]], dtype=torch.float64)
    camera = ball.cameras[3]
    double = dataclasses.replace(ball, cameras=[c.with_pose(c.world_to_camera.double()) for c in ball.cameras])
    cameras = RefinedCameras(double, OPTIONS, True, True)

    def project(motion: torch.Tensor, lens: torch.Tensor) -> torch.Tensor:
        return cameras.camera_with(3, motion, lens).project(points)[0]

    zeros = [torch.zeros(n, dtype=torch.float64, requires_grad=True) for n in (6, 3)]
    assert torch.allclose(project(*zeros).float(), camera.project(points.float())[0], atol=1e-3)
    steps = [torch.linspace(-0.1, 0.1, n, dtype=torch.float64).requires_grad_() for n in (6, 3)]
    assert torch.autograd.gradcheck(project, steps, atol=1e-3)
    zoomed = cameras.camera_with(3, torch.zeros(6).double(), torch.tensor([math.log(2.0), 0.0, 0.0]).double())
    assert zoomed.fx == pytest.approx(2.0 * camera.fx)


def test_what_all_views_have_in_common_is_held_still(ball: dtv.Capture) -> None:
    cameras = RefinedCameras(ball, OPTIONS, True, False)
    views = ball.train_indices.tolist()
    cameras.motion.grad = torch.randn(12, 6, dtype=torch.float64) + 3.0
    cameras.curvature[:] = 1e3 * torch.eye(6, dtype=torch.float64)
    cameras.step(views, 0.0)
    rows = cameras.motion.detach()[ball.train_indices]
    places = torch.stack([ball.cameras[view].position.double() for view in views])
    places -= places.mean(0)
    assert float(rows.abs().max()) > 1e-4
    assert float(rows.mean(0).abs().max()) < 1e-12
    assert float((rows[:, 3:] * places).sum()) == pytest.approx(0.0, abs=1e-9)
    assert float(cameras.motion.detach()[ball.test_indices].abs().max()) == 0.0


def test_only_views_that_were_seen_take_a_step(ball: dtv.Capture) -> None:
    cameras = RefinedCameras(ball, OPTIONS, True, False)
    cameras.motion.grad = torch.ones(12, 6, dtype=torch.float64)
    cameras.curvature[:] = torch.eye(6, dtype=torch.float64)
    cameras.step([1], 0.0)
    known = cameras.state()["motion_curvature"].flatten(1).any(1)
    assert known.tolist() == [False, True] + [False] * 10


def test_steps_lead_to_the_least_value_of_a_quadratic_model_and_are_not_too_long() -> None:
    generator = torch.Generator().manual_seed(2)
    roots = torch.randn(3, 6, 6, generator=generator, dtype=torch.float64)
    curvature = roots @ roots.transpose(1, 2) + torch.eye(6, dtype=torch.float64)
    least = 1e-3 * torch.randn(3, 6, generator=generator, dtype=torch.float64)
    gradient = -(curvature @ least[..., None])[..., 0]
    steps = gauss_newton_steps(gradient, curvature, 0.1)
    assert float((steps - least).norm()) < 0.02 * float(least.norm())
    short = gauss_newton_steps(1e6 * gradient, curvature, 0.1)
    lengths = torch.maximum(short[:, :3].norm(dim=1), short[:, 3:].norm(dim=1))
    assert torch.allclose(lengths, torch.full_like(lengths, 0.1))
    assert torch.allclose(torch.nn.functional.normalize(short, dim=1), torch.nn.functional.normalize(steps, dim=1))
    # What no image depends on is left as it is.
    assert not gauss_newton_steps(torch.zeros(1, 6).double(), torch.zeros(1, 6, 6).double(), 0.1).any()


@pytest.mark.parametrize("is_fisheye", [False, True])
def test_curvature_is_near_that_of_images_that_were_rendered_again(is_fisheye: bool) -> None:
    """It is taken from the slopes of one image, so it is that of an image a little blurred: rather smaller."""
    mesh = dtv.TetMesh.grid((8, 8, 8), (-1, -1, -1), (1, 1, 1), dtype=torch.float64)
    density = 8.0 * (0.9 - mesh.vertices.norm(dim=1)).clamp(min=0.0)
    field = dtv.Field(0.5 + 0.5 * torch.sin(2.0 * mesh.vertices), density)
    capture = capture_of(views=5, size=64)
    views = [camera.with_pose(camera.world_to_camera.double()) for camera in capture.cameras]
    if is_fisheye:
        pose = dtv.Camera.look_at((0.0, 0.5, 1.1), (1.5, 0.0, 0.0)).world_to_camera.double()
        views[3] = dtv.LensCamera(pose, 24.0, 24.0, 32.0, 32.0, 64, 64, model="fisheye", coefficients=[-0.05])
        assert bool(views[3].ray_directions().isnan().any())
    cameras = RefinedCameras(dataclasses.replace(capture, cameras=views), OPTIONS, True, False)
    seen, lens, step = dtv.render(mesh, field, cameras.known(3)), torch.zeros(3, dtype=torch.float64), 1e-4
    columns = []
    for axis in torch.eye(6, dtype=torch.float64):
        ends = [dtv.render(mesh, field, cameras.camera_with(3, s * step * axis, lens)).color for s in (1.0, -1.0)]
        columns.append(((ends[0] - ends[1]) / (2.0 * step)).flatten())
    jacobian = torch.stack(columns, dim=1)
    expected = 2.0 * jacobian.T @ jacobian
    found = cameras.curvature_of(cameras.known(3), seen, torch.ones_like(seen.color))
    ratios = torch.linalg.eigvals(torch.linalg.solve(expected, found)).real
    assert float(ratios.min()) > 0.3 and float(ratios.max()) < 1.6, ratios


def test_a_camera_in_the_middle_of_its_world_has_a_curvature() -> None:
    """Also where it sees nothing, which is taken to be as far away as the middle."""
    mesh = dtv.TetMesh.grid((4, 4, 4), (-1, -1, -1), (1, 1, 1))
    x, y, _ = mesh.vertices.T
    field = dtv.Field(torch.rand(len(x), 3), 0.5 * ((x > 0.9) & (y > 0.0)))
    camera = dtv.Camera.look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), width=8, height=8)
    image = dtv.render(mesh, field, camera)
    assert not image.alpha.all()
    motion = WorldMotion(torch.zeros(3, dtype=torch.float64), 1.0)
    found = pose_curvature(camera, image, torch.ones_like(image.color), motion)
    assert bool(torch.isfinite(found).all()) and bool(found.any())


def test_held_out_views_of_nothing_stay_where_they_are(ball: dtv.Capture) -> None:
    mesh = dtv.TetMesh.grid((2, 2, 2), (-1, -1, -1), (1, 1, 1))
    empty = dtv.Field(torch.rand(mesh.num_vertices, 3), torch.zeros(mesh.num_vertices))
    cameras = RefinedCameras(ball, OPTIONS, True, False)
    world = StillWorld(mesh, empty, Truth(ball, torch.device("cpu")), BLACK, False)
    align_held_out(cameras, OPTIONS, world, [2, 8], ALONE)
    assert not bool(cameras.motion.any())


def test_refined_poses_explain_the_images_better(ball: dtv.Capture, shaken: dtv.Capture) -> None:
    plain = dtv.FitConfig(**FIT)
    refining = dtv.FitConfig(**FIT, refine_poses=True, cameras=OPTIONS)
    as_given, refined = dtv.fit(shaken, plain), dtv.fit(shaken, refining)
    assert as_given.refined is None and refined.refined is not None
    gain = refined.evaluation.mean_psnr - as_given.evaluation.mean_psnr
    assert gain > 2.0, gain
    assert "cameras" in refined.metrics and "cameras" not in as_given.metrics


def test_intrinsics_are_found(ball: dtv.Capture) -> None:
    wrong = [dataclasses.replace(c, fx=1.04 * c.fx, fy=1.04 * c.fy) for c in ball.cameras]
    capture = dataclasses.replace(ball, cameras=wrong)
    options = CameraRefinement(intrinsics_rate=2e-3)
    result = dtv.fit(capture, dtv.FitConfig(**(FIT | {"iterations": 40}), refine_intrinsics=True, cameras=options))
    assert result.refined is not None
    factor = result.refined.summary()["focal_factor"]
    assert factor != 1.0 and result.refined.summary()["translation"] == 0.0


def test_a_run_that_was_interrupted_goes_on_to_the_same_poses(shaken: dtv.Capture, tmp_path) -> None:
    config = dtv.FitConfig(**(FIT | {"iterations": 8, "cells": 300}), refine_poses=True)
    whole = dtv.fit(shaken, config)
    path = tmp_path / "checkpoint.safetensors"

    def stop(status: dtv.fitting.Progress) -> None:
        if status.iteration == 3:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        dtv.fit(shaken, config, checkpoint=path, on_progress=stop)
    resumed = dtv.fit(shaken, config, checkpoint=path, resume=True)
    assert whole.refined is not None and resumed.refined is not None
    assert torch.equal(whole.refined.motion, resumed.refined.motion)
    assert whole.evaluation.psnr == resumed.evaluation.psnr


def test_a_run_without_is_not_gone_on_with(shaken: dtv.Capture, tmp_path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    config = dtv.FitConfig(**(FIT | {"iterations": 1, "cells": 300}))
    dtv.fit(shaken, config, checkpoint=path)
    with pytest.raises(dtv.FitError, match="refine_poses"):
        dtv.fit(shaken, dataclasses.replace(config, refine_poses=True), checkpoint=path, resume=True)


def test_cameras_are_written_as_they_were_found(shaken: dtv.Capture, tmp_path) -> None:
    config = dtv.FitConfig(**(FIT | {"iterations": 4, "cells": 300}), refine_poses=True)
    result = dtv.fit(shaken, config)
    folder = RunFolder(tmp_path)
    REPORT.write_report(folder, result, shaken)
    written = json.loads(folder.cameras.read_text())["cameras"]
    assert len(written) == 12 and [camera["test"] for camera in written] == shaken.test.tolist()
    assert result.refined is not None
    pose = torch.tensor(written[4]["world_to_camera"])
    assert torch.allclose(pose, result.refined.known(4).world_to_camera)
    assert not torch.allclose(pose, shaken.cameras[4].world_to_camera, atol=1e-5)


@pytest.mark.parametrize("options", [{"rate": 0.0}, {"final_rate": -1.0}, {"align_steps": -1}, {"intrinsics_rate": 0}])
def test_options_out_of_range_are_errors(options: dict) -> None:
    with pytest.raises(dtv.FitError, match=f"cameras.{next(iter(options))}"):
        CameraRefinement(**options)
