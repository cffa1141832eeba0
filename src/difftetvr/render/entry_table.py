"""Faces that can start a walk, and how the entry kernels read them (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import torch

from difftetvr.backend import Backend
from difftetvr.mesh import TetMesh
from difftetvr.mesh.topology import LOCAL_FACES
from difftetvr.render.camera import Camera
from difftetvr.render.rays import Pinhole
from difftetvr.render.walk import Corner, Face, make_face


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
class EntryScene:
    """What the entry kernels read: a view and a table of faces, as flat Dr.Jit arrays."""

    backend: Backend
    camera: Camera
    pinhole: Pinhole
    vertices: Any
    corners: Any
    cells: Any
    apices: Any

    def corner(self, frame: Any, vertex: Any, mask: Any = True) -> Corner:
        """A vertex as a ray sees it."""
        x, y, z = (dr.gather(self.backend.Float, self.vertices, 3 * vertex + k, mask) for k in range(3))
        a, b, t = frame.project(x, y, z)
        return Corner(vertex, a, b, [t], [])

    def face(self, frame: Any, row: Any, mask: Any = True) -> Face:
        """The face of a row as a ray sees it."""
        vertices = [dr.gather(self.backend.UInt, self.corners, 3 * row + k, mask) for k in range(3)]
        return make_face([self.corner(frame, vertex, mask) for vertex in vertices])

    @property
    def no_row(self) -> Any:
        """A number that stands for no row: that of all rows."""
        return self.backend.opaque_uint(dr.width(self.cells))

    @property
    def pixel_count(self) -> int:
        """Number of pixels of the view."""
        return self.camera.width * self.camera.height
