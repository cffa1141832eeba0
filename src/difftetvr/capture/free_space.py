"""Space in front of the cameras that must be empty, because they see the scene through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from difftetvr.capture.viewing import Floats, cell_centers, in_image, positions_of, project
from difftetvr.errors import CaptureError
from difftetvr.mesh.arrays import chunks, true_indices
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering.cameras.pinhole import Camera

_NEAREST = 1.0  # percent of the points in a cone: fewer that are nearer are matched wrongly
_LOOKED_AT = 16  # cubes along each side of the box, to find out whether a camera looks at it
_BESIDE = 0.5  # of the image's longer side, to all sides: other views look through what is next to a view


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """Space that is known to be empty: in front of each camera, in a cone that is wider than its view.

    Photographs that are few say little about what is near their cameras, where hardly two of them see the same place:
    whatever fog a reconstruction puts there for the sake of one of them hides the scene from all other directions. But
    whoever takes photographs of a scene sees to it that nothing is in between.

    Attributes:
        cameras: The cameras.
        reaches: How far from each nothing is, in world units.
    """

    cameras: list[Camera]
    reaches: list[float]

    @staticmethod
    def of(cameras: Sequence[Camera], bounds: torch.Tensor, points: torch.Tensor | None, share: float) -> FreeSpace:
        """A share of the way to what is nearest, be it the scene's box or the points in the cone.

        Args:
            cameras: N cameras; nothing is free before those within the bounds, or whose cone misses them.
            bounds: (2, 3) corners of the scene's box.
            points: (P, 3) points on surfaces, or None. The nearest hundredth of those in a cone does not count.
            share: Share of the way, in [0, 1).

        Raises:
            CaptureError: The share is out of range.
        """
        if not 0.0 <= share < 1.0:
            raise CaptureError(f"The share of free space is {share}; it must be at least 0 and below 1.")
        box, places = bounds.double().numpy(), None if points is None else points.double().numpy()
        looked_at = cell_centers(box, _LOOKED_AT)
        nearest = [_nearest(camera, box, looked_at, places) for camera in cameras] if share else []
        free = [(camera, share * distance) for camera, distance in zip(cameras, nearest) if distance > 0.0]
        return FreeSpace([camera for camera, _ in free], [reach for _, reach in free])

    def contains(self, places: torch.Tensor) -> torch.Tensor:
        """(N,) bool, which of (N, 3) places are empty."""
        found = torch.zeros(len(places), dtype=torch.bool, device=places.device)
        for camera, reach in zip(self.cameras, self.reaches, strict=True):
            # Most places are far from most cameras.
            away = torch.linalg.vector_norm(places - camera.position.to(places), dim=1)
            near = true_indices((away < reach) & ~found)
            found[near] = in_image(*camera.project(places[near]), camera, _margin(camera))
        return found

    def vertices_of(self, mesh: TetMesh) -> torch.Tensor:
        """(V,) bool, which vertices of a mesh are in it, or belong to a cell whose centre is.

        Cells are coarse around cameras, wider than a cone is at its tip: what a vertex beside it holds would reach in.
        """
        positions = mesh.vertices.detach()
        found = self.contains(positions)
        if not self.cameras:
            return found
        for part in chunks(mesh.num_cells, positions.device, width=12):
            corners = mesh.tets[part].long()
            within = true_indices(self.contains(positions[corners].mean(1)))
            found[corners[within].view(-1)] = True
        return found


def _nearest(camera: Camera, box: Floats, looked_at: Floats, points: Floats | None) -> float:
    """Distance from the scene's box, or the nearest points in the cone; 0 for cameras within the box or looking off."""
    position = positions_of([camera])[0]
    if not in_image(*project(looked_at, camera), camera, _margin(camera)).any():
        return 0.0
    distance = float(np.linalg.norm(position - position.clip(*box)))
    if points is not None:
        before = points[in_image(*project(points, camera), camera, _margin(camera))]
        if len(before):
            # An interpolated one would pass over near points where there are few.
            nearest = np.percentile(np.linalg.norm(before - position, axis=1), _NEAREST, method="lower")
            distance = min(distance, float(nearest))
    return distance


def _margin(camera: Camera) -> float:
    """Pixels by which a cone is wider than the view, to all sides."""
    return _BESIDE * max(camera.width, camera.height)
