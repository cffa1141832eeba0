"""What readers find in files of projections, before it is checked and becomes line integrals."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.projections.geometry import ProjectionGeometry
from difftetvr.declared import require_declared
from difftetvr.errors import CaptureError, MeshError, shown
from difftetvr.trust import require_free

_COPIES = 4  # as stored, as float32, in double precision while logarithms are taken


@dataclass(frozen=True)
class ScanOptions:
    """What files do not tell.

    Attributes:
        geometry: File with the geometry of a ``.npy``; None for the ``.json`` of the same name beside it.
        center: Where the axis is seen in a row of a Data Exchange file, in pixels from the left edge of the first one;
            None for the middle.
        pixel_size: Distance of pixels of a Data Exchange file; None for 1.
        unit: Of that distance; None if it is not known.
        gaussian: Standard deviation of the electronics' noise in counts, for variances of intensities.
    """

    geometry: str | None = None
    center: float | None = None
    pixel_size: float | None = None
    unit: str | None = None
    gaussian: float = 0.0

    def __post_init__(self) -> None:
        require_declared(self, CaptureError)
        if self.center is not None and not np.isfinite(self.center):
            raise CaptureError(f"The center is {shown(self.center)}; give a place in pixels.")
        if self.pixel_size is not None and not (np.isfinite(self.pixel_size) and self.pixel_size > 0):
            raise CaptureError(f"The pixel_size is {shown(self.pixel_size)}; give a number greater than 0.")
        if not (np.isfinite(self.gaussian) and self.gaussian >= 0):
            raise CaptureError(f"The gaussian is {shown(self.gaussian)}; give counts of at least 0.")

    def refuse_others(self, path: Path, *used: str) -> None:
        """Refuses options that are given and that a reader does not use.

        Raises:
            CaptureError: There is one.
        """
        for name, usual in vars(ScanOptions()).items():
            if name not in used and getattr(self, name) != usual:
                raise CaptureError(f"'{path}' says itself what {name} is for, or has no use for it; leave out {name}.")


@dataclass(frozen=True, eq=False)
class RawScan:
    """Projections as a file has them.

    Attributes:
        geometry: Of all views.
        line_integrals: (V, H, W); None where there are intensities.
        intensities: (V, H, W) counts.
        flat: Counts without an object: one number, (H, W), or (F, H, W) frames of them.
        dark: Counts without rays, likewise.
        variance: (V, H, W) of the line integrals.
        valid: (V, H, W), not 0 where a pixel counts.
        test: (V,), not 0 where a view is held out.
        notes: What a reader chose or passed over, a sentence each.
    """

    geometry: ProjectionGeometry
    line_integrals: np.ndarray | None = None
    intensities: np.ndarray | None = None
    flat: Any = None
    dark: Any = None
    variance: np.ndarray | None = None
    valid: np.ndarray | None = None
    test: np.ndarray | None = None
    notes: tuple[str, ...] = field(default=())


def require_room(path: Path, shape: tuple[int, ...]) -> None:
    """Checks that there is memory for the projections of a scan, before any is taken.

    Raises:
        CaptureError: There is not.
    """
    size = 8 * _COPIES
    for count in shape:
        size *= count
    what = f"{' x '.join(f'{n:,}' for n in shape)} pixels of '{path}'"
    require_free(size, what, "take fewer views, or average pixels", CaptureError)


@contextmanager
def as_capture_errors(path: Path) -> Iterator[None]:
    """Context in which what a reader of HDF5 says of meshes is said of projections."""
    try:
        yield
    except MeshError as error:
        reason = str(error).replace("cannot be read as a mesh", "cannot be read as projections")
        raise CaptureError(reason) from error
    except MemoryError as error:
        raise CaptureError(f"'{path}' needs more memory than there is; take fewer views, or average pixels.") from error
