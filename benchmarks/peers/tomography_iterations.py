"""Voxels by iterations over ordered subsets of views: OS-SART, and weighted least squares with total variation.

Both begin with N / 2 voxels a side, rounded up, on projections of half the resolution. What their options should be is
judged by held-out projections alone: OS-SART keeps the iterate that predicts them best, and the options of either are
chosen so.

Sources: Andersen and Kak, "Simultaneous algebraic reconstruction technique (SART)", Ultrasonic Imaging 6 (1984); Kim,
Ramani and Fessler, "Combining ordered subsets and momentum for accelerated X-ray CT image reconstruction", IEEE TMI 34
(2015); Beck and Teboulle, "Fast gradient-based algorithms for constrained total variation image denoising and
deblurring problems", IEEE TIP 18 (2009).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tomography_projector import VoxelProjector
from tomography_scan import VoxelScan, binned
from tomography_variation import VariationProximal

Watch = Callable[[str], None]

_LEAST_SUM = 1e-3  # of the greatest: voxels that hardly a ray meets move no faster
_COARSEST = 32


@dataclass(frozen=True)
class Sart:
    """Options of OS-SART.

    Attributes:
        passes: Over all views on each level, at most: the best by held-out views is kept.
        subsets: How many the views are divided into.
        relaxation: Of the first pass.
        decay: Of the relaxation, from pass to pass.
    """

    passes: int = 6
    subsets: int = 45
    relaxation: float = 0.7
    decay: float = 0.7


@dataclass(frozen=True)
class Variational:
    """Options of least squares with total variation.

    Attributes:
        weight: Of the total variation, in the units of `TomographyConfig.total_variation`.
        updates: On each of the coarse levels, and on the last one; as many more as fill a pass over all views.
        together: Views of an update; with fewer than three, momentum swings instead of gaining speed.
        momentum: Greatest share of the last step that is repeated.
        settling: Of the passes, how many of the last take no momentum.
        inner: Steps for the proximal map of the total variation, in each update.
    """

    weight: float = 0.00625
    updates: tuple[int, int] = (60, 30)
    together: int = 3
    momentum: float = 0.8
    settling: int = 1
    inner: int = 4


def sart(scan: VoxelScan, size: int, options: Sart, watch: Watch) -> torch.Tensor:
    """(N^3) densities by OS-SART, at least 0."""

    def level(volume: torch.Tensor, coarse: VoxelScan, projector: VoxelProjector) -> torch.Tensor:
        groups = coarse.subsets(options.subsets)
        ways = [torch.where(coarse.weight[g] > 0, projector.lengths(g), 0.0) for g in groups]
        sums = [projector.transpose((way > 0).float(), g) for way, g in zip(ways, groups, strict=True)]
        inverse = [1.0 / torch.clamp_min(s, _LEAST_SUM * float(s.max())) for s in sums]
        del sums
        best, best_psnr = volume, -math.inf
        for step in range(options.passes):
            relaxation = options.relaxation * options.decay**step
            for group, way, scale in zip(groups, ways, inverse, strict=True):
                residual = coarse.measured[group] - projector.forward(volume, group)
                residual = torch.where(way > 0, residual / way, 0.0)
                change = projector.transpose(residual, group)
                volume = volume.addcmul(change, scale, value=relaxation).clamp_min_(0.0)
            psnr = coarse.held_out_psnr(volume, projector)
            watch(f"OS-SART {projector.size}^3, pass {step + 1}: held-out views {psnr:.3f} dB")
            if psnr < best_psnr:
                break
            best, best_psnr = volume, psnr
        return best

    return _coarse_to_fine(scan, size, level)


def variational(scan: VoxelScan, size: int, options: Variational, watch: Watch) -> torch.Tensor:
    """(N^3) densities >= 0 that minimise half the mean of weighted squares, plus their total variation."""
    rays = len(scan.train) * scan.measured.shape[1]

    def level(volume: torch.Tensor, coarse: VoxelScan, projector: VoxelProjector) -> torch.Tensor:
        groups = coarse.subsets(max(1, len(coarse.train) // options.together))
        curvature = torch.zeros_like(volume)
        for group in groups:
            curvature += projector.transpose(coarse.weight[group] * projector.lengths(group), group)
        curvature.clamp_min_(_LEAST_SUM * float(curvature.max()))
        # The objective is that of the meshes, a mean over rays in units of the noise, times rays / precision. With the
        # rays of the whole scan, coarse levels have the same proportion of likelihood and prior as the last one.
        variation = options.weight * rays / coarse.precision / projector.size**2 / coarse.mean_density(projector)
        proximal = VariationProximal(curvature, variation, projector.size)
        ahead, speed = volume, 1.0
        passes = -(-options.updates[projector.size == size] // len(groups))
        for step in range(passes):
            for group in groups:
                residual = projector.forward(ahead, group).sub_(coarse.measured[group]).mul_(coarse.weight[group])
                scale = -float(len(coarse.train)) / len(group)
                change = projector.transpose(residual, group).div_(curvature)
                found = proximal(ahead.add(change, alpha=scale), options.inner)
                following = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * speed * speed))
                share = 0.0 if step >= passes - options.settling else min((speed - 1.0) / following, options.momentum)
                ahead, volume, speed = found + share * (found - volume), found, following
            psnr = coarse.held_out_psnr(volume, projector)
            watch(f"TV {options.weight:g} {projector.size}^3, pass {step + 1}: held-out views {psnr:.3f} dB")
        return volume

    return _coarse_to_fine(scan, size, level)


def _coarse_to_fine(
    scan: VoxelScan, size: int, level: Callable[[torch.Tensor, VoxelScan, VoxelProjector], torch.Tensor]
) -> torch.Tensor:
    """Begin with few voxels and pixels, and double both, or nearly so where numbers are odd."""
    sizes = [size]
    while (half := -(-sizes[0] // 2)) >= _COARSEST:
        sizes.insert(0, half)
    volume = torch.zeros(sizes[0] ** 3)
    for k, count in zip(range(len(sizes) - 1, -1, -1), sizes, strict=True):
        coarse = scan if k == 0 else VoxelScan.of(binned(scan.capture, 2**k))
        volume = resized(volume, round(volume.numel() ** (1 / 3)), count)
        volume = level(volume, coarse, VoxelProjector(coarse.geometry, count))
    return volume


def resized(volume: torch.Tensor, size: int, count: int) -> torch.Tensor:
    """``count``^3 voxels in the place of ``size``^3, with the trilinear values at their middles."""
    cube = volume.reshape(1, 1, size, size, size)
    return torch.nn.functional.interpolate(cube, (count,) * 3, mode="trilinear", align_corners=False).reshape(-1)
