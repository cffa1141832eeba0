from . import arrays as arrays
from . import boundary as boundary
from . import changes as changes
from . import field as field
from . import harmonics as harmonics
from . import io as io
from . import limits as limits
from . import locate as locate
from . import making as making
from . import motion as motion
from . import quality as quality
from . import shapes as shapes
from . import tetmesh as tetmesh
from . import topology as topology
from . import validation as validation
from .changes.bisection import bisect_edges as bisect_edges
from .changes.bisection import independent_edges as independent_edges
from .changes.bisection import long_edges as long_edges
from .changes.change import MeshChange as MeshChange
from .changes.collapse import collapse_edges as collapse_edges
from .changes.flip_search import find_flips as find_flips
from .changes.flips import Flips as Flips
from .changes.flips import apply_flips as apply_flips
from .changes.flips import independent_flips as independent_flips
from .changes.insertion import DelaunayInsertion as DelaunayInsertion
from .changes.insertion import insert_delaunay as insert_delaunay
from .changes.removal import remove_cells as remove_cells
from .changes.star import star_subdivision as star_subdivision
from .field import Field as Field
from .limits import MotionLimits as MotionLimits
from .tetmesh import TetMesh as TetMesh
from .topology.topology import Topology as Topology

__all__ = [
    "DelaunayInsertion",
    "Field",
    "Flips",
    "MeshChange",
    "MotionLimits",
    "TetMesh",
    "Topology",
    "apply_flips",
    "bisect_edges",
    "collapse_edges",
    "find_flips",
    "independent_edges",
    "independent_flips",
    "insert_delaunay",
    "long_edges",
    "remove_cells",
    "star_subdivision",
]
