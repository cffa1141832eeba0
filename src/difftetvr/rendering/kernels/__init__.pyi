from . import adjoint as adjoint
from . import forward as forward
from . import hats as hats

__all__: list[str] = []
