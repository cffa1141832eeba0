"""Densities from projections: penalties, measurements, the solver against dense algebra, whole runs."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from torch import Tensor

import difftetvr as dtv
from difftetvr.capture.projections.geometry import ProjectionGeometry
from difftetvr.capture.projections.projection_capture import ProjectionCapture
from difftetvr.errors import FitError
from difftetvr.inverse.tomography import TomographyConfig, reconstruct
from difftetvr.inverse.tomography.alignment import Alignment
from difftetvr.inverse.tomography.densities import Densities
from difftetvr.inverse.tomography.likelihoods import LIKELIHOODS
from difftetvr.inverse.tomography.measurements import Measurements, as_camera, steps_for
from difftetvr.inverse.tomography.objective import Objective
from difftetvr.inverse.tomography.solver import solve
from difftetvr.inverse.variation import cell_weights, total_variation, weighted_square
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import render

CONE = {"type": "cone", "views": 24, "arc": 360, "source_distance": 5, "detector_distance": 7, "detector": [40, 36]}
CONE |= {"detector_size": [4, 4], "volume_size": [2, 2, 2]}
COARSE = CONE | {"views": 10, "detector": [16, 14]}
PARALLEL = {"type": "parallel", "views": 24, "arc": 180, "detector": [40, 36], "detector_size": [3, 3]}
PARALLEL |= {"volume_size": [2, 2, 2]}


def jittered(count: int = 4, amount: float = 0.03, dtype: torch.dtype = torch.float64) -> TetMesh:
    mesh = TetMesh.grid((count, count, count), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    noise = torch.randn(mesh.vertices.shape, generator=torch.Generator().manual_seed(0))
    return mesh.with_vertices((mesh.vertices + amount * noise).to(dtype))


def integrals(mesh: TetMesh, density: Tensor, camera: object) -> Tensor:
    found: Tensor = render(mesh, Field(density.new_zeros(len(density), 0), density), camera).optical_depth  # type: ignore[arg-type]
    return found


def scan_of(mesh: TetMesh, density: Tensor, geometry: dict[str, object], holdout: int = 6) -> ProjectionCapture:
    """Noise-free projections of a mesh."""
    parsed = ProjectionGeometry.from_dict(geometry)
    views = [integrals(mesh, density, parsed.view(k)).float() for k in range(parsed.num_views)]
    test = torch.arange(parsed.num_views) % holdout == 2
    return ProjectionCapture(parsed, torch.stack(views), None, None, test)


def ball(mesh: TetMesh) -> Tensor:
    """A dense ball in a thin one, off the middle."""
    places = mesh.vertices.double()
    near = (places - torch.tensor([0.2, -0.1, 0.1], dtype=torch.float64)).norm(dim=1)
    return ((near < 0.4).double() + 0.3 * (places.norm(dim=1) < 0.8).double()).to(mesh.vertices.dtype)


def test_total_variation_is_that_of_the_linear_field() -> None:
    mesh = jittered()
    density = torch.rand(mesh.num_vertices, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    vertices, values = mesh.vertices.clone().requires_grad_(), density.clone().requires_grad_()
    corners, heights = vertices[mesh.tets.long()], values[mesh.tets.long()]
    edges, rises = corners[:, 1:] - corners[:, :1], heights[:, 1:] - heights[:, :1]
    gradients = torch.linalg.solve(edges, rises[..., None])[..., 0]
    expected = (torch.linalg.det(edges) / 6.0 * gradients.norm(dim=1)).sum()
    by_vertices, by_values = torch.autograd.grad(expected, (vertices, values))
    found = total_variation(mesh, density)
    torch.testing.assert_close(found.value, expected.detach())
    torch.testing.assert_close(found.by_density, by_values)
    torch.testing.assert_close(found.by_vertex, by_vertices)
    # The quadratic form that stands for it touches it.
    lagged = weighted_square(mesh, density, cell_weights(mesh, density, 1.0, 0.0, 1e-12))
    torch.testing.assert_close(lagged.by_density, by_values)
    squared = weighted_square(mesh, density, cell_weights(mesh, density, 0.0, 1.0, 1.0))
    half = 0.5 * (torch.linalg.det(edges) / 6.0 * gradients.square().sum(1)).sum()
    torch.testing.assert_close(squared.value, half.detach())


def test_a_flat_density_has_no_variation_and_no_pull() -> None:
    mesh = jittered()
    found = total_variation(mesh, torch.full((mesh.num_vertices,), 3.0))
    assert float(found.value) == 0.0 and not found.by_density.any() and not found.by_vertex.any()


@pytest.mark.parametrize("name", list(LIKELIHOODS))
def test_slopes_are_derivatives_of_losses(name: str) -> None:
    generator = torch.Generator().manual_seed(2)
    found, measured, weight = (torch.rand(64, generator=generator, dtype=torch.float64) for _ in range(3))
    found[:8] = measured[:8] + 1e-3 * torch.rand(8, generator=generator, dtype=torch.float64)
    step = 1e-5
    at, below, above = (LIKELIHOODS[name](found + d, measured, weight) for d in (0.0, -step, step))  # type: ignore[index]
    torch.testing.assert_close(at.slope, (above.loss - below.loss) / (2 * step), rtol=1e-4, atol=1e-6)
    assert bool((at.loss >= 0).all()) and bool((at.curvature >= 0).all())
    if name != "l1":
        torch.testing.assert_close(at.curvature, (above.slope - below.slope) / (2 * step), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("geometry", [CONE, PARALLEL, CONE | {"detector_offset": [0.3, -0.2]}])
def test_strided_pixels_are_pixels_of_the_view(geometry: dict[str, object]) -> None:
    mesh = jittered(dtype=torch.float32)
    density = ball(mesh)
    scan = Measurements(scan_of(mesh, density, geometry), torch.device("cpu"))
    assert scan.density_unit > 0 and scan.peak > 0
    for view, count, phase in ((0, 10_000, (0.5, 0.5)), (3, 200, (0.0, 0.9)), (17, 7, (0.99, 0.3))):
        part = scan.pixels(view, count, phase)
        assert part.count <= count and bool((part.weight > 0).all())
        found = integrals(mesh, density, part.camera)
        assert found.shape == part.measured.shape
        assert float((found - part.measured).abs().max()) < 2e-5 * scan.peak


def test_cameras_stand_for_detectors_where_they_can() -> None:
    cone = ProjectionGeometry.from_dict(CONE).view(5)
    mirrored = dataclasses.replace(cone, columns=-cone.columns)
    assert (as_camera(cone) is None) != (as_camera(mirrored) is None)
    assert as_camera(ProjectionGeometry.from_dict(PARALLEL).view(5)) is None
    skew = dataclasses.replace(cone, rows=cone.rows + 0.1 * cone.columns)
    assert as_camera(skew) is None and as_camera(dataclasses.replace(skew, columns=-skew.columns)) is None
    assert steps_for(512, 512, 16_384) == (4, 4) and steps_for(1, 640, 100) == (1, 7) and steps_for(3, 3, 9) == (1, 1)


def densities_of(mesh: TetMesh, scan: Measurements, values: torch.Tensor) -> Densities:
    densities = Densities(mesh, scan.density_unit, (0.9, 0.99))
    densities.values = values
    return densities


def test_the_solver_finds_what_dense_algebra_does() -> None:
    """Least squares without and with a penalty, on a mesh that knows the answer."""
    mesh = jittered(2)
    density = 0.2 + ball(mesh)
    scan = Measurements(scan_of(mesh, density, COARSE), torch.device("cpu"))
    parts = [scan.pixels(view, scan.all_pixels) for view in scan.train]
    columns = []
    for vertex in range(mesh.num_vertices):
        one = torch.zeros(mesh.num_vertices, dtype=torch.float64)
        one[vertex] = 1.0
        columns.append(torch.cat([integrals(mesh, one, part.camera).reshape(-1) for part in parts]))
    matrix = torch.stack(columns, 1)
    measured = torch.cat([part.measured.reshape(-1) for part in parts]).double()
    weight = float(parts[0].weight[0, 0])
    for tikhonov in (0.0, 0.05):
        objective = Objective("gaussian", 0.0, tikhonov, 8.0)
        start = torch.ones(mesh.num_vertices, dtype=torch.float64)
        solution = solve(mesh, densities_of(mesh, scan, start), lambda: iter(parts), objective, 50)
        found = solution.values * scan.density_unit
        hessian, right = weight / len(measured) * matrix.T @ matrix, weight / len(measured) * matrix.T @ measured
        if tikhonov:
            _, squared, _ = objective.factors(mesh, scan.density_unit)
            eye = torch.eye(mesh.num_vertices, dtype=torch.float64)
            weights = cell_weights(mesh, start, 0.0, squared, 1.0)
            hessian = hessian + torch.stack([weighted_square(mesh, row, weights).by_density for row in eye])
        expected = torch.linalg.solve(hessian, right)
        assert float(expected.min()) > 0, "the constraint would count"
        assert float((found - expected).abs().max()) < 2e-3 * float(expected.max())


def test_the_solver_keeps_densities_from_falling_below_zero() -> None:
    mesh = jittered(3, dtype=torch.float32)
    density = ball(mesh)
    scan = Measurements(scan_of(mesh, density, COARSE), torch.device("cpu"))
    objective = Objective("gaussian", 0.0, 0.0, 8.0)
    start = torch.full((mesh.num_vertices,), 0.5)
    pixels = lambda: (scan.pixels(view, scan.all_pixels) for view in scan.train)  # noqa: E731
    solution = solve(mesh, densities_of(mesh, scan, start), pixels, objective, 40)
    assert bool((solution.values >= 0).all()) and solution.losses[-1] < 1e-2 * solution.losses[0]
    assert float((solution.values * scan.density_unit - density).abs().mean()) < 0.02
    densities = densities_of(mesh, scan, start)
    is_free = mesh.vertices[:, 0] > 0.5
    densities.keep_free(is_free)
    solution = solve(mesh, densities, pixels, objective, 10)
    assert bool((solution.values[is_free] == 0).all()) and float(solution.values[~is_free].max()) > 0


def small(**options: object) -> TomographyConfig:
    return TomographyConfig.from_json(
        {"cells": 600, "iterations": 60, "rays": 1000, "evaluate_every": 0, "solve_steps": 4, **options}
    )


@pytest.mark.parametrize("geometry", [CONE, PARALLEL])
def test_a_run_explains_held_out_views(geometry: dict[str, object]) -> None:
    truth = TetMesh.grid((10, 10, 10), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    capture = scan_of(truth, ball(truth), geometry)
    fixed = reconstruct(capture, small(move=False, refine="none"))
    free = reconstruct(capture, small(iterations=120))
    assert fixed.score.mean_psnr > 24.0
    assert free.score.mean_psnr > fixed.score.mean_psnr + 1.0, "moving and exchanging cells should pay"
    assert len(free.history.refinements) == 6 and free.mesh.num_cells <= 600
    free.mesh.validate()
    assert free.metrics["projection_psnr"] == free.score.mean_psnr


def test_progress_shows_projections_in_grey() -> None:
    mesh = jittered(dtype=torch.float32)
    capture = scan_of(mesh, ball(mesh), COARSE, holdout=4)
    valid = torch.ones_like(capture.line_integrals, dtype=torch.bool)
    valid[2, :3] = False
    seen = []

    def look(progress: dtv.fitting.Progress) -> None:
        if progress.iteration == progress.iterations:
            seen.append((progress.picture(2), progress.mesh, progress.field))

    reconstruct(dataclasses.replace(capture, valid=valid), small(iterations=5, solve_steps=0), on_progress=look)
    picture, found, field = seen[0]
    peak = float(capture.line_integrals[valid].max())
    expected = integrals(found, field.density, capture.geometry.view(2)) / peak
    assert picture.rendered.shape == picture.truth.shape == (14, 16, 3)
    assert torch.allclose(picture.rendered[3:, :, 0], expected[3:], atol=1e-5)
    assert torch.equal(picture.rendered[:3], picture.truth[:3])
    assert torch.allclose(picture.truth[3:, :, 1], capture.line_integrals[2, 3:] / peak)


def test_a_run_that_is_resumed_ends_as_if_it_had_not_stopped(tmp_path) -> None:
    mesh = jittered(dtype=torch.float32)
    capture, path = scan_of(mesh, ball(mesh), CONE), tmp_path / "run.safetensors"
    expected = reconstruct(capture, small())

    def stop(progress: object) -> None:
        if progress.iteration == 33:  # type: ignore[attr-defined]
            raise RuntimeError

    with pytest.raises(RuntimeError):
        reconstruct(capture, small(checkpoint_seconds=0.0), checkpoint=path, on_progress=stop)
    resumed = reconstruct(capture, small(checkpoint_seconds=1.0), checkpoint=path, resume=True)
    assert torch.equal(resumed.mesh.vertices, expected.mesh.vertices)
    assert torch.equal(resumed.field.density, expected.field.density)
    assert resumed.history.loss == expected.history.loss
    with pytest.raises(FitError, match="cells"):
        reconstruct(capture, small(cells=640), checkpoint=path, resume=True)
    other = dataclasses.replace(capture, line_integrals=2.0 * capture.line_integrals)
    with pytest.raises(FitError, match="mean"):
        reconstruct(other, small(), checkpoint=path, resume=True)


def test_the_axis_is_found_where_it_is() -> None:
    """A scan whose axis is off by more than a pixel and tilted, described as if it were not."""
    mesh = TetMesh.grid((6, 6, 6), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    for geometry in (PARALLEL | {"axis_offset": 0.3}, CONE | {"axis_offset": -0.2}):
        true = ProjectionGeometry.from_dict(geometry)
        as_told = Measurements(scan_of(mesh, ball(mesh), geometry), torch.device("cpu"))
        assert as_told.axis_shift() == pytest.approx(0.0, abs=0.1)
        moved = Alignment("axis", true.shape, torch.device("cpu"))
        with torch.no_grad():
            moved.shift[0], moved.tilt[()] = 1.5, math.radians(2.0)
            views = [integrals(mesh, ball(mesh), moved.applied(true.view(k), k)).float() for k in range(24)]
        test = torch.arange(24) % 6 == 2
        capture = ProjectionCapture(true, torch.stack(views), None, None, test)
        options = small(iterations=300, align="axis", move=False, refine="none", cells=1300)
        found = reconstruct(capture, options)
        unaware = reconstruct(capture, dataclasses.replace(options, align="none"))
        told = found.alignment.to_json()
        assert told["axis_shift_pixels"] == pytest.approx(1.5, abs=0.1)
        assert told["axis_tilt_degrees"] == pytest.approx(2.0, abs=0.3)
        assert found.score.mean_psnr > unaware.score.mean_psnr + 5.0


def test_few_rows_tell_the_place_of_the_axis_but_no_tilt() -> None:
    mesh = TetMesh.grid((8, 8, 1), (-1.0, -1.0, -0.05), (1.0, 1.0, 0.05))
    geometry = PARALLEL | {"detector": [40, 2], "detector_size": [3, 0.1], "volume_size": [2, 2, 0.1]}
    geometry |= {"axis_offset": 0.3}
    scan = scan_of(mesh, ball(mesh.with_vertices(mesh.vertices * torch.tensor([1.0, 1.0, 0.0]))), geometry)
    centered = ProjectionGeometry.from_dict(geometry | {"axis_offset": 0.0})
    found = reconstruct(dataclasses.replace(scan, geometry=centered), small(iterations=300, align="axis"))
    told = found.alignment.to_json()
    assert abs(told["axis_shift_pixels"]) == pytest.approx(4.0, abs=0.2) and "axis_tilt_degrees" not in told


def test_pixels_that_do_not_count_say_nothing() -> None:
    mesh = jittered(dtype=torch.float32)
    capture = scan_of(mesh, ball(mesh), CONE)
    valid = torch.ones_like(capture.line_integrals, dtype=torch.bool)
    valid[:, 10:14] = False
    broken = torch.where(valid, capture.line_integrals, 1e3)
    options = small(iterations=30, deterministic=True)
    one = reconstruct(dataclasses.replace(capture, valid=valid), options)
    other = reconstruct(dataclasses.replace(capture, valid=valid, line_integrals=broken), options)
    assert torch.equal(one.field.density, other.field.density)
    assert math.isfinite(one.score.mean_psnr)


@pytest.mark.parametrize("values", [0.0, -1.0, 1e-12])
def test_where_nothing_absorbs_there_is_nothing_to_reconstruct(values: float) -> None:
    geometry = ProjectionGeometry.from_dict(COARSE)
    scan = ProjectionCapture(geometry, torch.full(geometry.shape, values))
    with pytest.raises(FitError, match="Nothing absorbs in 'scan': its greatest line integral is"):
        reconstruct(scan, TomographyConfig(iterations=1))


def test_views_without_a_valid_pixel_teach_nothing() -> None:
    geometry = ProjectionGeometry.from_dict(COARSE)
    test = torch.arange(10) == 3
    valid = test[:, None, None].expand(geometry.shape)
    with pytest.raises(FitError, match="No pixel of the views of 'scan' to learn from is valid"):
        reconstruct(ProjectionCapture(geometry, torch.ones(geometry.shape), None, valid, test), TomographyConfig())


def test_runs_are_resumed_though_masked_pixels_are_no_numbers(tmp_path) -> None:
    geometry = ProjectionGeometry.from_dict(COARSE)
    values = torch.rand(geometry.shape, generator=torch.Generator().manual_seed(0))
    valid = values > 0.1
    scan = ProjectionCapture(geometry, torch.where(valid, values, torch.nan), None, valid)
    config = TomographyConfig(cells=300, iterations=2, rays=100, solve_steps=0, evaluate_every=0)
    reconstruct(scan, config, checkpoint=tmp_path / "checkpoint.npz")
    config = dataclasses.replace(config, iterations=3)
    resumed = reconstruct(scan, config, checkpoint=tmp_path / "checkpoint.npz", resume=True)
    assert resumed.metrics["iterations"] == 3


def test_shadows_that_are_cut_off_do_not_tell_the_axis() -> None:
    """Of a detector that stands aside and sees the object in half of the views, the centres are not the object's."""
    mesh = jittered(dtype=torch.float32)
    density = ball(mesh)
    aside = CONE | {"detector_size": [2.4, 4], "detector_offset": [1.0, 0.0]}
    scan = Measurements(scan_of(mesh, density, aside), torch.device("cpu"))
    assert scan.axis_shift() == 0.0
    whole = Measurements(scan_of(mesh, density, CONE | {"detector_offset": [0.3, 0.0]}), torch.device("cpu"))
    assert abs(whole.axis_shift()) < 0.5


def test_nothing_is_put_outside_of_the_support(tmp_path) -> None:
    mesh = jittered(dtype=torch.float32)
    capture = scan_of(mesh, ball(mesh) + 0.3, PARALLEL)  # all of the box absorbs, so outside would be used
    inside = np.zeros((8, 8, 8), np.uint8)
    inside[2:, 2:6, :4] = 255  # z, y, x
    np.save(tmp_path / "inside.npy", inside)
    np.save(tmp_path / "labels.npy", np.where(inside, 2, 1).astype(np.uint8))
    for support in ("cylinder", str(tmp_path / "inside.npy"), str(tmp_path / "labels.npy")):
        result = reconstruct(capture, small(support=support))
        x, y, z = result.mesh.vertices.unbind(1)
        if support == "cylinder":
            outside = x.square() + y.square() > 1.0
        else:
            outside = (z < -0.5 - 1e-6) | (y < -0.5 - 1e-6) | (y > 0.5 + 1e-6) | (x > 1e-6)
        assert 10 < int(outside.sum()) < len(outside) - 10
        assert bool((result.field.density[outside] == 0).all()) and float(result.field.density.max()) > 0.3


def test_a_support_that_cannot_be_is_refused(tmp_path) -> None:
    mesh = jittered(dtype=torch.float32)
    capture = scan_of(mesh, ball(mesh), PARALLEL)
    with pytest.raises(dtv.CaptureError, match=r"nowhere\.npy"):
        reconstruct(capture, small(support=str(tmp_path / "nowhere.npy")))
    np.save(tmp_path / "all.npy", np.ones((4, 4, 4), np.uint8))
    with pytest.raises(dtv.CaptureError, match="has one value everywhere, so it tells no support"):
        reconstruct(capture, small(support=str(tmp_path / "all.npy")))
    aside = ProjectionGeometry.from_dict(PARALLEL | {"volume_size": [0.5, 0.5, 2], "volume_offset": [0.6, 0, 0]})
    with pytest.raises(dtv.CaptureError, match="no cylinder"):
        reconstruct(dataclasses.replace(capture, geometry=aside), small(support="cylinder"))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"total_variation": -1.0}, "total_variation"),
        ({"likelihood": "l3"}, "likelihood"),
        ({"rays": 0}, "rays"),
        ({"refine": "star"}, "refine"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, object], sentence: str) -> None:
    with pytest.raises(FitError, match=sentence):
        TomographyConfig.from_json(options)


def test_what_is_no_scan_is_refused() -> None:
    with pytest.raises(FitError, match="capture"):
        reconstruct("scan.h5")  # type: ignore[arg-type]


def test_the_public_names() -> None:
    assert dtv.inverse.tomography.reconstruct is reconstruct
