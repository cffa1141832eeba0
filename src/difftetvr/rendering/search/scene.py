"""Half-faces of a mesh as kernels that look for crossings read them (Dr.Jit).

Half-face 4 c + k is the face of cell c that is opposite its vertex k, seen from outside the cell: it stands for the
crossings that enter the cell there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh.topology.topology import LOCAL_FACES, Topology
from difftetvr.rendering.traversal.rays import Frame, ImageRays, KernelRays, edge_function, is_left
from difftetvr.rendering.traversal.walk import Corner, Face, make_face


@dataclass(frozen=True)
class Cells:
    """The cells of a mesh.

    Attributes:
        backend: Array types.
        vertices: Flat (V, 4 ``stride``) records, which begin with x, y and z.
        tets: Flat (T, 4) cells.
        stride: Packets of four floats a record.
    """

    backend: Backend
    vertices: Any
    tets: Any
    stride: int

    def point(self, vertex: Any, mask: Any = True) -> list[Any]:
        """Position of a vertex."""
        record = dr.gather(self.backend.Float4, self.vertices, self.stride * vertex, mask)
        return [record[0], record[1], record[2]]

    def cell(self, cell: Any, mask: Any = True) -> Any:
        """The four vertices of a cell."""
        return dr.gather(self.backend.UInt4, self.tets, cell, mask)


@dataclass(frozen=True)
class Scene(Cells):
    """The cells of a mesh in the space of some rays that may cross them.

    Attributes:
        rays: The rays.
    """

    rays: KernelRays

    @property
    def image(self) -> ImageRays:
        """The rays, where they are a camera's."""
        return cast("ImageRays", self.rays)

    def corner(self, frame: Frame, vertex: Any, mask: Any = True) -> Corner:
        """A vertex as a ray sees it."""
        a, b, t = frame.project(*self.point(vertex, mask))
        return Corner(vertex, a, b, [t], [])

    def indices_and_apex(self, half_face: Any, mask: Any = True) -> list[Any]:
        """The three vertices of a half-face, counter-clockwise for a ray that enters, and its cell's fourth."""
        tet, local = self.cell(half_face >> 2, mask), half_face & 3

        def pick(choices: list[int]) -> Any:
            last = tet[choices[3]]
            for k in (2, 1, 0):
                last = dr.select(local == k, tet[choices[k]], last)
            return last

        # Counter-clockwise from outside is clockwise in the ray's plane: a, b, direction are right-handed.
        return [pick([face[j] for face in LOCAL_FACES]) for j in (0, 2, 1)] + [pick([0, 1, 2, 3])]

    def face_and_apex(self, frame: Frame, half_face: Any, mask: Any = True) -> tuple[Face, Corner]:
        """A half-face and the fourth vertex of its cell, as a ray sees them."""
        *corners, apex = (self.corner(frame, vertex, mask) for vertex in self.indices_and_apex(half_face, mask))
        return make_face(corners), apex

    def entered(self, frame: Frame, cell: Any, mask: Any = True) -> tuple[Any, Any]:
        """Whether a ray's line crosses a cell, and the half-face through which it enters."""
        tet = self.cell(cell, mask)
        points = [frame.project(*self.point(tet[k], mask)) for k in range(4)]
        left: dict[tuple[int, int], Any] = {}
        for i in range(4):
            for j in range(i + 1, 4):
                (pa, pb, _), (qa, qb, _) = points[i], points[j]
                left[i, j] = is_left(edge_function(pa, pb, qa, qb), pa, pb, qa, qb)
                left[j, i] = ~left[i, j]
        is_hit, local = None, self.backend.UInt(0)
        for k, (i, j, m) in enumerate(LOCAL_FACES):
            holds = left[i, m] & left[m, j] & left[j, i]
            is_hit = holds if is_hit is None else is_hit | holds
            local = dr.select(holds, self.backend.UInt(k), local)
        return is_hit & mask, 4 * cell + local


def boundary_half_faces(topology: Topology) -> torch.Tensor:
    """(B,) int32 half-faces on the boundary of a mesh."""

    def build() -> torch.Tensor:
        return torch.nonzero(topology.cell_adjacency.reshape(-1) < 0).flatten().to(torch.int32)

    return topology.cached("boundary_half_faces", build)
