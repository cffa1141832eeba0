"""Entropies of images, and views that have more of it than any that were sampled."""

import json
import math

import pytest
import torch

import difftetvr as dtv
from difftetvr.errors import FitError
from difftetvr.inverse import (
    ViewpointConfig,
    color_entropy,
    opacity_entropy,
    reference_colors,
    sample_viewpoints,
)

SMALL = {"width": 24, "height": 24, "iterations": 12}


@pytest.fixture(scope="module")
def blob():
    """An opaque plate, a thin rod and a faint fog: views differ."""
    mesh = dtv.TetMesh.grid((6, 6, 6), (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    mesh = mesh.with_vertices(mesh.vertices.double())
    x, y, z = mesh.vertices.T
    plate = 4.0 * torch.exp(-20.0 * (x + 0.4 * y) ** 2)
    rod = 6.0 * torch.exp(-8.0 * (y**2 + (z - 0.3) ** 2))
    color = torch.stack([plate, rod, 0.2 * torch.ones_like(x)], 1) / 6.0
    return mesh, dtv.Field(color.clamp(0, 1), plate + rod + 0.05)


def test_the_entropy_of_opacity_counts_how_evenly_it_is_spread():
    assert float(opacity_entropy(torch.full((5, 7), 0.3))) == pytest.approx(1.0)
    one = torch.zeros(5, 7)
    one[2, 3] = 0.8
    assert float(opacity_entropy(one)) == 0.0
    half = torch.zeros(4, 4)
    half[:, :2] = 0.5
    assert float(opacity_entropy(half)) == pytest.approx(math.log(8) / math.log(16))


def test_of_an_empty_image_it_is_nothing_and_so_is_its_derivative():
    alpha = torch.zeros(4, 4, requires_grad=True)
    entropy = opacity_entropy(alpha)
    entropy.backward()
    assert entropy.item() == 0.0 and float(alpha.grad.abs().max()) == 0.0


def test_the_entropy_of_colours_is_that_of_their_areas():
    references = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    image = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(0))
    known = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    areas = torch.zeros(3)
    for pixel in image.reshape(-1, 3):
        shares = torch.tensor([math.exp(-math.dist(pixel.tolist(), color.tolist())) for color in known])
        areas += shares / shares.sum() / 12
    expected = -sum(p * math.log(p) for p in areas.tolist()) / math.log(3)
    assert float(color_entropy(image, references)) == pytest.approx(expected, abs=1e-6)


def test_the_derivative_is_finite_at_a_reference_itself():
    image = torch.zeros(2, 2, 3, requires_grad=True)
    color_entropy(image, torch.ones(1, 3)).backward()
    assert bool(torch.isfinite(image.grad).all())


def test_reference_colours_are_those_of_a_transfer_functions_peaks():
    color = torch.eye(5, 3)
    function = dtv.TransferFunction([0.0, 0.2, 0.5, 0.7, 1.0], [0.0, 0.5, 0.1, 0.1, 0.9], color)
    found = reference_colors(dtv.ScalarField(torch.rand(9), function))
    assert torch.equal(found, color[[1, 4]])
    with pytest.raises(dtv.CameraError, match="transparent everywhere"):
        reference_colors(dtv.ScalarField(torch.rand(9), dtv.TransferFunction([0.0, 1.0], [0.0, 0.0], torch.eye(2, 3))))


def test_reference_colours_of_a_field_are_those_that_it_has():
    color = torch.eye(3).repeat(20, 1)
    density = torch.tensor([1.0, 2.0, 0.0]).repeat(20)
    found = reference_colors(dtv.Field(color, density))
    assert sorted(found.tolist()) == [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]


@pytest.mark.parametrize("poses", ["orbit", "free"])
@pytest.mark.parametrize("measure", ["opacity", "both"])
def test_gradients_by_the_pose_are_those_of_differences(blob, poses, measure):
    mesh, field = blob
    places = ViewpointConfig(poses=poses, **SMALL).poses_about(mesh)
    references = reference_colors(field)

    def entropy(pose):
        image = dtv.render(mesh, field, places.camera(pose))
        extra = color_entropy(image.color, references) if measure == "both" else 0.0
        return opacity_entropy(image.alpha) + extra

    pose = places.starts(8)[5].requires_grad_()
    (gradient,) = torch.autograd.grad(entropy(pose), pose)
    for axis in range(len(pose)):
        step = torch.zeros_like(pose)
        step[axis] = 1e-5
        with torch.no_grad():
            difference = (entropy(pose + step) - entropy(pose - step)) / 2e-5
        assert float(gradient[axis]) == pytest.approx(float(difference), rel=2e-3, abs=2e-5)


@pytest.mark.parametrize("measure", ["opacity", "color"])
def test_what_is_found_is_better_than_what_is_sampled(blob, measure):
    config = ViewpointConfig(measure=measure, scouts=24, width=24, height=24)
    search = dtv.best_viewpoint(*blob, config)
    sampled = max(view.entropy for view in sample_viewpoints(*blob, 128, config))
    assert search.best.entropy >= sampled
    assert search.best.entropy > search.worst.entropy + 0.001
    assert search.best.entropy == max(view.entropy for view in search.found)
    for path, end in zip(search.paths, search.found, strict=True):
        values = [view.entropy for view in path]
        assert values == sorted(values) and path[-1] is end
    assert search.renderings <= 24 + 8 * 30


def test_cameras_of_an_orbit_keep_their_distance_and_look_at_its_centre(blob):
    config = ViewpointConfig(center=(0.1, 0.2, 0.3), radius=4.0, scouts=0, starts=8, **SMALL)
    search = dtv.best_viewpoint(*blob, config)
    for path in search.paths:
        for view in path:
            assert float((view.camera.position - search.center).norm()) == pytest.approx(4.0)
            middle, _ = view.camera.project(search.center[None])
            assert middle[0].tolist() == pytest.approx([12.0, 12.0])


def test_free_cameras_come_nearer_but_not_too_near(blob):
    mesh, field = blob
    orbit = dtv.best_viewpoint(mesh, field, ViewpointConfig(scouts=0, **SMALL))
    free = dtv.best_viewpoint(mesh, field, ViewpointConfig(poses="free", scouts=0, **SMALL))
    radius = ViewpointConfig(**SMALL).poses_about(mesh).radius
    distances = [float(view.camera.position.norm()) / radius for view in free.found]
    assert free.best.entropy > orbit.best.entropy
    assert 0.75 - 1e-9 <= min(distances) < 0.8 and max(distances) <= 1.25


def test_a_start_above_the_pole_has_a_camera(blob):
    places = ViewpointConfig(**SMALL).poses_about(blob[0])
    pose = places.valid(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    assert bool(torch.isfinite(places.camera(pose).world_to_camera).all())


def test_nothing_to_see_is_an_error(blob):
    mesh, field = blob
    empty = dtv.Field(field.color, torch.zeros_like(field.density))
    with pytest.raises(dtv.CameraError, match="Nothing is seen"):
        dtv.best_viewpoint(mesh, empty, ViewpointConfig(scouts=0, starts=2, **SMALL))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"measure": "depth"}, "measure"),
        ({"starts": 0}, "starts is 0"),
        ({"scouts": 3}, "at least as many scouts"),
        ({"fov_y": 4.0}, "fov_y"),
        ({"radius": -1.0}, "radius"),
        ({"up": (0.0, 0.0, 0.0)}, "no direction"),
        ({"center": (0.0, math.inf, 0.0)}, "center"),
        ({"width": 0}, "width"),
    ],
)
def test_options_out_of_range_are_errors(options, sentence):
    with pytest.raises(dtv.CameraError, match=sentence):
        ViewpointConfig(**options)


def test_arguments_of_the_wrong_kind_are_errors(blob):
    mesh, field = blob
    with pytest.raises(dtv.MeshError, match="mesh is"):
        dtv.best_viewpoint("mesh", field)
    with pytest.raises(dtv.MeshError, match="field is"):
        dtv.best_viewpoint(mesh, field.color)
    with pytest.raises(dtv.CameraError, match="config is"):
        dtv.best_viewpoint(mesh, field, 3)
    with pytest.raises(dtv.CameraError, match="reference colours"):
        dtv.best_viewpoint(mesh, field, ViewpointConfig(measure="color"), colors=[1.0, 2.0])
    with pytest.raises(dtv.CameraError, match="number of views"):
        sample_viewpoints(mesh, field, 0)


def interrupted_search(blob, path, config, climbs):
    """A search that is interrupted after some climbs."""

    def stop(done, total):
        if done == climbs:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dtv.best_viewpoint(*blob, config, checkpoint=path, on_progress=stop)


@pytest.mark.parametrize("climbs", [0, 2])
def test_a_search_that_was_interrupted_goes_on(blob, tmp_path, climbs):
    """With what it would have found, and nothing is looked at twice."""
    config, path = ViewpointConfig(starts=3, scouts=12, measure="both", **SMALL), tmp_path / "search.json"
    whole = dtv.best_viewpoint(*blob, config)
    interrupted_search(blob, path, config, climbs)
    told = []
    found = dtv.best_viewpoint(
        *blob, config, checkpoint=path, resume=True, on_progress=lambda *counts: told.append(counts)
    )
    assert told == [(done, 3) for done in range(climbs, 4)]
    assert found.renderings == whole.renderings
    views = [
        (*search.found, *search.scouts, *(view for path in search.paths for view in path)) for search in (found, whole)
    ]
    assert len(views[0]) == len(views[1])
    for one, other in zip(*views, strict=True):
        assert one.entropy == other.entropy
        assert torch.equal(one.camera.world_to_camera, other.camera.world_to_camera)
    again = dtv.best_viewpoint(*blob, config, checkpoint=path, resume=True)
    assert again.best.entropy == whole.best.entropy


def test_another_search_does_not_go_on(blob, tmp_path):
    mesh, field = blob
    config, path = ViewpointConfig(starts=2, scouts=4, **SMALL), tmp_path / "search.json"
    interrupted_search(blob, path, config, 1)
    others = {
        "options": (mesh, field, ViewpointConfig(starts=2, scouts=5, **SMALL)),
        "field": (mesh, dtv.Field(field.color, 0.5 * field.density), config),
        "mesh": (mesh.with_vertices(1.5 * mesh.vertices), field, config),
    }
    for scene in others.values():
        with pytest.raises(FitError, match="of another mesh or field, or has other options"):
            dtv.best_viewpoint(*scene, checkpoint=path, resume=True)
    saved = path.read_text()
    for damaged in (
        saved[: len(saved) // 2],
        "[]",
        "{}",
        saved.replace('"climbs"', '"clips"'),
        saved.replace("0.", '"', 1),
    ):
        path.write_text(damaged)
        with pytest.raises(FitError, match=r"cannot be read .*start anew"):
            dtv.best_viewpoint(mesh, field, config, checkpoint=path, resume=True)
    path.write_text(saved.replace('"version": 1', '"version": 2'))
    with pytest.raises(FitError, match="another version"):
        dtv.best_viewpoint(mesh, field, config, checkpoint=path, resume=True)
    with pytest.raises(FitError, match="is a folder"):
        dtv.best_viewpoint(mesh, field, config, checkpoint=tmp_path, resume=True)
    with pytest.raises(FitError, match="name of a file"):
        dtv.best_viewpoint(mesh, field, config, checkpoint=3)
    path.write_text(json.dumps(json.loads(saved) | {"most_seen": 0.5}))
    with pytest.raises(FitError, match="damaged"):
        dtv.best_viewpoint(mesh, field, config, checkpoint=path, resume=True)
    dear = tmp_path / "dear.json"
    dear.write_text('{"mine": 1}')
    with pytest.raises(FitError, match="no record of a search"):
        dtv.best_viewpoint(mesh, field, config, checkpoint=dear)
    assert dear.read_text() == '{"mine": 1}'


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_climbs_follow_gradients_that_are_switched_off_around_them(blob, mode, tmp_path):
    mesh, field = blob
    config, path = ViewpointConfig(starts=2, scouts=4, up=(0, 0, 1), **SMALL), tmp_path / "search.json"
    expected = dtv.best_viewpoint(mesh, field, config, checkpoint=path)
    with mode():
        found = dtv.best_viewpoint(mesh, field, config)
    assert found.best.entropy == expected.best.entropy and found.renderings == expected.renderings
    # The same options in other words are the same.
    same = ViewpointConfig(starts=2, scouts=4, up=(0.0, 0.0, 1.0), **SMALL)
    assert dtv.best_viewpoint(mesh, field, same, checkpoint=path, resume=True).best.entropy == expected.best.entropy
