from . import tomography as tomography
from . import viewpoint as viewpoint
from .viewpoint.entropy import color_entropy as color_entropy
from .viewpoint.entropy import opacity_entropy as opacity_entropy
from .viewpoint.entropy import reference_colors as reference_colors
from .viewpoint.search import Viewpoint as Viewpoint
from .viewpoint.search import ViewpointConfig as ViewpointConfig
from .viewpoint.search import ViewpointSearch as ViewpointSearch
from .viewpoint.search import best_viewpoint as best_viewpoint
from .viewpoint.search import sample_viewpoints as sample_viewpoints

__all__ = [
    "Viewpoint",
    "ViewpointConfig",
    "ViewpointSearch",
    "best_viewpoint",
    "color_entropy",
    "opacity_entropy",
    "reference_colors",
    "sample_viewpoints",
]
