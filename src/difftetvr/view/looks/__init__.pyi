from . import colormaps as colormaps
from . import distribution as distribution
from . import look as look
from . import opacities as opacities
from .colormaps import colormap_colors as colormap_colors
from .distribution import Distribution as Distribution
from .look import Appearance as Appearance
from .look import Look as Look

__all__ = ["Appearance", "Distribution", "Look", "colormap_colors"]
