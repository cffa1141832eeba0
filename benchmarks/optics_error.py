"""Plot the error of the radiance of one cell against its optical depth, for every optical model.

    python benchmarks/optics_error.py [docs/images/optics_error.png]

All models run in float32, on 2000 crossings per optical depth with random end densities (a fifth of them with a zero at
one end) and random end colours in [0, 1]; drawn is the largest absolute error against quadrature in float64. "Gauss" is
Gauss-Legendre quadrature of the transmittance alone, one exponential a node.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import drjit as dr
import matplotlib
import numpy as np
import torch

from difftetvr.backend import get_backend
from difftetvr.files import atomic_write
from difftetvr.optics import ExactLinear, SubSegments

matplotlib.use("Agg")
from matplotlib import pyplot as plt

CROSSINGS = 2000
Weights = tuple[Any, Any, Any]


class Gauss:
    """Gauss-Legendre quadrature of the transmittance with a fixed number of nodes."""

    def __init__(self, nodes: int) -> None:
        points, weights = np.polynomial.legendre.leggauss(nodes)
        self.rule = list(zip(((points + 1) / 2).tolist(), (weights / 2).tolist(), strict=True))

    def weights(self, length: Any, s0: Any, s1: Any) -> Weights:
        """See :meth:`difftetvr.optics.OpticalModel.weights`."""
        a, b = length * s0, length * s1
        mean = type(length)(0.0)
        for x, weight in self.rule:
            mean = dr.fma(dr.exp(-x * dr.fma(0.5 * x, b - a, a)), weight, mean)
        transmittance = dr.exp(-0.5 * (a + b))
        return 1.0 - mean, mean - transmittance, transmittance


def reference(length: np.ndarray, s0: np.ndarray, s1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the end colours by Gauss-Legendre quadrature on panels graded towards the entry, in float64."""
    a, b = (length * s0)[:, None], (length * s1)[:, None]
    points, weights = np.polynomial.legendre.leggauss(24)
    edges = np.concatenate([[0.0], 2.0 ** np.arange(-18, 1)])
    x = (edges[:-1, None] + np.diff(edges)[:, None] * (points + 1) / 2).ravel()
    scale = (np.diff(edges)[:, None] * weights / 2).ravel()
    emitted = (a + (b - a) * x) * np.exp(-x * (a + (b - a) / 2 * x)) * scale
    return emitted @ (1 - x), emitted @ x


def largest_error(model: Any, depth: float) -> float:
    """Largest absolute error of the radiance in float32 at one optical depth."""
    random = np.random.default_rng(1)
    s0, s1, c0, c1 = random.uniform(0, 1, (4, CROSSINGS)).astype(np.float32)
    s0[: CROSSINGS // 10] = 0
    s1[CROSSINGS // 10 : CROSSINGS // 5] = 0
    length = (2 * depth / (s0 + s1)).astype(np.float32)
    double = [x.astype(np.float64) for x in (length, s0, s1, c0, c1)]
    w0, w1 = reference(*double[:3])
    backend = get_backend("cpu", torch.float32)
    found = [w.numpy().astype(np.float64) for w in model.weights(*(backend.Float(x) for x in (length, s0, s1)))]
    return float(np.abs((found[0] - w0) * double[3] + (found[1] - w1) * double[4]).max())


def plot(path: Path) -> None:
    """Draw the figure and write it."""
    depths = np.geomspace(1e-3, 1e4, 71)
    models = {
        "1 sub-segment": (SubSegments(1), "#d62728", "-"),
        "4 sub-segments": (SubSegments(4), "#ff7f0e", "-"),
        "16 sub-segments": (SubSegments(16), "#e6b800", "-"),
        "Gauss, 3 nodes": (Gauss(3), "#7f7f7f", "--"),
        "Gauss, 4 nodes": (Gauss(4), "#4a4a4a", "--"),
        "ExactLinear": (ExactLinear(), "#1f77b4", "-"),
    }
    figure, axes = plt.subplots(figsize=(7.5, 4.6), dpi=140)
    for name, (model, color, style) in models.items():
        errors = [max(largest_error(model, depth), 1e-11) for depth in depths]
        axes.loglog(depths, errors, style, color=color, label=name, linewidth=2.5 if name == "ExactLinear" else 1.5)
        print(f"{name:16s} largest error {max(errors):.1e}")
    axes.axhline(1e-6, color="black", linewidth=0.8, linestyle=":")
    axes.text(1.5e3, 1.25e-6, "target 1e-6", fontsize=8)
    axes.set(
        xlim=(1e-3, 1e4), ylim=(1e-11, 3), xlabel="optical depth of the cell", ylabel="largest error of the radiance"
    )
    axes.set_title("One cell, linear density and colour, float32", fontsize=11)
    axes.grid(which="major", linewidth=0.4, alpha=0.6)
    axes.legend(fontsize=8, loc="lower right", ncols=2, framealpha=0.95)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        figure.savefig(temporary)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parent.parent / "docs" / "images" / "optics_error.png"
    parser.add_argument("path", nargs="?", type=Path, default=default)
    plot(parser.parse_args().path)
