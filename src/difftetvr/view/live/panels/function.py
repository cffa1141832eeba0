"""The panel of a transfer function: knots that are dragged, colour maps, range and density."""

from __future__ import annotations

import dataclasses
import math
import threading
from typing import Any

from difftetvr.errors import MeshError
from difftetvr.view.live.edited_function import MOST_KNOTS, EditedFunction
from difftetvr.view.live.panels.desk import Desk
from difftetvr.view.live.settings import ScalarLook

_COLORMAPS = (
    *("coolwarm", "viridis", "magma", "inferno", "plasma", "cividis", "turbo", "gray", "bone", "hot", "twilight"),
)
_GIVEN = "as given"
_STEP = 0.001  # of the places of knots
_DECADES = 2.0  # of densities on either side of the first one


class FunctionPanel:
    """Edits what scalars look like; shared by all windows.

    Args:
        desk: What it works with.
        look: What they look like at first.
        scalar: Name of the scalar.
    """

    def __init__(self, desk: Desk, look: ScalarLook, scalar: str) -> None:
        self._desk, self._given, self._look = desk, look, look
        self._edited = EditedFunction.of(look.transfer_function)
        self._chosen, self._alone = 0, threading.Lock()
        gui = desk.server.gui
        with gui.add_folder(f"Transfer function of {scalar}"):
            self._drawing = gui.add_html(self._edited.drawing(0))
            self._places = gui.add_multi_slider("Knots", 0.0, 1.0, _STEP, self._edited.places)
            self._knot = gui.add_slider("Chosen", 1, len(self._edited.places), 1, 1)
            self._opacity = gui.add_slider("Opacity", 0.0, 1.0, _STEP, self._edited.opacities[0])
            self._buttons = gui.add_button_group("Edit", ("Add", "Remove", "Reset"))
            self._colormap = gui.add_dropdown("Colours", (_GIVEN, *_COLORMAPS), initial_value=_GIVEN)
            self._range = gui.add_vector2("Range", look.value_range, step=_range_step(look.value_range))
            self._density = gui.add_slider("Density x 10^", -_DECADES, _DECADES, 0.01, 0.0)
            self._name = gui.add_text("Name", desk.free_name("transfer-function", ".json"))
            self._save = gui.add_button("Save as .json")
        self._places.on_update(self._edits(self._drag))
        self._knot.on_update(self._edits(self._choose))
        self._opacity.on_update(self._edits(self._raise))
        self._buttons.on_click(self._edits(self._press))
        self._colormap.on_update(self._edits(self._recolor))
        self._range.on_update(self._edits(self._stretch))
        self._density.on_update(self._edits(self._thicken))
        self._save.on_click(desk.guarded(self._write))

    def _edits(self, edit: Any) -> Any:
        """A callback that changes the look, one at a time; what it sets of the panel itself, no client has set."""

        def callback(event: Any) -> None:
            if event.client_id is not None:
                with self._alone:
                    edit()

        return self._desk.guarded(callback)

    def _drag(self) -> None:
        places = tuple(self._places.value)
        if len(places) != len(self._edited.places):
            return  # the answer of a window that does not know yet that a knot came or went
        moved = [abs(new - old) for new, old in zip(places, self._edited.places, strict=True)]
        self._chosen = moved.index(max(moved)) if max(moved) > 0.0 else self._chosen
        self._edit(self._edited.moved(places))

    def _choose(self) -> None:
        self._chosen = min(int(self._knot.value), len(self._edited.places)) - 1
        self._show()

    def _raise(self) -> None:
        self._edit(self._edited.with_opacity(self._chosen, float(self._opacity.value)))

    def _press(self) -> None:
        if self._buttons.value == "Reset":
            self._look, self._chosen = self._given, 0
            self._edited = EditedFunction.of(self._given.transfer_function)
            self._colormap.value, self._range.value = _GIVEN, self._given.value_range
            self._density.value = 0.0
            self._desk.studio.change(look=self._given)
            self._show()
        elif self._buttons.value == "Remove":
            edited, self._chosen = self._edited.without_knot(self._chosen), max(0, self._chosen - 1)
            self._edit(edited)
        elif len(self._edited.places) < MOST_KNOTS:
            edited, self._chosen = self._edited.with_knot_after(self._chosen)
            self._edit(edited)

    def _recolor(self) -> None:
        if self._colormap.value == _GIVEN:
            self._edit(dataclasses.replace(self._edited, colors=self._given.transfer_function))
        else:
            self._edit(self._edited.in_colors_of(self._colormap.value))

    def _stretch(self) -> None:
        low, high = self._range.value
        if not low < high:
            raise MeshError(f"The range is {low:g} to {high:g}; give two numbers, the smaller first.")
        self._look = dataclasses.replace(self._look, value_range=(low, high))
        self._desk.studio.change(look=self._look)

    def _thicken(self) -> None:
        self._look = dataclasses.replace(self._look, density=self._given.density * 10.0 ** float(self._density.value))
        self._desk.studio.change(look=self._look)

    def _edit(self, edited: EditedFunction) -> None:
        self._edited = edited
        self._look = dataclasses.replace(self._look, transfer_function=edited.function)
        self._desk.studio.change(look=self._look)
        self._show()

    def _show(self) -> None:
        """Brings the panel up to what is edited."""
        count = len(self._edited.places)
        self._chosen = min(self._chosen, count - 1)
        self._drawing.content = self._edited.drawing(self._chosen)
        self._knot.max = count
        # Only what differs: windows answer what they are told.
        for handle, value in (
            (self._places, self._edited.places),
            (self._knot, self._chosen + 1),
            (self._opacity, self._edited.opacities[self._chosen]),
        ):
            if handle.value != value:
                handle.value = value

    def _write(self, event: Any) -> None:
        path = self._desk.file(self._name.value, ".json")
        self._look.transfer_function.save(path)
        low, high = self._look.value_range
        options = f"--transfer-function {path.name} --value-range {low:.9g} {high:.9g}"
        self._desk.tell(f"Wrote {path}; the same picture: {options} --attenuation {self._look.density:.6g}")
        self._name.value = self._desk.free_name("transfer-function", ".json")


def _range_step(value_range: tuple[float, float]) -> float:
    """A power of ten that is a hundredth of a range, or less."""
    return 10.0 ** math.floor(math.log10((value_range[1] - value_range[0]) / 100.0))
