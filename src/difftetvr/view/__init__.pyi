from . import blank as blank
from . import compare as compare
from . import cut as cut
from . import describe as describe
from . import frames as frames
from . import heatmap as heatmap
from . import looks as looks
from . import pictures as pictures
from . import plots as plots
from . import report as report
from . import transfer_report as transfer_report
from . import viewpoints as viewpoints
from .pictures import save_png as save_png

__all__ = ["save_png"]
