from . import entropy as entropy
from . import poses as poses
from . import search as search
from .entropy import color_entropy as color_entropy
from .entropy import opacity_entropy as opacity_entropy
from .entropy import reference_colors as reference_colors
from .search import Viewpoint as Viewpoint
from .search import ViewpointConfig as ViewpointConfig
from .search import ViewpointSearch as ViewpointSearch
from .search import best_viewpoint as best_viewpoint
from .search import sample_viewpoints as sample_viewpoints

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
