from . import pinhole as pinhole
from .pinhole import Camera as Camera

__all__ = ["Camera", "pinhole"]
