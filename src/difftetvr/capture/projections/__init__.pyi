from . import coverage as coverage
from . import descriptions as descriptions
from . import geometry as geometry
from . import intensities as intensities
from . import noise as noise
from . import projection_capture as projection_capture
from . import projector as projector
from . import projector_kernel as projector_kernel
from . import raw_scan as raw_scan
from . import readers as readers
from . import scan_file as scan_file
from .geometry import ProjectionGeometry as ProjectionGeometry
from .naming import is_projection_source as is_projection_source
from .noise import Noise as Noise
from .projection_capture import ProjectionCapture as ProjectionCapture
from .projector import project_volume as project_volume

__all__ = ["Noise", "ProjectionCapture", "ProjectionGeometry", "is_projection_source", "project_volume"]
