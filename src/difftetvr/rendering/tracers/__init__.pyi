from . import bands as bands
from . import camera_inside as camera_inside
from . import cell_order as cell_order
from . import entry as entry
from . import entry_table as entry_table
from . import fragments as fragments
from . import linked_list as linked_list
from . import marching as marching
from . import projected as projected
from . import rasterise as rasterise
from . import tiles as tiles

__all__: list[str] = []
