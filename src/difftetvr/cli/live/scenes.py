"""Scenes of models, for the viewer."""

from __future__ import annotations

from difftetvr.cli.drawing.cameras import Place
from difftetvr.view.frames.visible import UP
from difftetvr.view.live.contents import Content
from difftetvr.view.live.scene import Scene, Views
from difftetvr.view.live.settings import Settings


def scene_around(
    title: str, content: Content, place: Place, views: Views | None, settings: Settings, scalar: str | None = None
) -> Scene:
    """A model, looked at as its pictures are: among photographs, if it comes from some.

    Args:
        title: What it is called.
        content: The model.
        place: Where cameras stand around it.
        views: The views of what it comes from.
        settings: How it is seen at first.
        scalar: Name of the scalar that is shown, if one is.

    Raises:
        CameraError: The camera's file is not valid.
    """
    known, photographs = place.views, None if views is None else views.capture
    (camera,) = place.shots(content.bounds).cameras
    return Scene(
        title=title,
        content=content,
        bounds=content.bounds if known is None or photographs is None else photographs.bounds.double(),
        start=camera,
        up=UP if known is None else tuple(known.up.tolist()),
        settings=settings,
        views=views,
        scalar=scalar,
    )
