from . import faces as faces
from . import incidence as incidence
from . import link as link
from . import rings as rings
from . import topology as topology

__all__: list[str] = []
