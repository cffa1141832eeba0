"""Space before cameras in which nothing can be."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from difftetvr.capture.free_space import FreeSpace
from difftetvr.capture.viewing import pose_of, positions_of
from difftetvr.errors import CaptureError
from difftetvr.mesh import TetMesh
from difftetvr.rendering import Camera

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
ASIDE = Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), fov_y=0.8, width=60, height=40)


def reach_of(points: torch.Tensor | None, share: float = 0.5) -> float:
    return FreeSpace.of([ASIDE], BOX, points, share).reaches[0]


def test_it_reaches_a_share_of_the_way_to_the_box() -> None:
    space = FreeSpace.of([ASIDE], BOX, None, 0.5)
    assert space.reaches == [2.0]
    z = torch.tensor([5.1, 4.9, 3.1, 2.9, 0.0])
    places = torch.stack((torch.zeros(5), torch.zeros(5), z), 1)
    assert space.contains(places).tolist() == [False, True, True, False, False]


def test_cells_that_hold_some_of_it_are_empty_at_all_corners() -> None:
    """One cell around the camera's tip, whose corners are all beside or behind, and one far away."""
    space = FreeSpace.of([ASIDE], BOX, None, 0.5)
    cell = torch.tensor([[18.0, 0.0, 1.0], [-9.0, 9.0, 1.0], [-9.0, -9.0, 1.0], [0.0, 0.0, 15.0]])
    mesh = TetMesh(torch.cat((cell, cell + torch.tensor([0.0, 0.0, 40.0]))), [[0, 1, 2, 3], [4, 5, 6, 7]])
    assert not space.contains(mesh.vertices).any()
    assert space.vertices_of(mesh).tolist() == [True] * 4 + [False] * 4
    assert not FreeSpace([], []).vertices_of(mesh).any()


def test_points_before_a_camera_bring_its_end_nearer() -> None:
    far = torch.rand(300, 3) * 2.0 - 1.0
    assert reach_of(far) == 2.0
    near = torch.tensor([[0.0, 0.0, 3.0]]).repeat(20, 1)
    assert reach_of(torch.cat((far, near))) == pytest.approx(1.0)
    # Few of them are mismatches; what lies outside of the cone says nothing about it.
    assert reach_of(torch.cat((far, near[:2]))) == 2.0
    assert reach_of(torch.cat((far, near + torch.tensor([1.8, 0.0, 0.0])))) == pytest.approx(1.345, abs=1e-3)
    assert reach_of(torch.cat((far, near + torch.tensor([3.0, 0.0, 0.0])))) == 2.0
    assert reach_of(torch.cat((far, near + torch.tensor([0.0, 0.0, 3.0])))) == 2.0


def test_few_points_count_all() -> None:
    far = torch.tensor([[0.0, 0.0, 0.5]]).repeat(49, 1)
    assert reach_of(torch.cat((far, torch.tensor([[0.0, 0.0, 4.0]])))) == pytest.approx(0.5)


@pytest.mark.parametrize("share", [-0.1, 1.0, 5.0, float("nan")])
def test_shares_out_of_range_are_refused(share: float) -> None:
    with pytest.raises(CaptureError, match=r"share of free space .* below 1"):
        FreeSpace.of([ASIDE], BOX, None, share)


def test_nothing_is_free_before_cameras_in_the_scene_or_where_none_is_asked_for() -> None:
    inside = ASIDE.with_pose(torch.eye(4))
    assert FreeSpace.of([inside, ASIDE], BOX, None, 0.5).cameras == [ASIDE]
    away = Camera.look_at((0.0, 0.0, 5.0), (0.0, 0.0, 9.0), (0.0, 1.0, 0.0), fov_y=0.8, width=60, height=40)
    assert FreeSpace.of([away, ASIDE], BOX, None, 0.5).cameras == [ASIDE]
    nowhere = FreeSpace.of([ASIDE], BOX, None, 0.0)
    assert not nowhere.contains(torch.randn(1000, 3) * 4.0).any()


def looks_at_box(pose: np.ndarray) -> bool:
    """Whether a camera of 30 x 50 pixels with a field of view of 0.7 has something of the box in its cone."""
    axis = (np.arange(16) + 0.5) / 8 - 1.0
    grid = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    focal = 25 / np.tan(0.35)
    within = (np.abs(grid[:, 0]) * focal <= 40 * grid[:, 2]) & (np.abs(grid[:, 1]) * focal <= 50 * grid[:, 2])
    return bool((within & (grid[:, 2] > 0)).any())


@given(st.integers(0, 10_000), st.floats(0.05, 0.95))
def test_it_is_the_union_of_the_cones_that_are_wider_than_the_views(seed: int, share: float) -> None:
    random = np.random.default_rng(seed)
    targets, eyes = random.normal(size=(3, 3)), random.normal(size=(3, 3)) * 6.0
    cameras = [Camera.look_at(e, t, (0.1, 0.2, 1.0), 0.7, 30, 50) for e, t in zip(eyes, targets, strict=True)]
    places = random.normal(size=(400, 3)) * 4.0
    found = FreeSpace.of(cameras, BOX, None, share).contains(torch.from_numpy(places)).numpy()
    expected = np.zeros(400, dtype=bool)
    for camera, eye in zip(cameras, positions_of(cameras), strict=True):
        pose = pose_of(camera)
        local = places @ pose[:3, :3].T + pose[:3, 3]
        way = np.linalg.norm(np.maximum(np.abs(eye) - 1.0, 0.0)) if looks_at_box(pose) else 0.0
        # Half the longer side more on either side of 30 x 50 pixels.
        across = np.abs(local[:, 0]) * camera.fx < 40 * local[:, 2]
        along = np.abs(local[:, 1]) * camera.fy < 50 * local[:, 2]
        expected |= across & along & (np.linalg.norm(local, axis=1) < share * way)
    assert (found == expected).all()
