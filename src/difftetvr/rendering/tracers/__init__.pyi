from . import bands as bands
from . import cell_order as cell_order
from . import fragments as fragments
from . import linked_list as linked_list
from . import marching as marching
from . import projected as projected
from . import tiles as tiles

__all__: list[str] = []
