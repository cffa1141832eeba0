from . import adjoint as adjoint
from . import forward as forward
from . import gradients as gradients
from . import hats as hats
from . import profile as profile
from . import segments as segments
from . import walk_adjoint as walk_adjoint

__all__: list[str] = []
