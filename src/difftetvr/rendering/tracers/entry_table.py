"""Faces that can start a walk, and how the entry kernels read them (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology.topology import LOCAL_FACES
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.rendering.traversal.rays import CameraRays
from difftetvr.rendering.traversal.walk import Corner, Face, make_face


@dataclass
class EntryTable:
    """Faces that can start a walk: (R, 3) corners wound to hold entering rays, (R,) cells behind and (R,) apices."""

    corners: torch.Tensor
    cells: torch.Tensor
    apices: torch.Tensor

    def joined(self, other: EntryTable) -> EntryTable:
        """The rows of this table, then those of another."""
        return EntryTable(*(torch.cat([getattr(t, n) for t in (self, other)]) for n in ("corners", "cells", "apices")))

    @staticmethod
    def boundary(mesh: TetMesh) -> EntryTable:
        """Table of the mesh's boundary faces."""

        def build() -> EntryTable:
            topology = mesh.topology
            # Counter-clockwise from outside is clockwise in the ray's plane: a, b, direction are right-handed.
            corners = topology.boundary_faces[:, [0, 2, 1]].contiguous()
            cells = topology.boundary_cells.contiguous()
            apices = (mesh.tets[cells.long()].sum(dim=1) - corners.sum(dim=1)).to(torch.int32)
            return EntryTable(corners, cells, apices)

        return mesh.topology.cached("entry_table", build)

    @staticmethod
    def of_cells(mesh: TetMesh, cells: torch.Tensor) -> EntryTable:
        """Table of all faces of some cells, seen from outside them."""
        tets = mesh.tets[cells.long()]
        corners = torch.cat([tets[:, [face[0], face[2], face[1]]] for face in LOCAL_FACES])
        apices = torch.cat([tets[:, k] for k in range(4)])
        return EntryTable(corners.contiguous(), cells.to(torch.int32).repeat(4), apices.contiguous())


@dataclass
class FaceScene:
    """Faces of a mesh in camera space, wound to hold the rays that enter through them, as kernels read them."""

    backend: Backend
    camera: Camera
    rays: CameraRays
    vertices: Any

    def indices(self, row: Any, mask: Any = True) -> list[Any]:
        """The three vertices of a row's face."""
        raise NotImplementedError

    def point(self, vertex: Any, mask: Any = True) -> list[Any]:
        """Position of a vertex in camera space."""
        return [dr.gather(self.backend.Float, self.vertices, 3 * vertex + axis, mask) for axis in range(3)]

    def corner(self, frame: Any, vertex: Any, mask: Any = True) -> Corner:
        """A vertex as a ray sees it."""
        a, b, t = frame.project(*self.point(vertex, mask))
        return Corner(vertex, a, b, [t], [])

    def face(self, frame: Any, row: Any, mask: Any = True) -> Face:
        """The face of a row as a ray sees it."""
        return make_face([self.corner(frame, vertex, mask) for vertex in self.indices(row, mask)])

    @property
    def pixel_count(self) -> int:
        """Number of pixels of the view."""
        return self.camera.width * self.camera.height


@dataclass
class EntryScene(FaceScene):
    """The faces of an entry table: flat (R, 3) corners, (R,) cells and apices."""

    corners: Any
    cells: Any
    apices: Any

    def indices(self, row: Any, mask: Any = True) -> list[Any]:
        """See :meth:`FaceScene.indices`."""
        return [dr.gather(self.backend.UInt, self.corners, 3 * row + k, mask) for k in range(3)]

    @property
    def no_row(self) -> Any:
        """A number that stands for no row: that of all rows."""
        return self.backend.opaque_uint(dr.width(self.cells))


@dataclass
class HalfFaceScene(FaceScene):
    """The four faces of every cell of flat (T, 4) tets, seen from outside it: row 4 c + k is opposite its vertex k."""

    tets: Any

    @staticmethod
    def of(backend: Backend, camera: Camera, mesh: TetMesh, vertices: torch.Tensor) -> HalfFaceScene:
        """Upload a mesh with (V, 3) vertices in camera space."""
        points, tets = backend.floats(vertices), backend.uints(mesh.tets)
        return HalfFaceScene(backend, camera, camera.kernel_rays(backend), points, tets)

    def indices(self, row: Any, mask: Any = True) -> list[Any]:
        """See :meth:`FaceScene.indices`."""
        return self.indices_and_apex(row, mask)[:3]

    def indices_and_apex(self, row: Any, mask: Any = True) -> list[Any]:
        """The three vertices of a row's face, and its cell's fourth."""
        tet = dr.gather(self.backend.UInt4, self.tets, row >> 2, mask)
        local = row & 3

        def pick(choices: list[int]) -> Any:
            last = tet[choices[3]]
            for k in (2, 1, 0):
                last = dr.select(local == k, tet[choices[k]], last)
            return last

        return [pick([face[j] for face in LOCAL_FACES]) for j in (0, 2, 1)] + [pick([0, 1, 2, 3])]
