"""Where things are seen: a point off all axes through each kind of description, against formulas of others."""

import copy
import json

import numpy as np
import pytest
import torch

from difftetvr.capture import ProjectionGeometry
from difftetvr.errors import CaptureError

POINT = np.array([0.5, 0.2, 0.3])  # nothing is symmetric here: any exchanged or reversed axis moves its shadow
CONE = {
    "type": "cone",
    "views": 5,
    "arc": 360,
    "source_distance": 5,
    "detector_distance": 7,
    "detector": [64, 48],
    "detector_size": [4, 3],
    "volume_size": [2, 2, 2],
}
PARALLEL = {k: v for k, v in CONE.items() if "distance" not in k} | {"type": "parallel"}


def shadow(geometry: ProjectionGeometry, view: int, point: np.ndarray = POINT) -> np.ndarray:
    """(2,) column and row, not rounded, where a point is seen: the ray through it, cut with the detector."""
    detector = geometry.view(view)
    center, columns, rows = (part.numpy() for part in (detector.center, detector.columns, detector.rows))
    ray = detector.direction.numpy() if detector.source is None else point - detector.source.numpy()
    normal = np.cross(columns, rows)
    hit = point + ray * ((center - point) @ normal) / (ray @ normal)
    u, v = np.linalg.lstsq(np.stack([columns, rows], axis=1), hit - center, rcond=None)[0]
    return np.array([u + detector.width / 2, v + detector.height / 2])


def seen_by_r2_gaussian(angle: float, dso: float, dsd: float, pixel: float, size: tuple[int, int]) -> np.ndarray:
    """Pixel of POINT by the camera that R2-Gaussian renders with: right, down, forward from three turns."""

    def turn(axis: int, by: float) -> np.ndarray:
        matrix = np.eye(3)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        matrix[[a, a, b, b], [a, b, a, b]] = np.cos(by), -np.sin(by), np.sin(by), np.cos(by)
        return matrix

    rotation = turn(2, angle) @ turn(2, np.pi / 2) @ turn(0, -np.pi / 2)
    position = np.array([dso * np.cos(angle), dso * np.sin(angle), 0])
    x, y, z = rotation.T @ (POINT - position)
    return np.array([dsd * x / z / pixel + size[0] / 2, dsd * y / z / pixel + size[1] / 2])


@pytest.mark.parametrize("view", range(5))
def test_points_are_seen_where_r2_gaussian_sees_them(view):
    geometry = ProjectionGeometry.from_dict(CONE)
    angle = 2 * np.pi * view / 5
    expected = seen_by_r2_gaussian(angle, 5, 7, 4 / 64, (64, 48))
    np.testing.assert_allclose(shadow(geometry, view), expected, atol=1e-9)
    np.testing.assert_allclose(geometry.angles, np.arange(5) * 72)


@pytest.mark.parametrize("view", range(5))
def test_tigre_has_the_lowest_row_first(view):
    """Its own formulas: pixel (0, 0) at the bottom, u along +y and v along +z at angle 0, offsets along these."""
    angles = 2 * np.pi * np.arange(5) / 5
    geo = {"DSD": 7, "DSO": 5, "nDetector": [48, 64], "dDetector": [0.0625, 0.05], "sVoxel": [1.8, 2, 2.2]}
    geo |= {"nVoxel": [9, 10, 11], "offDetector": [0.1, -0.3], "offOrigin": [0.1, 0, 0.05], "angles": angles.tolist()}
    geometry = ProjectionGeometry.from_dict(geo)
    a = angles[view]
    x, y, z = POINT[0] * np.cos(a) + POINT[1] * np.sin(a), POINT[1] * np.cos(a) - POINT[0] * np.sin(a), POINT[2]
    scale = 7 / (5 - x)
    expected = [(y * scale + 0.3) / 0.05 + 32, (z * scale - 0.1) / 0.0625 + 24]
    np.testing.assert_allclose(shadow(geometry, view), expected, atol=1e-9)
    np.testing.assert_allclose(geometry.bounds, [[-1.05, -1, -0.8], [1.15, 1, 1.0]])


def test_tigre_may_say_all_for_each_view():
    geo = {"DSD": [7, 7, 8], "DSO": [5, 5, 5.5], "nDetector": [4, 6], "sDetector": [4, 6], "sVoxel": [2, 2, 2]}
    geo |= {"offDetector": [[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]], "COR": [0, 0, 0.25], "mode": "cone", "accuracy": 0.5}
    geo |= {"rotDetector": [[0, 0, 0], [0, 0, 0.1], [0, 0, 0]], "angles": [[0, 0, 0], [1, 0, 0], [0, np.pi / 2, 0]]}
    detector = ProjectionGeometry.from_dict(geo).detector
    np.testing.assert_allclose(detector.source[0], [5, 0, 0], atol=1e-12)
    # The third scanner is turned around y by 90 degrees: +x goes to -z, and +z to +x. Its COR moves it along y.
    np.testing.assert_allclose(detector.source[2], [0, 0.25, -5.5], atol=1e-12)
    np.testing.assert_allclose(detector.center[2], [0, 0.75, 2.5], atol=1e-12)
    np.testing.assert_allclose(detector.rows[2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(detector.center[1], [-2 * np.cos(1), -2 * np.sin(1), 0.5], atol=1e-12)
    # Yaw turns the detector in its plane: columns rise.
    np.testing.assert_allclose(detector.columns[1, 2], np.sin(0.1), atol=1e-12)


ASTRA_CONE = {
    "type": "cone",
    "DetectorSpacingX": 0.05,
    "DetectorSpacingY": 0.0625,
    "DetectorColCount": 64,
    "DetectorRowCount": 48,
    "ProjectionAngles": [0.0, 0.7, 2.0],
    "DistanceOriginSource": 5,
    "DistanceOriginDetector": 2,
}
VOLUME = {"GridRowCount": 2, "GridColCount": 3, "GridSliceCount": 4}


@pytest.mark.parametrize("view", range(3))
def test_astra_begins_at_the_other_axis(view):
    """Vectors as ``astra.geom_2vec`` makes them of angles."""
    a = ASTRA_CONE["ProjectionAngles"][view]
    c, s = np.cos(a), np.sin(a)
    vectors = [[5 * s, -5 * c, 0, -2 * s, 2 * c, 0, 0.05 * c, 0.05 * s, 0, 0, 0, 0.0625]]
    sized = {"DetectorColCount": 64, "DetectorRowCount": 48}
    by_angle = ProjectionGeometry.from_dict({"proj_geom": ASTRA_CONE, "vol_geom": VOLUME})
    by_vector = ProjectionGeometry.from_dict(
        {"proj_geom": {"type": "cone_vec", "Vectors": vectors, **sized}, "vol_geom": VOLUME}
    )
    np.testing.assert_allclose(shadow(by_angle, view), shadow(by_vector, 0), atol=1e-9)
    np.testing.assert_allclose(by_angle.bounds, [[-1.5, -1, -2], [1.5, 1, 2]])


def test_slices_of_astra_have_one_row():
    fan = {"type": "fanflat", "DetectorWidth": 0.5, "DetectorCount": 8, "ProjectionAngles": [0.3, 1]}
    fan |= {"DistanceOriginSource": 5, "DistanceOriginDetector": 2}
    flat = ProjectionGeometry.from_dict({"proj_geom": fan, "vol_geom": {"GridRowCount": 2, "GridColCount": 2}})
    assert flat.shape == (2, 1, 8) and flat.bounds[:, 2].tolist() == [-0.25, 0.25]
    parallel = {"type": "parallel_vec", "DetectorCount": 8, "Vectors": [[0, -1, 0, 0, 0.5, 0]]}
    lines = ProjectionGeometry.from_dict({"proj_geom": parallel, "vol_geom": {"GridRowCount": 2, "GridColCount": 2}})
    np.testing.assert_allclose(shadow(lines, 0)[0], POINT[0] / 0.5 + 4)


def test_parallel_rays_cast_shadows_without_magnification():
    geometry = ProjectionGeometry.from_dict(PARALLEL)
    for view in range(5):
        a = 2 * np.pi * view / 5
        y = POINT[1] * np.cos(a) - POINT[0] * np.sin(a)
        np.testing.assert_allclose(shadow(geometry, view), [y * 16 + 32, -POINT[2] * 16 + 24], atol=1e-9)


def test_offsets_move_the_detector_and_tilts_turn_it():
    straight = shadow(ProjectionGeometry.from_dict(CONE), 1)
    moved = shadow(ProjectionGeometry.from_dict(CONE | {"detector_offset": [0.5, 0.25]}), 1)
    np.testing.assert_allclose(moved - straight, [-0.5 * 16, 0.25 * 16], atol=1e-9)
    # Half a fan: the axis is seen at the edge of the detector.
    half = ProjectionGeometry.from_dict(CONE | {"detector_offset": [2, 0]})
    np.testing.assert_allclose(shadow(half, 3, np.zeros(3)), [0, 24], atol=1e-9)
    tilted = shadow(ProjectionGeometry.from_dict(CONE | {"tilt": 10}), 1)
    c, s = np.cos(np.deg2rad(10)), np.sin(np.deg2rad(10))
    u, v = straight - [32, 24]
    np.testing.assert_allclose(tilted - [32, 24], [c * u - s * v, s * u + c * v], atol=1e-9)
    # With the axis off the middle source and detector move together, so that it does not scale with the distance.
    aside = ProjectionGeometry.from_dict(CONE | {"axis_offset": 0.1})
    np.testing.assert_allclose(aside.detector.source[0], [5, 0.1, 0], atol=1e-12)
    np.testing.assert_allclose(aside.detector.center[0], [-2, 0.1, 0], atol=1e-12)


def test_helical_scans_rise_around_the_middle_view():
    geometry = ProjectionGeometry.from_dict(CONE | {"views": 9, "arc": 810, "helical": 0.4})
    rise = geometry.detector.source[:, 2].numpy()
    np.testing.assert_allclose(rise, geometry.detector.center[:, 2], atol=1e-12)
    np.testing.assert_allclose(np.diff(rise), 0.4 / 4, atol=1e-12)
    assert abs(rise[4]) < 1e-12


def test_a_fan_sees_a_slice():
    fan = {**CONE, "type": "fan", "detector": 64, "detector_size": 4, "volume_size": [2, 2]}
    geometry = ProjectionGeometry.from_dict(fan)
    assert geometry.shape == (5, 1, 64)
    np.testing.assert_allclose(geometry.bounds[1, 2], 0.5 * 4 / 64 * 5 / 7)
    flat = ProjectionGeometry.from_dict(CONE)
    for view in range(5):
        point = POINT * [1, 1, 0]
        np.testing.assert_allclose(shadow(geometry, view, point)[0], shadow(flat, view, point)[0], atol=1e-9)


def test_without_a_volume_the_box_is_what_all_views_see():
    bare = {k: v for k, v in PARALLEL.items() if k != "volume_size"}
    np.testing.assert_allclose(ProjectionGeometry.from_dict(bare).bounds, [[-2, -2, -1.5], [2, 2, 1.5]])
    half_turn = bare | {"arc": 180, "detector_offset": [0.5, 0]}
    np.testing.assert_allclose(ProjectionGeometry.from_dict(half_turn).bounds[1], [1.5, 1.5, 1.5])
    half_fan = bare | {"views": 90, "detector_offset": [1.5, 0]}
    np.testing.assert_allclose(ProjectionGeometry.from_dict(half_fan).bounds[1], [3.5, 3.5, 1.5])
    cone = {k: v for k, v in CONE.items() if k != "volume_size"}
    radius = 5 * 2 / np.hypot(2, 7)
    np.testing.assert_allclose(
        ProjectionGeometry.from_dict(cone).bounds[1], [radius, radius, 1.5 * (5 - radius) / 7], rtol=1e-12
    )


FREE = {
    "type": "free",
    "detector": [8, 6],
    "unit": "mm",
    "bounds": [[-1, -1, -1], [1, 2, 1]],
    "views": [
        {"source": [5, 0.1, 0.2], "center": [-2, 0, 0], "columns": [0, 0.5, 0], "rows": [0.01, 0, -0.5]},
        {"source": [0, 6, 0], "center": [0, -2, 0.5], "columns": [-0.5, 0, 0.02], "rows": [0, 0, -0.5]},
    ],
}


@pytest.mark.parametrize("kind", [CONE, PARALLEL, FREE, CONE | {"tilt": [1, 2, 3], "helical": 0.3, "unit": "mm"}])
def test_what_is_written_is_read_back_to_the_last_bit(kind, tmp_path):
    first = ProjectionGeometry.from_dict(kind)
    (tmp_path / "g.json").write_text(json.dumps(first.to_dict()))
    again = ProjectionGeometry.load(tmp_path / "g.json")
    for name in ("source", "direction", "center", "columns", "rows"):
        one, other = getattr(first.detector, name), getattr(again.detector, name)
        assert (one is None) == (other is None) and (one is None or torch.equal(one, other))
    assert torch.equal(first.bounds, again.bounds) and first.unit == again.unit
    assert (first.angles is None) == (again.angles is None)
    assert first.angles is None or torch.equal(first.angles, again.angles)


def test_views_are_chosen_with_all_that_is_theirs():
    geometry = ProjectionGeometry.from_dict(CONE)
    some = geometry.select([3, 1])
    assert some.shape == (2, 48, 64) and some.angles.tolist() == [216, 72]
    assert torch.equal(some.detector.source, geometry.detector.source[[3, 1]])
    assert torch.equal(geometry.view(3).center, some.view(0).center) and geometry.view(3).center.shape == (3,)
    assert geometry.select(torch.tensor([True, False, False, True, True])).num_views == 3
    for wrong in ([5], [], torch.zeros(5, dtype=torch.bool), "all"):
        with pytest.raises(CaptureError, match="view"):
            geometry.select(wrong)
    with pytest.raises(CaptureError, match="no view 7 of 5"):
        geometry.view(7)


def test_derivatives_go_through_to_the_vectors():
    """Geometry is refined by them."""
    detector = ProjectionGeometry.from_dict(FREE).detector
    source = detector.source.clone().requires_grad_()
    from difftetvr.rendering import Detector

    moving = Detector(detector.center, detector.columns, detector.rows, 8, 6, source=source)
    geometry = ProjectionGeometry(moving, torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    geometry.select([1]).view(0).source.sum().backward()
    assert source.grad.tolist() == [[0, 0, 0], [1, 1, 1]]


def changed(kind: dict, **entries: object) -> dict:
    values = copy.deepcopy(kind) | entries
    return {name: value for name, value in values.items() if value != "nothing"}


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        ([1], "give an object with names and values"),
        (changed(CONE, type="nothing"), "lacks the entry 'type'"),
        (changed(CONE, type="spiral"), "'type' of the geometry is 'spiral'; give one of cone"),
        (
            changed(CONE, soruce_distance=3),
            r"unknown entry 'soruce_distance' \(is it 'source_distance'\?\); correct it",
        ),
        (changed(CONE, source_distance="nothing"), "lacks the entry 'source_distance'"),
        (changed(CONE, source_distance=-5), "give a number greater than 0"),
        (changed(CONE, source_distance=float("nan")), "give a number greater than 0"),
        (changed(CONE, source_distance=True), "give a number greater than 0"),
        (changed(CONE, detector_distance=4), "not behind the axis"),
        (changed(CONE, views=0), "whole number of at least 1"),
        (changed(CONE, views=2.5), "whole number of at least 1"),
        (changed(CONE, arc=0), "degrees over which the views are spread"),
        (changed(CONE, angles=[0, 1]), "both 'angles' and 'views'"),
        (changed(CONE, views="nothing", arc="nothing", angles=["a"]), "a list of finite numbers"),
        (changed(CONE, detector=[64]), "give 2 numbers"),
        (changed(CONE, detector=[64, 4.5]), "whole numbers of columns and of rows"),
        (changed(CONE, detector_size=[4, 0]), "greater than 0"),
        (changed(CONE, detector_offset=[9, 0]), "View 0 .* sees nothing of the bounds"),
        (changed(CONE, volume_size=[2, 2]), "give 3 numbers"),
        (changed(CONE, volume_offset=[0, 0, 40]), "sees nothing of the bounds"),
        (changed(CONE, volume_offset=[-40, 0, 0]), "the bounds behind its detector|looks away"),
        (changed(CONE, bounds=[[0, 0, 0], [1, 1, 1]]), "both 'bounds' and 'volume_size'"),
        (changed(FREE, bounds=[[0, 0, 0], [1, 1, 0]]), "an upper corner"),
        (changed(FREE, bounds="nothing"), "lacks the entry 'volume_size'"),
        (changed(FREE, views=[]), "an object for each view"),
        (changed(FREE, views=[FREE["views"][0] | {"center": [9, 0, 0]}]), "its detector is behind the source"),
        (changed(FREE, views=[FREE["views"][0] | {"source": [-9, 0, 0]}]), "has the bounds behind its detector"),
        (changed(FREE, views=[FREE["views"][0] | {"source": [-2, 0, 0]}]), "source in the plane of its detector"),
        (changed(FREE, views=[FREE["views"][0] | {"rows": [0, 1, 0]}]), "pixels without an area"),
        (changed(FREE, views=[{"direction": [0, 1, 0], **FREE["views"][0]}]), "need each a 'source', or each"),
        (changed(FREE, views=[{k: v for k, v in FREE["views"][0].items() if k != "source"}]), "need each a 'source'"),
        (changed(FREE, views=[FREE["views"][0] | {"center": [0, 0]}]), "View 0 of"),
        (changed(FREE, angles=[1, 2, 3]), "one for each of 2 views"),
        ({"nDetector": [4, 4], "angles": [0]}, "lacks the entry"),
        ({"proj_geom": {"type": "spiral"}}, "give one of parallel, fanflat"),
    ],
)
def test_a_bad_description_is_one_sentence(values, sentence):
    with pytest.raises(CaptureError, match=sentence) as caught:
        ProjectionGeometry.from_dict(values)
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)


def test_a_bad_file_is_one_sentence_that_names_it(tmp_path):
    path = tmp_path / "g.json"
    for text, sentence in (("{", "is no JSON"), ("[" * 100_000, "is no JSON"), ('{"type": "cone"}', "lacks the entry")):
        path.write_text(text)
        with pytest.raises(CaptureError, match=sentence) as caught:
            ProjectionGeometry.load(path)
        assert "g.json" in str(caught.value)
    with pytest.raises(CaptureError, match="There is no file"):
        ProjectionGeometry.load(tmp_path / "other.json")
    with pytest.raises(CaptureError, match="write the same entries as JSON"):
        ProjectionGeometry.load(tmp_path / "scanner.yml")
    path.write_text(json.dumps(CONE | {"detector_offset": [9, 0]}))
    with pytest.raises(CaptureError, match=r"g.json': View 0 \(as 4 others\) sees nothing"):
        ProjectionGeometry.load(path)
