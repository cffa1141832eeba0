from . import initial_mesh as initial_mesh
from . import requirements as requirements
from . import starting_mesh as starting_mesh

__all__: list[str] = []
