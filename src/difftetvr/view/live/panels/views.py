"""The panel of a capture's cameras, which stand in the scene with their images."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from difftetvr.rendering import Camera
from difftetvr.view.live.panels.desk import Desk
from difftetvr.view.live.scene import Views

_ROOT, _POINTS = "/views", "/points"
_MOST_IMAGES, _IMAGE_SIDE = 300, 96
_MOST_POINTS = 200_000
_TRAINING, _HELD_OUT = (90, 150, 240), (250, 160, 40)
_SHARE = 0.06  # of a camera's distance from what it looks at that its frustum is long
_HIDDEN = 1.1  # lengths of a frustum that are so near to an eye that they are not drawn: it may be that camera's own


class ViewsPanel:
    """Shows the cameras of a capture as frusta; who clicks on one looks through it.

    Args:
        desk: What it works with.
        views: The views.
    """

    def __init__(self, desk: Desk, views: Views) -> None:
        self._desk, self._views = desk, views
        gui, count = desk.server.gui, len(views.cameras)
        with gui.add_folder("Photographs" if views.capture is not None else "Cameras"):
            self._is_on = gui.add_checkbox("Show cameras", views.capture is not None)
            self._size = gui.add_slider("Size", 0.1, 4.0, 0.1, 1.0)
            self._number = gui.add_number("View", 0, min=0, max=count - 1, step=1)
            self._go = gui.add_button("Look through it")
            self._nearest = gui.add_button("Look through the nearest")
        self._length = self._usual_length()
        self._frusta = self._placed()
        desk.server.initial_camera.near = _HIDDEN * self._length
        self._place_points()
        self._is_on.on_update(lambda _: self._set_visible())
        self._size.on_update(lambda _: self._resize())
        self._go.on_click(desk.guarded(lambda event: self._jump(int(self._number.value), event)))
        self._nearest.on_click(desk.guarded(self._jump_to_nearest))

    def _placed(self) -> list[Any]:
        desk, views = self._desk, self._views
        step = -(-len(views.cameras) // _MOST_IMAGES)
        frusta = []
        for index, camera in enumerate(views.cameras):
            wxyz, position = desk.placement.pose(camera)
            has_image = views.capture is not None and index % step == 0
            frustum = desk.server.scene.add_camera_frustum(
                f"{_ROOT}/{index}",
                2.0 * float(np.arctan(_half_height(camera))),
                (camera.width / camera.fx) / (camera.height / camera.fy),
                scale=self._scale_of(camera),
                thickness=1.5,
                thickness_units="screen",
                color=_HELD_OUT if bool(views.test[index]) else _TRAINING,
                image=desk.bytes_of(views.capture.images[index], _IMAGE_SIDE) if views.capture and has_image else None,
                wxyz=wxyz,
                position=position,
                visible=self._is_on.value,
            )
            frustum.on_click(desk.guarded(partial(self._jump, index)))
            frusta.append(frustum)
        return frusta

    def _scale_of(self, camera: Camera) -> float:
        """The scale of a frustum that is as long as all are; viser's have the same volume, whatever they see."""
        half_width = 0.5 * camera.width / camera.fx
        return self._size.value * self._length * float(np.cbrt(half_width * _half_height(camera) / 3.0))

    def _usual_length(self) -> float:
        focus = self._desk.placement.inward(self._desk.studio.scene.focus.numpy())
        positions = np.stack([self._desk.placement.pose(camera)[1] for camera in self._views.cameras])
        return _SHARE * float(np.median(np.linalg.norm(positions - focus, axis=1)))

    def _place_points(self) -> None:
        """Shows the points of a capture where nothing else is to be seen."""
        capture = self._views.capture
        if self._desk.studio.scene.content is not None or capture is None or capture.scene_points is None:
            return
        points, colors = capture.points, capture.point_colors
        assert points is not None
        step = -(-len(points) // _MOST_POINTS)
        shades = np.full((len(points[::step]), 3), 200, np.uint8)
        if colors is not None:
            shades = (colors[::step].clamp(0.0, 1.0) * 255.0).round().byte().numpy()
        places = self._desk.placement.inward(points[::step].numpy()).astype(np.float32)
        self._desk.server.scene.add_point_cloud(_POINTS, places, shades, point_size=0.003)

    def _set_visible(self) -> None:
        for frustum in self._frusta:
            frustum.visible = self._is_on.value

    def _resize(self) -> None:
        for frustum, camera in zip(self._frusta, self._views.cameras, strict=True):
            frustum.scale = self._scale_of(camera)
        near = _HIDDEN * self._size.value * self._length
        self._desk.server.initial_camera.near = near
        for client in self._desk.server.get_clients().values():
            client.camera.near = near

    def _jump(self, index: int, event: Any) -> None:
        if event.client is not None:
            self._number.value = index
            self._desk.move(event.client, self._views.cameras[index])

    def _jump_to_nearest(self, event: Any) -> None:
        if event.client is not None:
            camera: Camera = self._desk.camera_of(event.client)
            self._jump(self._views.nearest_to(camera, self._desk.studio.scene.focus), event)


def _half_height(camera: Camera) -> float:
    """Half of the height of an image at distance 1."""
    return 0.5 * camera.height / camera.fy
