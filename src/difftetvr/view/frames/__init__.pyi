from . import axes as axes
from . import color_bar as color_bar
from . import films as films
from . import frame as frame
from . import lettering as lettering
from . import visible as visible
from .axes import AxesBox as AxesBox
from .color_bar import ColorScale as ColorScale
from .films import save_film as save_film
from .frame import FrameStyle as FrameStyle
from .frame import framed as framed

__all__ = ["AxesBox", "ColorScale", "FrameStyle", "framed", "save_film"]
