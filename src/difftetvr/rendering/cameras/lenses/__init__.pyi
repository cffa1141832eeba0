from . import distortion as distortion
from . import models as models
from . import radial as radial

__all__: list[str] = []
