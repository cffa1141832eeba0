"""What a renderer asks of an optical model."""

from __future__ import annotations

from typing import Any, Protocol

Weights = tuple[Any, Any, Any]
Adjoint = tuple[Any, Any, Any, Any, Any, Any]


class OpticalModel(Protocol):
    """How light is gathered along the crossing of one cell.

    A crossing has a length and a density at either end; colour is linear along it. The model answers with the weights
    of the two end colours and the transmittance, from which a renderer composites front to back::

        radiance += transmittance_of_ray * (w0 * c0 + w1 * c1)
        transmittance_of_ray *= T1

    Energy is conserved: ``w0 + w1 + T1 = 1``. All arguments and results are Dr.Jit arrays of one floating-point type,
    float32 or float64. The methods may be called inside symbolic loops; no lane, active or not, divides by zero.
    Models are frozen and hashable, so that kernels can be cached by model.
    """

    def weights(self, length: Any, s0: Any, s1: Any) -> Weights:
        """Weights of the end colours and transmittance of a crossing.

        Args:
            length: Length of the crossing, >= 0, in any unit.
            s0: Density where the ray enters, >= 0, per that unit.
            s1: Density where the ray leaves, >= 0.

        Returns:
            ``(w0, w1, T1)``, each in [0, 1]: weight of the colour at the entry and at the exit, transmittance.
        """
        ...

    def adjoint(self, length: Any, s0: Any, s1: Any, g0: Any, g1: Any, gt: Any) -> Adjoint:
        """Weights once more, and the derivatives of a loss with respect to the crossing.

        Args:
            length: Length of the crossing.
            s0: Density at the entry.
            s1: Density at the exit.
            g0: Derivative of the loss with respect to ``w0``.
            g1: Derivative of the loss with respect to ``w1``.
            gt: Derivative of the loss with respect to ``log(T1)`` while ``w0`` and ``w1`` are held.

        Returns:
            ``(w0, w1, T1, d_length, d_s0, d_s1)``.
        """
        ...
