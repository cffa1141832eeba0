"""Line integrals of voxels, against NumPy ray by ray and against bodies of which they are known."""

import numpy as np
import pytest
import torch
from capture.projections import line_reference

import difftetvr as dtv
from difftetvr.capture import ProjectionGeometry, project_volume
from difftetvr.errors import CaptureError
from difftetvr.rendering import Detector

CONE = {
    "type": "cone",
    "views": 3,
    "source_distance": 5,
    "detector_distance": 7,
    "detector": [11, 9],
    "detector_size": [4, 3.5],
    "detector_offset": [0.2, -0.1],
    "tilt": [3, -4, 5],
    "volume_size": [2, 1.6, 2.2],
    "volume_offset": [0.1, 0.05, -0.1],
}
PARALLEL = {
    "type": "parallel",
    "angles": [0, 33, 90],
    "detector": [11, 9],
    "detector_size": [2.4, 2.6],
    "volume_size": [2, 1.6, 2.2],
    "volume_offset": [0.013, 0.017, 0],  # else some rays would run along faces, and rounding decide between voxels
}
VALUES = np.random.default_rng(3).random((6, 5, 7))


@pytest.mark.parametrize("method", ["siddon", "trilinear"])
@pytest.mark.parametrize("kind", [CONE, PARALLEL], ids=["cone", "parallel"])
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_line_integrals_are_those_of_the_reference(kind, method, dtype, atol):
    geometry = ProjectionGeometry.from_dict(kind)
    found = project_volume(torch.from_numpy(VALUES), geometry, method, dtype=dtype, device="cpu")
    assert found.dtype == dtype and tuple(found.shape) == geometry.shape
    for view in range(3):
        exact = line_reference.project(VALUES, geometry.bounds.numpy(), geometry.detector, view, method == "trilinear")
        assert exact.max() > 0.3
        np.testing.assert_allclose(found[view].numpy(), exact, atol=atol)


@pytest.mark.parametrize("method", ["siddon", "trilinear"])
def test_a_source_within_the_box_and_a_detector_across_it_cut_rays(method):
    detector = Detector(
        torch.tensor([[-0.4, 0.1, 0.0]]),
        torch.tensor([[0.0, 0.15, 0.0]]),
        torch.tensor([[0.05, 0.0, -0.15]]),
        7,
        5,
        source=torch.tensor([[0.45, 0.02, 0.03]]),
    )
    geometry = ProjectionGeometry(detector, torch.tensor([[-1.0, -1, -1], [1, 1, 1]], dtype=torch.float64))
    found = project_volume(VALUES, geometry, method, dtype=torch.float64, device="cpu")[0]
    exact = line_reference.project(VALUES, geometry.bounds.numpy(), geometry.detector, 0, method == "trilinear")
    np.testing.assert_allclose(found.numpy(), exact, atol=1e-12)


def test_a_box_of_one_value_has_the_lengths_of_chords():
    """Known without a walk: of parallel rays at 45 degrees through a cube, and along its edges."""
    flat = PARALLEL | {"angles": [0, 45], "detector": [40, 3], "detector_size": [4, 1], "volume_size": 2}
    flat["volume_offset"] = [0, 0, 0]
    geometry = ProjectionGeometry.from_dict(flat)
    for method in ("siddon", "trilinear"):
        found = project_volume(torch.full((9, 9, 9), 0.7), geometry, method, dtype=torch.float64, device="cpu")
        u = torch.arange(40, dtype=torch.float64) * 0.1 - 1.95
        straight = torch.where(u.abs() < 1, 2.0, 0.0)
        across = (2 * (2**0.5 - u.abs())).clamp(min=0)
        torch.testing.assert_close(found[0], (0.7 * straight).expand(3, 40).double(), atol=1e-7, rtol=0)
        torch.testing.assert_close(found[1], (0.7 * across).expand(3, 40), atol=1e-7, rtol=0)


def test_values_that_are_linear_in_space_are_integrated_exactly():
    """Between outermost middles trilinear values are the function itself: chords of a linear function."""
    counts = np.array([12, 10, 14])
    geometry = ProjectionGeometry.from_dict(
        PARALLEL | {"detector_size": [0.4, 0.4], "angles": [0, 90], "volume_offset": [0, 0, 0]}
    )
    lower, upper = geometry.bounds.numpy()
    middles = [lower[a] + (np.arange(n) + 0.5) * (upper[a] - lower[a]) / n for a, n in enumerate(counts)]
    x, y, z = np.meshgrid(*middles, indexing="ij")
    found = project_volume(3 + x + 2 * y - z, geometry, "trilinear", dtype=torch.float64, device="cpu").numpy()
    u = (np.arange(11) - 5) * 0.4 / 11
    v = -(np.arange(9) - 4) * 0.4 / 9
    # Along x and along y the function is even around 0, but for its mean; columns run along y at 0 degrees, -x at 90.
    np.testing.assert_allclose(found[0], 2.0 * (3 + 2 * u[None, :] - v[:, None]), atol=1e-12)
    np.testing.assert_allclose(found[1], 1.6 * (3 - u[None, :] - v[:, None]), atol=1e-12)


@pytest.mark.parametrize("method", ["siddon", "trilinear"])
def test_an_ellipsoid_of_fine_voxels_has_its_known_shadow(method):
    geometry = ProjectionGeometry.from_dict(CONE | {"views": 4, "detector": [24, 20], "tilt": 0})
    count = 64
    lower, upper = geometry.bounds.numpy()
    fine = [lower[a] + (np.arange(2 * count) + 0.5) * (upper[a] - lower[a]) / (2 * count) for a in range(3)]
    x, y, z = np.meshgrid(*fine, indexing="ij")
    middle, axes = np.array([0.25, -0.1, 0.1]), np.array([0.5, 0.3, 0.7])
    inside = sum(((c - m) / a) ** 2 for c, m, a in zip((x, y, z), middle, axes)) < 1
    voxels = inside.reshape(count, 2, count, 2, count, 2).mean(axis=(1, 3, 5))
    found = project_volume(voxels, geometry, method, device="cpu").numpy()
    for view in range(4):
        origins, directions, _, _ = line_reference.rays_of(geometry.detector, view)
        unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        o, d = (origins - middle) / axes, unit / axes
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
        chord = 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a
        assert np.abs(found[view] - chord).mean() < 0.005 * chord.max()
        assert found[view].sum() == pytest.approx(chord.sum(), rel=0.01)


@pytest.mark.parametrize("kind", [CONE, PARALLEL], ids=["cone", "parallel"])
def test_a_mesh_with_the_same_values_is_rendered_to_the_same_line_integrals(kind):
    """Rays, pixels and the end of the detector are those of `render`, to which the geometry is handed as it is."""
    geometry = ProjectionGeometry.from_dict(kind)
    count, (lower, upper) = 24, geometry.bounds.tolist()
    mesh = dtv.TetMesh.grid((3, 3, 3), lower, upper, dtype=torch.float64)
    slope = torch.tensor([0.5, -0.3, 0.2], dtype=torch.float64)
    field = dtv.Field(torch.zeros(mesh.num_vertices, 3, dtype=torch.float64), 3 + mesh.vertices @ slope)
    step = (geometry.bounds[1] - geometry.bounds[0]) / count
    axes = [geometry.bounds[0, a] + (torch.arange(count) + 0.5) * step[a] for a in range(3)]
    values = 3 + sum(s * c for s, c in zip(slope, torch.meshgrid(*axes, indexing="ij")))
    found = project_volume(values, geometry, "trilinear", dtype=torch.float64, device="cpu")
    for view in range(3):
        rendered = dtv.render(mesh, field, geometry.view(view)).optical_depth
        # Values are constant from the outermost middles to the faces of the box: that is what remains.
        torch.testing.assert_close(found[view], rendered, atol=0.002, rtol=0.002)


def test_many_views_are_projected_in_parts_and_counted(monkeypatch):
    import difftetvr.capture.projections.projector as module

    geometry = ProjectionGeometry.from_dict(CONE | {"views": 7})
    whole = project_volume(VALUES, geometry, device="cpu")
    monkeypatch.setattr(module, "_MAX_RAYS", 3 * 11 * 9)
    told = []
    parts = project_volume(VALUES, geometry, device="cpu", progress=lambda done, total: told.append((done, total)))
    assert torch.equal(parts, whole) and told == [(3, 7), (6, 7), (7, 7)]


@pytest.mark.parametrize(
    ("values", "method", "sentence"),
    [
        (VALUES[0], "siddon", r"shape \(5, 7\); pass \(X, Y, Z\)"),
        (np.where(VALUES > 0.9, np.nan, VALUES), "siddon", "not finite"),
        (VALUES, "joseph", "The method is 'joseph'; give siddon or trilinear"),
        ("volume", "siddon", "pass a tensor of real numbers"),
    ],
)
def test_what_cannot_be_projected_is_refused(values, method, sentence):
    with pytest.raises(CaptureError, match=sentence):
        project_volume(values, ProjectionGeometry.from_dict(CONE), method, device="cpu")


@pytest.mark.gpu
@pytest.mark.parametrize("method", ["siddon", "trilinear"])
def test_a_gpu_comes_to_the_same_line_integrals(method):
    geometry = ProjectionGeometry.from_dict(CONE)
    one, other = (project_volume(VALUES, geometry, method, dtype=torch.float64, device=d) for d in ("cpu", "cuda"))
    torch.testing.assert_close(one, other, atol=1e-12, rtol=0)
