from . import assembly as assembly
from . import document as document
from . import items as items
from . import reading as reading
from . import topology as topology
from . import writing as writing

__all__: list[str] = []
