"""Bundles of rays, each with an origin and a direction of its own."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_reals, moved
from difftetvr.rendering.cameras.checks import MOST_PIXELS


@dataclass(frozen=True, eq=False)
class Rays:
    """A bundle of rays in world space, of any shape: images, fans, single rays.

    Attributes:
        origins: (..., 3) where they start; images are differentiable in them.
        directions: (..., 3) where they go, of any length but 0; likewise. Shapes are broadcast against each other's.
        near: (...) or a number, distance in world units from which on a ray is looked at; differentiable. Where it is
            negative, it is looked at from behind its origin; -infinity and infinity make it a line.
        far: (...) or a number, distance up to which it is, at least near; may be infinite; differentiable.

    Raises:
        CameraError: Shapes do not fit, a value is not finite, a direction is 0, or near is beyond far.
    """

    origins: torch.Tensor
    directions: torch.Tensor
    near: torch.Tensor | float = 0.0
    far: torch.Tensor | float = math.inf

    def __post_init__(self) -> None:
        origins, directions = (
            as_reals(getattr(self, name), f"The rays' {name}", CameraError, advice="pass a tensor of shape (..., 3)")
            for name in ("origins", "directions")
        )
        ends = [_end(name, getattr(self, name), directions) for name in ("near", "far")]
        for name, tensor in (("origins", origins), ("directions", directions)):
            if tensor.shape[-1:] != (3,):
                raise CameraError(f"The rays' {name} have shape {tuple(tensor.shape)}; pass (..., 3).")
        if origins.device != directions.device:
            raise CameraError(
                f"The rays' origins are on '{origins.device}', their directions on '{directions.device}'; move one."
            )
        try:
            origins, directions = torch.broadcast_tensors(origins, directions)
            near, far = (
                torch.broadcast_to(end, origins.shape[:-1]) if isinstance(end, torch.Tensor) else end for end in ends
            )
        except RuntimeError as reason:
            shapes = ", ".join(str(tuple(getattr(part, "shape", ()))) for part in (origins, directions, *ends))
            raise CameraError(
                f"The rays' origins, directions, near and far have shapes {shapes}, which do not fit together; pass "
                "(..., 3), (..., 3), (...) and (...)."
            ) from reason
        if math.prod(origins.shape[:-1]) > MOST_PIXELS:
            raise CameraError(
                f"There are {math.prod(origins.shape[:-1]):,} rays; pass at most {MOST_PIXELS:,} at a time."
            )
        for name, value in (("origins", origins), ("directions", directions), ("near", near), ("far", far)):
            object.__setattr__(self, name, value)
        self._require_sound()

    def _require_sound(self) -> None:
        if not self.directions.numel() or self._is_sound():
            return
        o, d, near, far = (tensor.detach() for tensor in (self.origins, self.directions, self.ends[0], self.ends[1]))
        length = d.abs().amax(-1)
        bad = ~(torch.isfinite(o).all(-1) & torch.isfinite(length) & (length > 0) & _are_ordered(near, far))
        place = tuple(torch.nonzero(bad)[0].tolist())
        where = f"Ray {place[0] if len(place) == 1 else place}"
        if not bool(torch.isfinite(o[place]).all()):
            raise CameraError(f"{where} has the origin {shown(o[place].tolist())}; origins must be finite.")
        if not bool(torch.isfinite(length[place]) & (length[place] > 0)):
            raise CameraError(
                f"{where} has the direction {shown(d[place].tolist())}; directions must be finite and not 0."
            )
        raise CameraError(
            f"{where} is looked at from {float(near[place])} to {float(far[place])}; near must not be beyond far, nor "
            "both of them infinitely far away on one side."
        )

    def _is_sound(self) -> bool:
        """Whether all rays are sound, without a look at which: in a fraction of that time."""
        directions = self.directions.detach()
        near, far = (end if isinstance(end, torch.Tensor) else self._rounded(end) for end in (self.near, self.far))
        are_ordered = torch.as_tensor(_are_ordered(near, far)).all()
        x, y, z = directions.unbind(-1)
        is_any_zero = ((x == 0) & (y == 0) & (z == 0)).any()
        finite = [torch.isfinite(end) for part in (self._starts.detach(), directions) for end in torch.aminmax(part)]
        return bool(functools.reduce(operator.and_, finite) & ~is_any_zero & are_ordered)

    @property
    def ends(self) -> tuple[torch.Tensor, torch.Tensor]:
        """``near`` and ``far`` as (...) tensors."""
        near, far = (
            end
            if isinstance(end, torch.Tensor)
            else self.directions.new_full((), self._rounded(end)).expand(self.shape)
            for end in (self.near, self.far)
        )
        return near, far

    def _rounded(self, end: float) -> float:
        """A number in the precision of the rays; infinite where that is none."""
        return float(torch.tensor(end, dtype=self.directions.dtype))

    @property
    def shape(self) -> torch.Size:
        """Shape of the bundle, without the last dimension of its vectors."""
        return self.directions.shape[:-1]

    @property
    def eye(self) -> torch.Tensor | None:
        """(3,) the one point that all rays start at, where the origins were given as one vector; else None.

        No values are compared: rays with equal origins of their own may start at one point and not know it.
        """
        return one_vector(self.origins)

    @property
    def _starts(self) -> torch.Tensor:
        """Origins, or the one that stands for all of them."""
        eye = self.eye
        return self.origins if eye is None else eye

    def by_viewpoint(self) -> tuple[list[tuple[torch.Tensor, Rays]], bool]:
        """The rays apart by what they share: a point where they start, or, of parallel ones, where they go.

        They count as parallel where they have fewer directions than origins, value for value. Differentiable.

        Returns:
            (M,) places in this bundle, counted through all of its shape, and the (M,) rays there, for each; and whether
            they are parallel.
        """
        parts = self.origins.reshape(-1, 3), self.directions.reshape(-1, 3)
        groups = [torch.unique(part.detach(), dim=0, return_inverse=True)[1] for part in parts]
        counts = [int(group.max()) + 1 if group.numel() else 0 for group in groups]
        are_parallel = counts[1] < counts[0]
        group, count = groups[are_parallel], counts[are_parallel]
        all_places = torch.split(torch.argsort(group, stable=True), torch.bincount(group, minlength=count).tolist())
        return [(place, self.some(place)) for place in all_places], are_parallel

    def some(self, places: torch.Tensor) -> Rays:
        """The rays at (M,) places, counted through all of the bundle's shape; (M,). Differentiable."""
        origins, directions = (part.reshape(-1, 3)[places] for part in (self.origins, self.directions))
        ends = (e.reshape(-1)[places] if isinstance(e, torch.Tensor) else e for e in (self.near, self.far))
        return Rays(origins, directions, *ends)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Rays:
        """The same rays on another device or in another precision; autograd sees them as a function of these.

        Raises:
            CameraError: This machine has no such device.
        """
        parts: tuple[Any, ...] = (self._starts, self.directions, self.near, self.far)
        return Rays(*(moved(x, device, dtype, CameraError) if isinstance(x, torch.Tensor) else x for x in parts))

    def at(self, distances: torch.Tensor | float) -> torch.Tensor:
        """(..., 3) points at distances along the rays; differentiable.

        Args:
            distances: (...) or a number, in world units.

        Raises:
            CameraError: There are not so many.
        """
        along = as_reals(distances, "The distances", CameraError, self.directions.dtype).to(self.directions)
        try:
            return self.origins + along[..., None] * unit_vectors(self.directions)
        except RuntimeError as reason:
            raise CameraError(
                f"The distances have shape {tuple(along.shape)}, the rays {tuple(self.shape)}; pass one each, or one."
            ) from reason

    def relative_to(self, origin: Sequence[float]) -> Rays:
        """The same rays in a world whose origin lies at a point of this one, (3,); in float64 unless it is the same."""
        if not any(origin):
            return self
        shift = torch.tensor(list(origin), dtype=torch.float64, device=self.origins.device)
        return replace(self, origins=self._starts.double() - shift)

    @staticmethod
    def stacked(bundles: Sequence[Rays]) -> Rays:
        """Several bundles of one shape as one, (B, ...).

        Raises:
            CameraError: They have several shapes or devices, or there is none.
        """
        _require_one_device(bundles)
        shapes = sorted({tuple(bundle.shape) for bundle in bundles})
        if len(shapes) != 1:
            told = "there is none" if not shapes else f"these have the shapes {shapes[0]} and {shapes[1]}"
            raise CameraError(
                f"Bundles of rays are stacked if they have one shape, but {told}; join them, or pass some."
            )
        origins, directions = (torch.stack([getattr(b, name) for b in bundles]) for name in ("origins", "directions"))
        return Rays(origins, directions, *_shared_ends(bundles, torch.stack))

    @staticmethod
    def joined(bundles: Sequence[Rays]) -> Rays:
        """The rays of several bundles one after the other, (N,).

        Raises:
            CameraError: They are on several devices, or there is none.
        """
        _require_one_device(bundles)
        origins, directions = (
            torch.cat([getattr(b, name).reshape(-1, 3) for b in bundles]) for name in ("origins", "directions")
        )
        return Rays(origins, directions, *_shared_ends(bundles, lambda ends: torch.cat([e.reshape(-1) for e in ends])))


def _are_ordered(near: torch.Tensor | float, far: torch.Tensor | float) -> torch.Tensor | bool:
    """Whether there is something between ``near`` and ``far``; not where one of them is no number."""
    return (near <= far) & (near < math.inf) & (far > -math.inf)


def _require_one_device(bundles: Sequence[Rays]) -> None:
    devices = sorted({f"'{bundle.origins.device}'" for bundle in bundles})
    if len(devices) > 1:
        raise CameraError(f"The rays are on {' and '.join(devices)}; move them, or their cameras, to one device.")
    if not devices:
        raise CameraError("There are no bundles of rays to be one; pass some.")


def _shared_ends(
    bundles: Sequence[Rays], join: Callable[[list[torch.Tensor]], torch.Tensor]
) -> Iterator[torch.Tensor | float]:
    """``near`` and ``far`` of several bundles in one: a number where it is that of all of them."""
    for place, name in enumerate(("near", "far")):
        first, *rest = (getattr(bundle, name) for bundle in bundles)
        is_number = isinstance(first, float) and all(isinstance(end, float) and end == first for end in rest)
        yield first if is_number else join([bundle.ends[place] for bundle in bundles])


def one_vector(vectors: torch.Tensor) -> torch.Tensor | None:
    """(3,) the one vector that (..., 3) vectors are in memory; None where they are several, or none."""
    sizes, strides = vectors.shape[:-1], vectors.stride()[:-1]
    if 0 in sizes or any(size > 1 and stride != 0 for size, stride in zip(sizes, strides, strict=True)):
        return None
    return vectors[(0,) * len(sizes)]


def are_one(vectors: torch.Tensor) -> bool:
    """Whether (N, 3) vectors are one by their values, for which the host may have to wait."""
    vectors = vectors.detach()
    return bool((vectors == vectors[:1]).all())


def unit_vectors(vectors: torch.Tensor) -> torch.Tensor:
    """(..., 3) vectors of length 1, of such of any length but 0, whose squares need not be numbers."""
    exponent = vectors.detach().abs().amax(-1, keepdim=True).log2().floor()
    most = 1000 if vectors.dtype == torch.float64 else 120
    # A power of two: vectors of common lengths come to the very bits they would come to without.
    scale = torch.ldexp(torch.ones_like(vectors[..., :1]), -exponent.clamp(-most, most))
    vectors = vectors * scale
    return vectors / torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)


@runtime_checkable
class RaySource(Protocol):
    """Anything that sees along rays: a camera of any kind."""

    def rays(self) -> Rays:
        """The rays in world space: (H, W), one for each pixel, or (B, H, W) of several views."""
        ...


def _end(name: str, value: Any, directions: torch.Tensor) -> torch.Tensor | float:
    """Where rays begin or end, on their device; a number stays one, which kernels need not read for each ray."""
    if type(value) in (float, int):
        with suppress(OverflowError):  # is refused below
            return float(value)
    end = as_reals(value, f"The rays' {name}", CameraError, directions.dtype, "pass a number or tensor")
    return end.to(directions.device)


@lru_cache(maxsize=16)
def image_order(shape: tuple[int, ...], device: torch.device) -> torch.Tensor | None:
    """Numbers of rays in an order in which neighbours see neighbouring pixels, so that they share cells in cache.

    Args:
        shape: Shape of the bundle; the last two dimensions count as rows and columns of images.
        device: Where they are wanted, and made.

    Returns:
        (N,) int32, which is shared and must not be changed; None where the rays are no images.
    """
    from difftetvr.rendering.traversal.rays import lane_count, lane_pixel  # late: rays are there without kernels

    if len(shape) < 2 or min(shape[-2:]) < _LEAST_SIDE:
        return None
    height, width = shape[-2:]
    size: Any = _Size((width, height), width, height)
    column, row, valid = lane_pixel(size, torch.arange(lane_count(width, height), device=device))
    one = (row * width + column)[valid]
    images = torch.arange(math.prod(shape[:-2]), device=device)[:, None] * (width * height)
    return (images + one).reshape(-1).int()


_LEAST_SIDE = 4


@dataclass(frozen=True)
class _Size:
    size: tuple[int, int]
    width: int
    height: int
