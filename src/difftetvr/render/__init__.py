"""From camera and mesh to an image and back."""

from difftetvr.render.api import RenderedImage, render
from difftetvr.render.camera import Camera

__all__ = ["Camera", "RenderedImage", "render"]
