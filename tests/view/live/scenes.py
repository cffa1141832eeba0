"""Small scenes to look at."""

from __future__ import annotations

import dataclasses

import torch

from difftetvr.capture import Capture
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, ScalarField, render
from difftetvr.view.live.contents import MeshContent
from difftetvr.view.live.scene import Scene, Views
from difftetvr.view.live.settings import ScalarLook, Settings

MIDDLE = (2.0, 2.0, 2.0)
START = Camera.look_at((6.5, -4.0, 5.0), MIDDLE, (0.0, 0.0, 1.0), 0.9, 60, 40)


def grid(cells: int = 4) -> TetMesh:
    """A cube from 0 to 4."""
    return TetMesh.grid((cells,) * 3, (0.0, 0.0, 0.0), (4.0, 4.0, 4.0))


def colored() -> Scene:
    """A cube of many colours."""
    mesh = grid()
    torch.manual_seed(0)
    field = Field(torch.rand(mesh.num_vertices, 3), 0.2 + torch.rand(mesh.num_vertices))
    content = MeshContent(mesh, field)
    return Scene("cube", content, content.bounds, START, (0.0, 0.0, 1.0), Settings())


def scalars(cells: int = 4) -> Scene:
    """Distances from the middle of a cube."""
    mesh = grid(cells)
    distance = (mesh.vertices - torch.tensor(MIDDLE)).norm(dim=1)
    look = ScalarLook(TransferFunction.default(), (0.0, 3.0), 20.0)
    content = MeshContent(mesh, ScalarField(distance, look.transfer_function, 5.0, (0.0, 3.0)))
    return Scene("ball", content, content.bounds, START, (0.0, 0.0, 1.0), Settings(look=look), scalar="distance")


def photographed(wrong: float = 0.0) -> Scene:
    """The coloured cube with three photographs of it, all of whose colours are wrong by so much."""
    scene = colored()
    assert isinstance(scene.content, MeshContent)
    eyes = [(7.0, -3.0, 3.0), (-3.0, 6.0, 4.0), (2.5, 2.0, 8.0)]
    cameras = [Camera.look_at(eye, MIDDLE, (0.0, 1.0, 0.5), 0.8, 48, 36) for eye in eyes]
    with torch.no_grad():
        images = torch.stack([render(scene.content.mesh, scene.content.field, camera).color for camera in cameras])
    test = torch.tensor([False, False, True])
    capture = Capture(cameras, images + wrong, None, test, scene.bounds.float(), "cube")
    return dataclasses.replace(scene, views=Views.of(capture))
