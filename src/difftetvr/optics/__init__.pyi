from . import coefficients as coefficients
from . import constant as constant
from . import exact as exact
from . import model as model
from . import special as special
from . import subsegments as subsegments
from . import transfer_function as transfer_function
from .constant import ConstantPerCell as ConstantPerCell
from .exact import ExactLinear as ExactLinear
from .model import OpticalModel as OpticalModel
from .subsegments import SubSegments as SubSegments
from .transfer_function import TransferFunction as TransferFunction

__all__ = ["ConstantPerCell", "ExactLinear", "OpticalModel", "SubSegments", "TransferFunction"]
