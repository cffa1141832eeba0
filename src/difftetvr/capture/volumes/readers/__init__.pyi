from . import nrrd as nrrd
from . import raw as raw
from . import vti as vti

__all__: list[str] = []
