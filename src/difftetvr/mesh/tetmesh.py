"""The tetrahedral mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from difftetvr.errors import MeshError, shown
from difftetvr.inputs import moved
from difftetvr.mesh import quality, validation
from difftetvr.mesh.arrays import true_indices
from difftetvr.mesh.frame import WORLD, Origin, origin_for, reoriented
from difftetvr.mesh.topology.topology import Topology


class TetMesh:
    """A valid, conforming, positively oriented tetrahedral mesh.

    Valid means: all positions finite, no cell flat, at most two cells at a face, neighbours on opposite sides of their
    common face. Holes, several components and vertices that no cell uses are allowed. Loose cells are the exception:
    they may overlap, hang and share faces as they like, and whatever asks for their neighbours raises `MeshError`.

    Attributes:
        vertices: (V, 3) float32 or float64 positions relative to ``origin``; may require grad.
        tets: (T, 4) int32 vertex indices, det(v1 - v0, v2 - v0, v3 - v0) > 0. Read-only: kernels trust it.
        topology: Adjacency and incidence tables, shared by all meshes made by `with_vertices`.
        origin: Point of world space that vertices are relative to; (0, 0, 0) but for float32 meshes that lie so far
            from it that single precision would not resolve them. Cameras, clip planes, `bounds`, `positions` and files
            speak of world space.
    """

    vertices: torch.Tensor
    tets: torch.Tensor
    topology: Topology
    origin: Origin

    def __init__(self, vertices: Any, tets: Any, *, conforming: bool = True, origin: Origin = WORLD) -> None:
        """Build a mesh from arrays, check it, and orient its cells.

        Cells of negative volume get their last two vertices swapped; their order and all else stays. A volume counts as
        zero only if it is exactly zero for the positions as stored, so thin cells pass and the unit of length is free.

        Args:
            vertices: (V, 3) positions, array-like. A float32 or float64 tensor is kept as it is, autograd graph
                included; lists and other dtypes become float32.
            tets: (T, 4) integer vertex indices, array-like; copied.
            conforming: False for loose cells, whose faces are not matched and not checked.
            origin: Point of world space that the vertices are relative to.

        Raises:
            MeshError: Names the first offending cell: index out of range, vertex not finite, repeated vertex, zero
                volume, face shared by three cells, overlap with a neighbour (the last two not for loose cells). Also
                for wrong shapes and dtypes.
        """
        points = validation.as_vertices(vertices, unrounded=True)
        cells = validation.as_tets(tets, points.shape[0], points.device)
        validation.check_finite(points, cells)
        signs = validation.orientations(points, cells)
        validation.check_not_flat(points, cells, signs)
        _orient(cells, signs)
        topology = Topology(cells, points.shape[0], is_conforming=conforming)
        if conforming:
            topology.cell_adjacency  # noqa: B018  pairs all faces, and so finds every one that cannot be
        self._assign(points, topology, origin)
        if not validation.is_stored_in_floats(vertices):
            single = self.to(dtype=torch.float32)
            self._assign(single.vertices, single.topology, single.origin)

    @classmethod
    def from_valid(cls, vertices: torch.Tensor, topology: Topology, origin: Origin = WORLD) -> TetMesh:
        """Wrap what is known to make a valid mesh, unchecked: for code that changes meshes and keeps them valid.

        Kernels gather unchecked, so an index out of range here reads foreign memory.

        Args:
            vertices: (V, 3) float32 or float64 positions.
            topology: Topology of positively oriented cells on the device of the vertices.
            origin: Point of world space that the vertices are relative to.

        Returns:
            The mesh.
        """
        mesh = cls.__new__(cls)
        mesh._assign(vertices, topology, origin)
        return mesh

    @classmethod
    def grid(
        cls,
        shape: Sequence[int],
        lower: Sequence[float] = (0.0, 0.0, 0.0),
        upper: Sequence[float] = (1.0, 1.0, 1.0),
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> TetMesh:
        """A box of nx * ny * nz cubes with six tetrahedra each (Kuhn's subdivision, conforming).

        Args:
            shape: Numbers of cubes (nx, ny, nz); the mesh has (nx + 1)(ny + 1)(nz + 1) vertices, x running fastest.
            lower: Lowest corner of the box.
            upper: Highest corner of the box.
            dtype: torch.float32 or torch.float64.
            device: Where the mesh shall lie; None is torch's default.

        Returns:
            The mesh; valid by construction.

        Raises:
            MeshError: A size is no positive integer, the box is empty or not finite, or the grid too large or too fine.
        """
        from difftetvr.mesh.making import generators  # late: that room is built on this class

        vertices, tets = generators.grid(shape, lower, upper, dtype, device)
        return cls.from_valid(vertices, Topology(tets, vertices.shape[0]))

    @classmethod
    def delaunay(cls, points: Any) -> TetMesh:
        """The Delaunay mesh of the convex hull of points.

        Flat cells are dropped from the hull only, never from the interior; ties between cospherical points are broken
        such that neither flat cells nor mismatched faces remain (see `difftetvr.mesh.making.delaunay`).

        Args:
            points: (V, 3) positions, array-like; kept as the vertices, in order and with their autograd graph.

        Returns:
            The mesh. Duplicate points become unused vertices.

        Raises:
            MeshError: Fewer than four points, points not finite or in one plane, or no valid mesh was found.
        """
        from difftetvr.mesh.making.delaunay import delaunay

        vertices, tets = delaunay(points)
        return cls.from_valid(vertices, Topology(tets, vertices.shape[0]))

    @property
    def num_vertices(self) -> int:
        """Number of vertices V, unused ones included."""
        return self.vertices.shape[0]

    @property
    def num_cells(self) -> int:
        """Number of cells T."""
        return self.tets.shape[0]

    @property
    def is_conforming(self) -> bool:
        """Whether cells meet face to face; False for loose cells, which have no neighbours."""
        return self.topology.is_conforming

    def with_vertices(self, vertices: torch.Tensor) -> TetMesh:
        """The same cells at other positions; costs nothing and checks nothing but the shape (see `validate`).

        Args:
            vertices: (V, 3) float32 or float64 on the mesh's device, relative to its origin; may require grad.

        Returns:
            A mesh that shares this one's topology.

        Raises:
            MeshError: Shape, dtype or device are not those of a mesh with this topology.
        """
        if vertices.shape != self.vertices.shape or vertices.device != self.vertices.device:
            raise MeshError(
                f"The new vertices have shape {tuple(vertices.shape)} on {vertices.device}; this mesh needs "
                f"{tuple(self.vertices.shape)} on {self.vertices.device}."
            )
        if vertices.dtype not in (torch.float32, torch.float64):
            raise MeshError(f"The new vertices are {vertices.dtype}; pass float32 or float64.")
        return TetMesh.from_valid(vertices, self.topology, self.origin)

    @property
    def positions(self) -> torch.Tensor:
        """(V, 3) float64 positions of the vertices in world space; differentiable."""
        return reoriented(self.vertices, self.origin, WORLD, torch.float64)

    def with_origin(self, origin: Origin | None = None) -> TetMesh:
        """The same mesh with vertices relative to another point, rounded to their precision.

        Args:
            origin: Point of world space; None chooses one near the mesh if it is float32 and lies more than 16 of its
                longest sides from where its vertices are counted from, and else leaves the mesh as it is.

        Raises:
            MeshError: Rounding flattened or inverted a cell.
        """
        if origin is None:
            if self.vertices.dtype != torch.float32:
                return self
            nearer = origin_for(self.vertices)
            x, y, z = (a + b for a, b in zip(self.origin, nearer, strict=True))
            origin = (x, y, z)
        if origin == self.origin:
            return self
        vertices = reoriented(self.vertices, self.origin, origin, self.vertices.dtype)
        mesh = TetMesh.from_valid(vertices, self.topology, origin)
        mesh.validate()
        return mesh

    def validate(self) -> None:
        """Check the current positions: all finite, all cells positive.

        Raises:
            MeshError: Names the first cell that `with_vertices` made flat, inverted or not finite.
        """
        validation.check_positive(self.vertices, self.tets)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> TetMesh:
        """The same mesh on another device or in another precision.

        Args:
            device: Target device, or None to stay.
            dtype: torch.float32 or torch.float64, or None to stay.

        Returns:
            This mesh where nothing changes; else one whose vertices autograd sees as a function of these.

        Raises:
            MeshError: dtype is no such dtype, this machine has no such device, or rounding to float32 flattened or
                inverted a cell. A mesh far from its origin gets a nearer one first, see `with_origin`.
        """
        if not any(dtype is known for known in (None, torch.float32, torch.float64)):
            raise MeshError(f"A mesh cannot have {shown(dtype)} vertices; use torch.float32 or torch.float64.")
        rounds = dtype == torch.float32 and self.vertices.dtype == torch.float64
        nearer = origin_for(self.vertices) if rounds else WORLD
        near = self.vertices if nearer == WORLD else reoriented(self.vertices, WORLD, nearer, torch.float64)
        vertices = moved(near, device, dtype, MeshError)
        if vertices is self.vertices:
            return self
        x, y, z = (a + b for a, b in zip(self.origin, nearer, strict=True))
        mesh = TetMesh.from_valid(vertices, self.topology.to(vertices.device), (x, y, z))
        if rounds:
            mesh.validate()
        return mesh

    def without_unused_vertices(self) -> tuple[TetMesh, torch.Tensor]:
        """Drop the vertices that no cell uses.

        Returns:
            The mesh with the remaining vertices in their old order (this mesh where all are used), and their old
            indices, (V',) int64, with which per-vertex values are picked: `color[kept]`.
        """
        used = torch.zeros(self.num_vertices, dtype=torch.bool, device=self.tets.device)
        used[self.tets.reshape(-1)] = True
        kept = true_indices(used)
        if kept.numel() == self.num_vertices:
            return self, kept
        renumbered = used.cumsum(0, dtype=torch.int32) - 1
        adjacency = self.topology.cell_adjacency if self.is_conforming else None
        topology = Topology(renumbered[self.tets], kept.numel(), adjacency, is_conforming=self.is_conforming)
        return TetMesh.from_valid(self.vertices[kept], topology, self.origin), kept

    def volumes(self) -> torch.Tensor:
        """(T,) volumes of the cells in cubed units of length; differentiable."""
        return quality.volumes(self.vertices, self.tets)

    def altitudes(self) -> torch.Tensor:
        """(T, 4) distance of local vertex k from the opposite face; differentiable."""
        return quality.altitudes(self.vertices, self.tets)

    def vertex_altitudes(self) -> torch.Tensor:
        """(V,) smallest altitude of all cells around each vertex, infinity where unused; differentiable."""
        return quality.vertex_altitudes(self.vertices, self.tets)

    def quality(self) -> torch.Tensor:
        """(T,) Q = 6 sqrt(2) V / l_rms^3 of each cell: 1 for the regular tetrahedron, towards 0 as it flattens."""
        return quality.quality(self.vertices, self.tets)

    def bounds(self) -> torch.Tensor:
        """(2, 3) lowest and highest coordinates of the vertices in world space, detached.

        In the precision of the vertices, but float64 for a mesh with an origin of its own.
        """
        vertices = self.vertices.detach()
        bounds = torch.stack((vertices.amin(0), vertices.amax(0)))
        return bounds if self.origin == WORLD else reoriented(bounds, self.origin, WORLD, torch.float64)

    def __repr__(self) -> str:
        """Sizes, precision and device."""
        sizes = f"{self.num_vertices} vertices, {self.num_cells} cells"
        return f"TetMesh({sizes}, {self.vertices.dtype}, {self.vertices.device})"

    def _assign(self, vertices: torch.Tensor, topology: Topology, origin: Origin) -> None:
        self.vertices = vertices
        self.origin = origin
        self.tets = topology.tets
        self.topology = topology


def _orient(tets: torch.Tensor, signs: torch.Tensor) -> None:
    """Swap the last two vertices of negative cells, in place."""
    negative = true_indices(signs < 0)
    if negative.numel():
        tets[negative] = tets[negative][:, [0, 1, 3, 2]]
