from . import data as data
from . import elements as elements
from . import entities as entities
from . import nodes as nodes
from . import reading as reading
from . import writing as writing

__all__: list[str] = []
