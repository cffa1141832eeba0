"""The panel of what is shown, of the scale of its colours, and of what is cut away."""

from __future__ import annotations

import html
from typing import Any

import numpy as np
from matplotlib import colormaps

from difftetvr.view.cut import Plane, cut_edges
from difftetvr.view.heatmap import COLORMAP, Scale
from difftetvr.view.live.contents import MeshContent
from difftetvr.view.live.panels.desk import Desk

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_ACROSS = "this view"
_LINES = "/cut"


class ShowPanel:
    """What is shown, and behind which colours; shared by all windows.

    Args:
        desk: What it works with.
    """

    def __init__(self, desk: Desk) -> None:
        self._desk, gui, studio = desk, desk.server.gui, desk.studio
        with gui.add_folder("Show"):
            self._mode = gui.add_dropdown("Quantity", studio.scene.modes, initial_value=studio.settings.mode)
            self._legend = gui.add_html(_legend(None))
            background = tuple(round(255 * min(max(part, 0.0), 1.0)) for part in studio.settings.background)
            self._background = gui.add_rgb("Background", background)
        self._mode.on_update(lambda _: studio.change(mode=self._mode.value))
        self._background.on_update(
            lambda _: studio.change(background=tuple(part / 255.0 for part in self._background.value))
        )
        self._told: Scale | None = None

    def tell_scale(self, scale: Scale | None) -> None:
        """Shows the scale of the last picture."""
        if scale != self._told:
            self._told = scale
            self._legend.content = _legend(scale)


class ClipPanel:
    """A plane that cuts away what is in front of it, and the outlines of the cells that it cuts.

    Args:
        desk: What it works with.
    """

    def __init__(self, desk: Desk) -> None:
        self._desk, gui = desk, desk.server.gui
        self._is_due = False
        self._normal = np.array(_AXES["x"])
        with gui.add_folder("Clip plane", expand_by_default=False):
            self._is_on = gui.add_checkbox("Clip", False)
            self._axis = gui.add_dropdown("Across", (*_AXES, _ACROSS), initial_value="x")
            self._place = gui.add_slider("Position", 0.0, 1.0, 0.005, 0.5)
            self._is_flipped = gui.add_checkbox("Other side", False)
            self._has_cells = gui.add_checkbox(
                "Outline cells", False, visible=isinstance(desk.studio.scene.content, MeshContent)
            )
        for handle in (self._is_on, self._place, self._is_flipped, self._has_cells):
            handle.on_update(desk.guarded(lambda _: self._apply()))
        self._axis.on_update(desk.guarded(self._turn))

    def choose(self, axis: str, is_on: bool, has_cells: bool) -> None:
        """Sets the controls, as a hand would.

        Args:
            axis: x, y or z.
            is_on: Whether anything is cut away.
            has_cells: Whether the cells that are cut have outlines.
        """
        self._axis.value, self._is_on.value, self._has_cells.value = axis, is_on, has_cells

    def _turn(self, event: Any) -> None:
        if self._axis.value in _AXES:
            self._normal = np.array(_AXES[self._axis.value])
        elif event.client is not None:
            camera = self._desk.camera_of(event.client)
            self._normal = camera.world_to_camera[2, :3].detach().cpu().double().numpy()
        self._apply()

    def _apply(self) -> None:
        normal = -self._normal if self._is_flipped.value else self._normal
        lower, upper = self._desk.studio.scene.bounds.numpy()
        middle, reach = 0.5 * (lower + upper), 0.5 * np.abs(normal) @ (upper - lower)
        share = 1.0 - self._place.value if self._is_flipped.value else self._place.value
        offset = float(normal @ middle + (2.0 * share - 1.0) * reach)
        half_space = (*(float(part) for part in normal), -offset)
        self._desk.studio.change(clip=half_space if self._is_on.value else None)
        self.outline()

    def outline(self) -> None:
        """Has the outlines of the cells drawn anew, once, however often it is called meanwhile."""
        if not self._is_due:
            self._is_due = True
            self._desk.studio.ask(self._draw_outlines)

    def _draw_outlines(self) -> None:
        self._is_due = False
        desk, clip, content = self._desk, self._desk.studio.settings.clip, self._desk.studio.scene.content
        if clip is None or not self._has_cells.value or not isinstance(content, MeshContent):
            desk.server.scene.remove_by_name(_LINES)
            return
        normal = np.array(clip[:3])
        origin = -clip[3] * normal / (normal @ normal)
        edges = cut_edges(content.mesh, Plane(tuple(normal.tolist()), tuple(origin.tolist())))
        color = (20, 20, 20) if sum(desk.studio.settings.background) > 1.5 else (235, 235, 235)
        points = desk.placement.inward(edges).astype(np.float32)
        desk.server.scene.add_line_segments(_LINES, points, color, thickness=1.0, thickness_units="screen")


def _legend(scale: Scale | None) -> str:
    """HTML of a colour scale."""
    if scale is None:
        return ""
    stops = ",".join(
        "rgb({},{},{})".format(*(round(255 * part) for part in colormaps[COLORMAP](place)[:3]))
        for place in np.linspace(0.0, 1.0, 9)
    )
    label = html.escape(scale.label + (", logarithmic" if scale.is_logarithmic else ""))
    return (
        '<div class="legend" style="padding:0 0.75em;font-size:0.8em">'
        f'<div style="height:0.9em;background:linear-gradient(to right,{stops})"></div>'
        '<div style="display:flex;justify-content:space-between">'
        f"<span>{scale.lowest:.4g}</span><span>{label}</span><span>{scale.highest:.4g}</span></div></div>"
    )
