"""Volumes in a notebook: the same page, in a frame."""

from __future__ import annotations

import html
from dataclasses import dataclass

from difftetvr.errors import DiffTetError
from difftetvr.inputs import as_whole
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import ScalarField
from difftetvr.view.page.document import Document, PageOptions

_LEAST_HEIGHT = 100


@dataclass(frozen=True)
class Frame:
    """A page in a frame, as notebooks display what a cell ends with.

    Attributes:
        page: HTML of the page.
        height: Pixels; the frame is as wide as the notebook.
    """

    page: str
    height: int

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" width="100%" height="{self.height}" '
            'sandbox="allow-scripts allow-downloads" style="border: 0; border-radius: 8px"></iframe>'
        )


def show(mesh: TetMesh, field: Field | ScalarField, options: PageOptions | None = None, *, height: int = 520) -> Frame:
    """Shows a volume in a notebook, to be turned and looked into there: end a cell with it, or ``display`` it.

    It is the page of :func:`save_page`, which holds all it shows: it stays alive in the notebook's file, whatever
    becomes of the kernel, and makes that file so much larger.

    Args:
        mesh: The mesh; its cells meet face to face.
        field: What it emits and absorbs: colours, with harmonics or without, or scalars through a transfer function.
        options: How it opens; None: as declared.
        height: Pixels, at least 100.

    Raises:
        MeshError: The cells do not meet face to face, or the field has other than three colours.
        DiffTetError: The arguments are of another kind.
    """
    height = as_whole(height, "The height of the frame", DiffTetError)
    if height < _LEAST_HEIGHT:
        raise DiffTetError(f"The height of the frame is {height} pixels; give at least {_LEAST_HEIGHT}.")
    return Frame(Document.of(mesh, field, options).text, height)
