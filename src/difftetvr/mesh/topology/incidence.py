"""Which edges a cell has and which cells a vertex has, as tables for code that changes meshes."""

from __future__ import annotations

import torch

from difftetvr.errors import MeshError
from difftetvr.mesh.topology.lookup import EdgeRows, edges_of_cells, faces_of_cells, places_of_edges
from difftetvr.mesh.topology.topology import Topology


def cell_edges(topology: Topology) -> torch.Tensor:
    """The six edges of each cell; built once and kept with the topology.

    Args:
        topology: The cells.

    Returns:
        (T, 6) int32 indices into `topology.edges`, in the order of `LOCAL_EDGES`.
    """
    return topology.cached(
        "incidence.cell_edges", lambda: edges_of_cells(_edge_rows(topology), corner_columns(topology))
    )


def corner_columns(topology: Topology) -> torch.Tensor:
    """The cells' vertex indices corner by corner, (4, T) int32 contiguous; built once and kept with the topology."""
    return topology.cached("incidence.corner_columns", lambda: topology.tets.t().contiguous())


def cells_per_edge(topology: Topology) -> torch.Tensor:
    """How many cells are around each edge; built once and kept with the topology.

    Args:
        topology: The cells.

    Returns:
        (E,) int64, for each of `topology.edges`.
    """
    count = topology.edges.shape[0]
    return topology.cached(
        "incidence.cells_per_edge", lambda: torch.bincount(cell_edges(topology).view(-1), minlength=count)
    )


def cell_faces(topology: Topology) -> torch.Tensor:
    """The four faces of each cell; built once and kept with the topology.

    Args:
        topology: The cells.

    Returns:
        (T, 4) int32 indices into `topology.faces`, of the face opposite local vertex k.
    """
    return topology.cached("incidence.cell_faces", lambda: faces_of_cells(topology.cell_adjacency))


def find_edges(topology: Topology, ends: torch.Tensor) -> torch.Tensor:
    """Look edges up by their ends.

    Args:
        topology: The cells.
        ends: (N, 2) int64 vertex indices in range, in either order.

    Returns:
        (N,) int64 indices into `topology.edges`, -1 where two vertices share no edge.
    """
    if not ends.shape[0]:
        return ends[:, 0].long()
    return places_of_edges(_edge_rows(topology), *ends.unbind(1)).long()


def known_edges(topology: Topology, edges: torch.Tensor) -> torch.Tensor:
    """Look edges up that a caller says are there.

    Args:
        topology: The cells.
        edges: (N, 2) int64 vertex indices in range, in either order.

    Returns:
        (N,) int64 indices into `topology.edges`.

    Raises:
        MeshError: Names the first pair of vertices that share no edge.
    """
    found = find_edges(topology, edges)
    if (found < 0).any():
        one, other = edges[found < 0][0].tolist()
        raise MeshError(f"The vertices {one} and {other} share no edge; pass pairs that are edges of the mesh.")
    return found


def boundary_vertices(topology: Topology) -> torch.Tensor:
    """Which vertices lie on faces of one cell only; found once and kept with the topology.

    Args:
        topology: The cells.

    Returns:
        (V,) bool.
    """
    return topology.cached("incidence.boundary_vertices", lambda: _find_boundary_vertices(topology))


def shell(topology: Topology) -> Topology:
    """The boundary faces as cells, each with a vertex outside as its last; built once and kept with the topology.

    Together with the cells themselves they close the mesh, and they have tables of what is around a vertex.

    Args:
        topology: The cells.

    Returns:
        One cell per boundary face, in their order; the vertex outside has the number V.
    """
    return topology.cached("incidence.shell", lambda: _build_shell(topology))


def stars(topology: Topology, vertices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The cells around vertices, in one list.

    Args:
        topology: The cells.
        vertices: (N,) int64 vertex indices; repetitions allowed.

    Returns:
        owner (M,) int64 ascending, the row of `vertices`, and cells (M,) int64, a cell around that vertex.
    """
    offsets, cells = topology.vertex_cells
    starts = offsets.index_select(0, vertices).long()
    counts = offsets.index_select(0, vertices + 1) - starts
    owner = torch.repeat_interleave(counts)
    # Position within the own star = position in the list - where the own star begins in the list.
    shift = starts - (counts.cumsum(0) - counts)
    places = shift.index_select(0, owner).add_(torch.arange(owner.shape[0], device=owner.device))
    return owner, cells.index_select(0, places).long()


def _find_boundary_vertices(topology: Topology) -> torch.Tensor:
    mask = torch.zeros(topology.num_vertices, dtype=torch.bool, device=topology.tets.device)
    mask[topology.boundary_faces.view(-1).long()] = True
    return mask


def _build_shell(topology: Topology) -> Topology:
    faces = torch.nn.functional.pad(topology.boundary_faces, (0, 1), value=topology.num_vertices)
    return Topology(faces, topology.num_vertices + 1)


def _edge_rows(topology: Topology) -> EdgeRows:
    return topology.cached("incidence.edge_rows", lambda: _build_edge_rows(topology))


def _build_edge_rows(topology: Topology) -> EdgeRows:
    lower, higher = topology.edges.unbind(1)
    counts = torch.bincount(lower, minlength=topology.num_vertices)
    return EdgeRows(torch.nn.functional.pad(counts.cumsum(0), (1, 0)).int(), higher.contiguous())
