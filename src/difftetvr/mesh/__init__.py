"""What a tetrahedral mesh is: positions, cells, topology, quality, the field on it, and how its cells change."""

from difftetvr.mesh.bisection import bisect_edges, independent_edges, long_edges
from difftetvr.mesh.change import MeshChange
from difftetvr.mesh.collapse import collapse_edges
from difftetvr.mesh.field import Field
from difftetvr.mesh.flip_search import find_flips
from difftetvr.mesh.flips import Flips, apply_flips, independent_flips
from difftetvr.mesh.insertion import DelaunayInsertion, insert_delaunay
from difftetvr.mesh.removal import remove_cells
from difftetvr.mesh.star import star_subdivision
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology import Topology

__all__ = [
    "DelaunayInsertion",
    "Field",
    "Flips",
    "MeshChange",
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
