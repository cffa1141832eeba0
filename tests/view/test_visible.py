"""Default cameras, turned to what can be seen."""

import math

import pytest
import torch

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, render
from difftetvr.view.frames.visible import FILLED, glance, zoomed


def scene() -> tuple[TetMesh, Field]:
    """A dense ball in a corner of a cube."""
    mesh = TetMesh.grid((12, 12, 12), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    near = (mesh.vertices - torch.tensor([0.2, 0.1, 0.25])).norm(dim=1) < 0.2
    return mesh, Field(torch.ones(mesh.num_vertices, 3), 40.0 * near)


def ends_of(alpha: torch.Tensor) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of what is seen, in parts of the picture."""
    rows, columns = (torch.nonzero((alpha > 0.02).any(axis)).flatten() for axis in (1, 0))
    height, width = alpha.shape
    return columns[0] / width, (columns[-1] + 1) / width, rows[0] / height, (rows[-1] + 1) / height


@pytest.mark.parametrize("size", [(512, 512), (640, 360), (400, 500)])
@pytest.mark.parametrize("room", [(0.0, 0.0), (0.2, 0.05)])
def test_what_is_seen_fills_the_picture_in_its_middle(size: tuple[int, int], room: tuple[float, float]) -> None:
    mesh, field = scene()
    camera = Camera.look_at((1.0, -2.0, 1.0), (0.0, 0.0, 0.0), fov_y=0.9, width=size[0], height=size[1])
    closer = zoomed(camera, render(mesh, field, glance(camera)).alpha, room)
    left, right, top, bottom = ends_of(render(mesh, field, closer).alpha)
    free = FILLED - 2 * room[1]
    filled = max(float(right - left) / (free * (1 - room[0])), float(bottom - top) / free)
    assert 0.93 < filled <= 1.02  # a glance has few pixels
    assert abs(float(left + right) / 2 - (1 - room[0]) / 2) < 0.02
    assert abs(float(top + bottom) / 2 - 0.5) < 0.02
    assert torch.equal(closer.world_to_camera, camera.world_to_camera) and (closer.width, closer.height) == size


def test_a_glance_sees_what_the_camera_sees() -> None:
    camera = Camera.look_at((1.0, -2.0, 1.0), (0.0, 0.0, 0.0), fov_y=0.9, width=640, height=360)
    small = glance(camera)
    assert (small.width, small.height) == (128, 72)
    assert math.isclose(small.fy / small.height, camera.fy / camera.height)
    tiny = Camera.look_at((1.0, -2.0, 1.0), (0.0, 0.0, 0.0), width=40, height=30)
    assert (glance(tiny).width, glance(tiny).height) == (40, 30)


def test_nothing_and_everything_leave_a_camera_as_it_is() -> None:
    camera = Camera.look_at((1.0, -2.0, 1.0), (0.0, 0.0, 0.0), width=64, height=48)
    assert zoomed(camera, torch.zeros(48, 64)) is camera
    assert zoomed(camera, torch.ones(48, 64)) is camera


def test_a_speck_is_not_brought_as_near_as_can_be() -> None:
    camera = Camera.look_at((1.0, -2.0, 1.0), (0.0, 0.0, 0.0), width=64, height=48)
    speck = torch.zeros(48, 64)
    speck[24, 32] = 1.0
    assert zoomed(camera, speck).fx == pytest.approx(4.0 * camera.fx)
