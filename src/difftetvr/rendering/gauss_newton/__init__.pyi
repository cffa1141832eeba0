from . import choice as choice
from . import images as images
from . import line_integrals as line_integrals
from . import models as models
from .choice import HatChoice as HatChoice
from .images import model_image as model_image
from .line_integrals import model_line_integrals as model_line_integrals
from .models import HatDerivatives as HatDerivatives
from .models import ImageModel as ImageModel
from .models import StepDerivatives as StepDerivatives

__all__ = [
    "HatChoice",
    "HatDerivatives",
    "ImageModel",
    "StepDerivatives",
    "model_image",
    "model_line_integrals",
]
