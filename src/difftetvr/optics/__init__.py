"""What light does inside one cell: weights of the end colours, transmittance, and their adjoints."""

from difftetvr.optics.constant import ConstantPerCell
from difftetvr.optics.exact import ExactLinear
from difftetvr.optics.model import OpticalModel
from difftetvr.optics.subsegments import SubSegments
from difftetvr.optics.transfer_function import TransferFunction

__all__ = ["ConstantPerCell", "ExactLinear", "OpticalModel", "SubSegments", "TransferFunction"]
