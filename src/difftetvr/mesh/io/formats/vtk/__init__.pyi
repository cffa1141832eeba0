from . import cells as cells
from . import faces as faces
from . import grid as grid
from . import legacy as legacy
from . import lists as lists
from . import merging as merging
from . import series as series
from . import structured as structured
from . import xml as xml

__all__: list[str] = []
