"""What a tetrahedral mesh is: positions, cells, topology, quality, and the field on it."""

from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.mesh.topology import Topology

__all__ = ["Field", "TetMesh", "Topology"]
