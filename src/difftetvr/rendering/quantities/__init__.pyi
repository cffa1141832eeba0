from . import along_rays as along_rays
from . import normals as normals
from . import profile as profile
from .along_rays import depth_at as depth_at
from .along_rays import transmittance_at as transmittance_at
from .normals import render_normals as render_normals

__all__ = ["depth_at", "render_normals", "transmittance_at"]
