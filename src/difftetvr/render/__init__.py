"""From camera and mesh to an image and back."""

from difftetvr.render.api import RenderedImage, render
from difftetvr.render.camera import Camera
from difftetvr.render.projected import OrderWarning
from difftetvr.render.scalar_field import ScalarField

__all__ = ["Camera", "OrderWarning", "RenderedImage", "ScalarField", "render"]
