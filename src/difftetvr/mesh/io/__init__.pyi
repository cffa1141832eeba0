from . import content as content
from . import formats as formats
from . import hdf5 as hdf5
from . import isolation as isolation
from . import loading as loading
from . import netcdf as netcdf
from . import saving as saving
from . import source as source
from . import tetrahedra as tetrahedra
from .building import Defects as Defects
from .building import Flat as Flat
from .formats.npz import is_mesh_archive as is_mesh_archive
from .loading import FIELD_ARRAYS as FIELD_ARRAYS
from .loading import HARMONICS as HARMONICS
from .loading import MeshData as MeshData
from .loading import load as load
from .loading import load_data as load_data
from .loading import load_mesh as load_mesh
from .loading import load_with_optional_field as load_with_optional_field
from .saving import GEOMETRY_SUFFIXES as GEOMETRY_SUFFIXES
from .saving import WRITABLE_SUFFIXES as WRITABLE_SUFFIXES
from .saving import MeshWarning as MeshWarning
from .saving import Storable as Storable
from .saving import holds_data as holds_data
from .saving import require_writable_format as require_writable_format
from .saving import save as save
from .scalars import Scalar as Scalar
from .scalars import array_names as array_names
from .scalars import array_of as array_of
from .scalars import missing_note as missing_note
from .scalars import scalar_of as scalar_of

__all__ = [
    "FIELD_ARRAYS",
    "GEOMETRY_SUFFIXES",
    "HARMONICS",
    "WRITABLE_SUFFIXES",
    "Defects",
    "Flat",
    "MeshData",
    "MeshWarning",
    "Scalar",
    "Storable",
    "array_names",
    "array_of",
    "holds_data",
    "is_mesh_archive",
    "load",
    "load_data",
    "load_mesh",
    "load_with_optional_field",
    "missing_note",
    "require_writable_format",
    "save",
    "scalar_of",
]
