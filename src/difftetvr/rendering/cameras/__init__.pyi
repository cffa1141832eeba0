from . import pinhole as pinhole
from . import pinhole_rays as pinhole_rays
from . import rigid as rigid
from .pinhole import Camera as Camera

__all__ = ["Camera"]
