"""Noise of photon counts and of the electronics that read them, and what it does to line integrals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from difftetvr.declared import require_declared
from difftetvr.errors import CaptureError, shown

_LEAST_COUNT = 0.5  # where noise leaves none, as between none and one photon
_AT_ONCE = 2**22
_MOST_COUNTS = 1e15
_ROBUST = 1.4826  # of a normal distribution, the standard deviation in medians of magnitudes
_SAMPLE = 1_000_000
_LEAST_SIDE = 3
_WORDS = (
    "give it as 'poisson:1e4,gaussian:10', with 'scale:1' behind it for counts that do not depend on the largest one"
)


@dataclass(frozen=True)
class Noise:
    """How a scan is noisy, as TIGRE and R2-Gaussian make it, or in plain units.

    A line integral p becomes poisson(I0 exp(-p / s)) + gaussian(0, sigma) counts I, and these -s log(I / I0). TIGRE
    takes for s the greatest line integral of all views, so that the darkest pixel has I0 / e photons whatever the unit
    of attenuation; s = 1 is Beer and Lambert's law, for attenuation in the unit of the geometry.

    Source: TIGRE's ``CTnoise.add`` (``Python/tigre/utilities/CTnoise.py``), https://github.com/CERN/TIGRE.

    Attributes:
        poisson: I0, photons of a pixel that sees nothing; None for as many as make no noise.
        gaussian: Standard deviation of the electronics' noise, in counts.
        scale: s; None for the greatest line integral.

    Raises:
        CaptureError: A number is out of range, or there is electronics' noise without counts.
    """

    poisson: float | None = None
    gaussian: float = 0.0
    scale: float | None = None

    def __post_init__(self) -> None:
        require_declared(self, CaptureError, "noise's ")
        counts, scale = self.poisson, self.scale
        if counts is not None and not (math.isfinite(counts) and 1.0 <= counts <= _MOST_COUNTS):
            raise CaptureError(f"The noise's poisson is {shown(counts)}; give photons of a pixel, from 1 to 1e15.")
        if not (math.isfinite(self.gaussian) and self.gaussian >= 0.0):
            raise CaptureError(f"The noise's gaussian is {shown(self.gaussian)}; give counts of at least 0.")
        if scale is not None and not (math.isfinite(scale) and scale > 0.0):
            raise CaptureError(f"The noise's scale is {shown(scale)}; give a number greater than 0.")
        if counts is None and (self.gaussian or scale is not None):
            raise CaptureError("The noise's gaussian and scale are for counts; give poisson:I0, too.")

    @staticmethod
    def parse(text: str) -> Noise:
        """The noise that words tell: ``poisson:1e4,gaussian:10``, ``poisson:1e5,scale:1``.

        Raises:
            CaptureError: They tell none.
        """
        found: dict[str, float] = {}
        for part in text.split(","):
            name, _, value = (word.strip() for word in part.partition(":"))
            try:
                if name not in ("poisson", "gaussian", "scale") or name in found:
                    raise ValueError
                found[name] = float(value)
            except ValueError:
                raise CaptureError(f"The noise is {shown(text)}; {_WORDS}.") from None
        return Noise(**found)

    @staticmethod
    def require_seed(seed: int) -> None:
        """Checks that random numbers can begin with a seed.

        Raises:
            CaptureError: It is no whole number of at least 0.
        """
        if not isinstance(seed, int) or seed < 0:
            raise CaptureError(f"The seed is {shown(seed)}; give a whole number of at least 0.")

    def apply(self, line_integrals: torch.Tensor, seed: int = 0) -> NoisyProjections:
        """Noisy line integrals of the same shape, their variances, and where counts were left.

        Args:
            line_integrals: (V, H, W), >= 0 as a rule.
            seed: Of the random numbers; the same seed makes the same noise.

        Raises:
            CaptureError: Without a scale, nothing absorbs; or the seed is negative.
        """
        self.require_seed(seed)
        clean = line_integrals.detach().cpu().numpy()
        noisy, variance = np.array(clean, dtype=np.float32), np.zeros(clean.shape, dtype=np.float32)
        valid = np.ones(clean.shape, dtype=bool)
        if self.poisson is None:
            return NoisyProjections(torch.from_numpy(noisy), None, torch.from_numpy(valid))
        scale = float(clean.max()) if self.scale is None else self.scale
        if not scale > 0.0:
            raise CaptureError("Nothing absorbs in any view, so that noise has no scale; check volume and geometry.")
        random = np.random.default_rng(seed)
        flat = [array.reshape(-1) for array in (clean, noisy, variance, valid)]
        for start in range(0, clean.size, _AT_ONCE):
            exact, into, spread, kept = (array[start : start + _AT_ONCE] for array in flat)
            counts = random.poisson(self.poisson * np.exp(-exact.astype(np.float64) / scale)).astype(np.float64)
            if self.gaussian:
                counts += random.normal(0.0, self.gaussian, counts.shape)
            kept[:] = counts >= _LEAST_COUNT
            counts = np.maximum(counts, _LEAST_COUNT)
            into[:] = -scale * np.log(counts / self.poisson)
            spread[:] = scale**2 * log_variance(counts, self.gaussian)
        return NoisyProjections(torch.from_numpy(noisy), torch.from_numpy(variance), torch.from_numpy(valid))


@dataclass(frozen=True, eq=False)
class NoisyProjections:
    """What noise makes of projections.

    Attributes:
        line_integrals: (V, H, W) float32.
        variance: (V, H, W) float32 of these, by the counts that were measured; None without noise.
        valid: (V, H, W) bool, false where no count was left.
    """

    line_integrals: torch.Tensor
    variance: torch.Tensor | None
    valid: torch.Tensor


def estimated_noise(values: torch.Tensor, variance: torch.Tensor | None = None) -> float | None:
    """Standard deviation of noise that is the same in all pixels, or that a model knows up to a factor.

    It shows in second differences. What these leave of the object itself is at edges; the median passes over them.

    Source: Immerkaer, "Fast noise variance estimation" (1996).

    Args:
        values: (V, H, W) images; NaN where a pixel is not known.
        variance: (V, H, W) by the model; None for 1.

    Returns:
        In units of that of the model; None where too few pixels lie side by side.
    """
    axes = [axis for axis in (1, 2) if values.shape[axis] >= _LEAST_SIDE]
    if 2 not in axes:
        return None
    expected = torch.ones_like(values) if variance is None else variance
    for axis in axes:
        values, expected = _stencil(values, axis, -2.0), _stencil(expected, axis, 4.0)
    known = torch.isfinite(values)
    ratios = values[known].abs() / expected[known].sqrt()
    sample = ratios[:: max(1, len(ratios) // _SAMPLE)]
    return _ROBUST * float(sample.median()) if len(sample) else None


def _stencil(values: torch.Tensor, axis: int, middle: float) -> torch.Tensor:
    """Sums of three neighbours along an axis, the middle one weighed."""
    count = values.shape[axis] - 2
    first, second, third = (values.narrow(axis, start, count) for start in range(3))
    return first + middle * second + third


def log_variance(counts: NDArray[np.float64], sigma: float = 0.0) -> NDArray[np.float64]:
    """Variance of the logarithm of counts, (I + sigma^2) / I^2: that of photons, and of the electronics.

    Source: Thibault, Bouman, Sauer, Hsieh, "A recursive filter for noise reduction in statistical iterative
    tomographic imaging" (2006), and Wang, Li, Lu, Liang, "Penalized weighted least-squares approach to sinogram noise
    reduction" (2006).

    Args:
        counts: Photons I, > 0.
        sigma: Standard deviation of the electronics' noise.
    """
    return (counts + sigma**2) / counts**2
