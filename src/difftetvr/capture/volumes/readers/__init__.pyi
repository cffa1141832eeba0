from . import detached as detached
from . import metaimage as metaimage
from . import nifti as nifti
from . import nrrd as nrrd
from . import nrrd_axes as nrrd_axes
from . import numpy_array as numpy_array
from . import packages as packages
from . import raw as raw
from . import table as table
from . import tiff as tiff
from . import vti as vti

__all__: list[str] = []
