from . import document as document
from . import notebook as notebook
from . import opening as opening
from . import packing as packing
from . import scene as scene
from .document import PageOptions as PageOptions
from .document import save_page as save_page
from .notebook import show as show

__all__ = ["PageOptions", "save_page", "show"]
