"""The page itself: one file of HTML with poster, volume and script, which asks nothing of a server or network."""

from __future__ import annotations

import base64
import dataclasses
import html
import io
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import torch

from difftetvr._version import __version__
from difftetvr.errors import CameraError, DiffTetError, MeshError, shown
from difftetvr.files import atomic_write
from difftetvr.inputs import require_type
from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import Camera, ScalarField, render
from difftetvr.view.page.opening import Opening
from difftetvr.view.page.scene import Box, Scene
from difftetvr.view.pictures import to_picture

_POSTER_SIZE, _POSTER_QUALITY = 512, 85
_MOST_TITLE = 200

# What the page may load: nothing from anywhere but itself.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"

_DOCUMENT = """<!doctype html>
<html lang="en" style="background: {background}">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="generator" content="DiffTetVR for Python {version}">
<title>{title}</title>
<style>
#poster {{ position: fixed; top: 0; left: 0; width: 100%; height: 100%; object-fit: contain }}
@media (min-width: 700px) {{ #poster {{ width: calc(100% - 324px) }} }}
</style>
</head>
<body>
<img id="poster" alt="{title}" src="data:image/jpeg;base64,{poster}">
<noscript>This page shows a volume, to be turned and looked into, where JavaScript is switched on.</noscript>
<script id="volume" type="text/plain">{volume}</script>
<script>{script}</script>
</body>
</html>
"""


@dataclass(frozen=True)
class PageOptions:
    """How a page opens.

    Attributes:
        title: What it is called, of at most 200 characters.
        background: Linear R G B behind the volume, each in [0, 1].
        camera: Pinhole camera whose view it opens with; None: the whole mesh, from in front and a little above.
        scalar: Name of the scalar, for scalars.

    Raises:
        DiffTetError: One of them is something else.
    """

    title: str = "Volume"
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    camera: Camera | None = None
    scalar: str | None = None

    def __post_init__(self) -> None:
        require_type(self.title, str, "The title of the page", "pass a text", DiffTetError)
        background = self.background
        is_color = isinstance(background, (tuple, list)) and len(background) == 3
        if not is_color or not all(isinstance(v, (int, float)) and 0.0 <= v <= 1.0 for v in background):
            raise DiffTetError(
                f"The background of the page is {shown(background)}; give linear R G B between 0 and 1, a browser "
                "shows no others."
            )
        if self.camera is not None and type(self.camera) is not Camera:
            raise CameraError(f"The camera of the page is {shown(self.camera)}; pass a difftetvr.Camera, or None.")


@dataclass(frozen=True)
class Document:
    """A page.

    Attributes:
        text: The HTML.
        inverted: Number of cells that rounding of positions has turned inside out; rays pass them unseen.
    """

    text: str
    inverted: int

    @staticmethod
    def of(mesh: TetMesh, field: Field | ScalarField, options: PageOptions | None = None) -> Document:
        """The page of a volume.

        Args:
            mesh: The mesh.
            field: What it emits and absorbs.
            options: How it opens; None: as declared.

        Raises:
            MeshError: The cells do not meet face to face, or the field has other than three colours.
            DiffTetError: The arguments are of another kind.
        """
        require_type(mesh, TetMesh, "mesh", "pass a difftetvr.TetMesh", DiffTetError)
        require_type(field, (Field, ScalarField), "field", "pass a difftetvr.Field or ScalarField", DiffTetError)
        options = options or PageOptions()
        scene, box = Scene.of(mesh, field), Box.of(mesh)
        center = torch.from_numpy(box.center)
        opening = Opening.of(center, torch.from_numpy(box.extent), options.camera)
        scene.pack.header |= {
            "opening": dataclasses.asdict(opening),
            "background": [float(value) for value in options.background],
            "title": options.title[:_MOST_TITLE],
            "scalar": options.scalar,
        }
        poster = _poster(mesh, field, opening.camera(center, box.size, _POSTER_SIZE), options.background)
        levels = ", ".join(str(round(255 * value)) for value in options.background)
        text = _DOCUMENT.format(
            background=f"rgb({levels})",
            policy=_POLICY,
            version=__version__,
            title=html.escape(options.title[:_MOST_TITLE]),
            poster=base64.b64encode(poster).decode("ascii"),
            volume=scene.pack.text(),
            script=_script(),
        )
        return Document(text, scene.inverted)


def save_page(
    path: str | Path, mesh: TetMesh, field: Field | ScalarField, options: PageOptions | None = None
) -> Document:
    """Writes a page that shows a volume in any browser with WebGPU or WebGL 2: one file, no server, no network.

    Positions are rounded to 1/65536 of the mesh's longest side, to 1/2^24 where that would turn a cell inside out;
    colours and densities to half floats, scalars to as fine steps, harmonics to bytes. Pictures of it are those of
    `render` within 40 dB.

    Args:
        path: File to write, .html.
        mesh: The mesh; its cells meet face to face.
        field: What it emits and absorbs: colours, with harmonics or without, or scalars through a transfer function.
        options: How the page opens; None: as declared.

    Returns:
        What was written.

    Raises:
        MeshError: The cells do not meet face to face, the field has other than three colours, or the file cannot be
            written.
        DiffTetError: The arguments are of another kind.
    """
    document = Document.of(mesh, field, options)
    with atomic_write(path, MeshError) as temporary:
        temporary.write_text(document.text, encoding="utf-8")
    return document


def _poster(mesh: TetMesh, field: Field | ScalarField, camera: Camera, background: Any) -> bytes:
    """What is seen before the script has drawn its first picture, or instead: a JPEG."""
    with torch.no_grad():
        image = render(mesh, field, camera, torch.tensor(background)).color
    file = io.BytesIO()
    to_picture(image).save(file, format="JPEG", quality=_POSTER_QUALITY)
    return file.getvalue()


def _script() -> str:
    file = resources.files("difftetvr") / "view" / "page" / "page.js"
    return file.read_text(encoding="utf-8")
