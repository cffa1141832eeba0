from . import cells as cells
from . import faces as faces
from . import grid as grid
from . import legacy as legacy
from . import legacy_writing as legacy_writing
from . import lists as lists
from . import merging as merging
from . import series as series
from . import structured as structured
from . import xml as xml
from . import xml_writing as xml_writing

__all__: list[str] = []
