from . import bundle_hits as bundle_hits
from . import entry as entry
from . import hierarchy as hierarchy
from . import hits as hits
from . import rasterise as rasterise
from . import scene as scene
from . import starts as starts

__all__: list[str] = []
