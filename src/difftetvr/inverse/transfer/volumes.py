"""Volumes as scalars on tetrahedra."""

from __future__ import annotations

import numpy as np
import torch

from difftetvr.capture.volumes.volume import Volume
from difftetvr.errors import CaptureError, shown
from difftetvr.inputs import as_whole, require_type
from difftetvr.mesh.tetmesh import TetMesh

_TETS_PER_CUBE = 6


def volume_on_grid(volume: Volume, cells: int = 200_000) -> tuple[TetMesh, torch.Tensor]:
    """A volume's scalars at the vertices of a grid of tetrahedra over its box.

    Values between samples are trilinear. Where the grid is coarser than the volume, what lies between its vertices is
    lost: images of the one are not those of the other.

    Args:
        volume: The volume.
        cells: How many tetrahedra there may be, >= 6; no more are made than six for each cube of samples.

    Returns:
        The mesh, and (V,) float32 scalars.

    Raises:
        CaptureError: The number of cells is out of range.
    """
    require_type(volume, Volume, "volume", "pass a difftetvr.Volume", CaptureError)
    budget = as_whole(cells, "The number of cells", CaptureError)
    if budget < _TETS_PER_CUBE:
        raise CaptureError(f"The number of cells is {shown(cells)}; it must be at least {_TETS_PER_CUBE}.")
    lower, upper = volume.bounds.double()
    extent = (upper - lower).numpy()
    most = np.array(volume.resolution) - 1
    edge = float((np.prod(extent) * _TETS_PER_CUBE / budget) ** (1.0 / 3.0))
    counts = np.clip(np.floor(extent / edge).astype(int), 1, most)
    mesh = TetMesh.grid(tuple(counts.tolist()), tuple(lower.tolist()), tuple(upper.tolist()))
    places = 2.0 * (mesh.vertices.double() - lower) / (upper - lower) - 1.0
    values = torch.nn.functional.grid_sample(
        torch.from_numpy(volume.values)[None, None],
        places.float().clamp(-1.0, 1.0)[None, None, None],
        align_corners=True,
    )
    return mesh, values.flatten()
