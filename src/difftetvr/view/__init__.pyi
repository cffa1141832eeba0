from . import blank as blank
from . import compare as compare
from . import cut as cut
from . import describe as describe
from . import heatmap as heatmap
from . import page as page
from . import pictures as pictures
from . import plots as plots
from . import report as report
from . import transfer_report as transfer_report
from . import viewpoints as viewpoints
from .page import PageOptions as PageOptions
from .page import save_page as save_page
from .page import show as show
from .pictures import save_png as save_png

__all__ = ["PageOptions", "save_page", "save_png", "show"]
