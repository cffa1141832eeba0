"""ExactLinear against mpmath and float64 quadrature.

Criterion of the derivatives: the error of dL/dx is measured relative to the largest term that enters it for the two
weights, i.e. to max(|dw0/dx|, |dw1/dx|, |dT1/dx|): the derivative itself passes through zero where these cancel.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest
import torch

from difftetvr.backend import get_backend
from difftetvr.optics import ExactLinear

from .reference import crossings, exact, quadrature

SINGLE, DOUBLE = get_backend("cpu", torch.float32), get_backend("cpu", torch.float64)
PRECISIONS = [pytest.param(SINGLE, np.float32, 3e-7, 4e-6, id="float32")]
PRECISIONS += [pytest.param(DOUBLE, np.float64, 2e-15, 2e-13, id="float64")]


def arrays(backend, *values):
    return [backend.Float(np.ascontiguousarray(v)) for v in values]


def numpy(values):
    dr.eval(values)  # all by one kernel: compiling it is what takes the time here
    return [np.asarray(v.numpy(), dtype=np.float64) for v in values]


def evaluate(backend, length, s0, s1):
    """Everything the quadrature of the reference returns, and the weights by the forward function."""
    length, s0, s1, zero, one = arrays(backend, length, s0, s1, np.zeros_like(length), np.ones_like(length))
    model = ExactLinear()
    by_w0 = numpy(model.adjoint(length, s0, s1, one, zero, zero))
    by_w1 = numpy(model.adjoint(length, s0, s1, zero, one, zero))
    names = ("w0", "w1", "T1", "w0_length", "w0_s0", "w0_s1", "w1_length", "w1_s0", "w1_s1")
    return dict(zip(names, by_w0 + by_w1[3:], strict=True)), numpy(model.weights(length, s0, s1))


@pytest.mark.parametrize(("backend", "dtype", "absolute", "relative"), PRECISIONS)
def test_matches_quadrature_for_every_optical_depth(backend, dtype, absolute, relative):
    length, s0, s1 = crossings(6000, seed=1, dtype=dtype)
    found, forward = evaluate(backend, length, s0, s1)
    expected = quadrature(length, s0, s1)
    for name, value in zip(("w0", "w1", "T1"), forward, strict=True):
        assert np.abs(value - expected[name]).max() <= absolute, name
        assert np.abs(found[name] - expected[name]).max() <= absolute, name
    for name in ("w0", "w1"):
        # Thin cells keep their relative accuracy, so the derivatives with respect to colours do.
        assert (np.abs(found[name] - expected[name]) / expected[name]).max() <= relative, name
        assert (np.abs(forward[0 if name == "w0" else 1] - expected[name]) / expected[name]).max() <= relative, name
    for name in ("length", "s0", "s1"):
        error = np.abs(found[f"w0_{name}"] - expected[f"w0_{name}"]) / expected[f"w0_{name}"]
        assert error.max() <= relative, name
        through_t1 = {"length": (s0 + s1) / 2, "s0": length / 2, "s1": length / 2}[name] * expected["T1"]
        scale = np.maximum(np.maximum(np.abs(expected[f"w1_{name}"]), expected[f"w0_{name}"]), through_t1)
        error = np.abs(found[f"w1_{name}"] - expected[f"w1_{name}"]) / scale
        assert error.max() <= relative, name


@pytest.mark.parametrize(("backend", "dtype", "absolute", "relative"), PRECISIONS)
def test_matches_mpmath(backend, dtype, absolute, relative):
    length, s0, s1 = crossings(100, seed=2, dtype=dtype)
    found, _ = evaluate(backend, length, s0, s1)
    for i in range(len(length)):
        expected = exact(float(length[i]), float(s0[i]), float(s1[i]))
        for name, value in expected.items():
            if name == "T1":
                assert abs(found[name][i] - value) <= absolute
            else:
                assert abs(found[name][i] / value - 1) <= relative, (name, length[i], s0[i], s1[i])


def test_reference_agrees_with_mpmath():
    length, s0, s1 = crossings(40, seed=3, dtype=np.float64)
    approximate = quadrature(length, s0, s1)
    for i in range(len(length)):
        for name, value in exact(length[i], s0[i], s1[i]).items():
            assert approximate[name][i] == pytest.approx(value, rel=1e-12, abs=1e-300), name


@pytest.mark.parametrize("backend", [SINGLE, DOUBLE])
def test_radiance_error_stays_below_one_millionth(backend):
    dtype = np.float64 if backend.is_double else np.float32
    length, s0, s1 = crossings(6000, seed=4, dtype=dtype)
    c0, c1 = np.random.default_rng(5).uniform(0, 1, (2, len(length))).astype(dtype)
    w0, w1, _ = ExactLinear().weights(*arrays(backend, length, s0, s1))
    found = (w0 * backend.Float(c0) + w1 * backend.Float(c1)).numpy()
    expected = quadrature(length, s0, s1)
    assert np.abs(found - expected["w0"] * c0 - expected["w1"] * c1).max() <= 1e-6


@pytest.mark.parametrize("backend", [SINGLE, DOUBLE])
def test_nothing_there_is_exactly_transparent(backend):
    found, forward = evaluate(backend, *np.array([[0.0, 1, 1], [1, 0, 0], [0, 0, 0]], dtype=np.float32).T)
    assert [list(w) for w in forward] == [[0, 0, 0], [0, 0, 0], [1, 1, 1]]
    np.testing.assert_allclose(found["w0_s0"][1], 1 / 3, rtol=1e-5)
    np.testing.assert_allclose(found["w0_s1"][1], 1 / 6, rtol=1e-5)
    assert all(np.isfinite(value).all() for value in found.values())


@pytest.mark.parametrize("backend", [SINGLE, DOUBLE])
def test_huge_depths_are_finite_and_opaque(backend):
    length = np.array([1e4, 1e8, 1e15, 1e15], dtype=np.float32)
    s0, s1 = np.array([[1, 1, 0, 1], [1, 0, 1, 1]], dtype=np.float32)
    found, _ = evaluate(backend, length, s0, s1)
    assert all(np.isfinite(value).all() for value in found.values())
    np.testing.assert_allclose(found["w0"], 1, atol=2e-4)
    np.testing.assert_array_equal(found["T1"], 0)


@pytest.mark.parametrize("depth", [0.3, 1.5, 22.0, 44.0])
def test_smooth_across_the_thresholds_in_float64(depth):
    # A jump between methods would show as a finite difference that does not match the adjoint.
    step = 1e-6
    s0, s1 = np.array([[0.2, 1.0, 1.0, 0.0, 2.0], [1.8, 1.0, 1 + 1e-9, 2.0, 0.0]])
    length = 2 * depth / (s0 + s1)
    for name, shift in (("length", (step, 0, 0)), ("s0", (0, step, 0)), ("s1", (0, 0, step))):
        if name != "length":
            s0, s1 = np.maximum(s0, step), np.maximum(s1, step)
        _, upper = evaluate(DOUBLE, length + shift[0], s0 + shift[1], s1 + shift[2])
        _, lower = evaluate(DOUBLE, length - shift[0], s0 - shift[1], s1 - shift[2])
        found, _ = evaluate(DOUBLE, length, s0, s1)
        for k, weight in enumerate(("w0", "w1")):
            np.testing.assert_allclose(
                (upper[k] - lower[k]) / (2 * step), found[f"{weight}_{name}"], rtol=1e-8, atol=2e-9
            )


def test_works_inside_a_symbolic_loop():
    # Lanes of different depths and trip counts: thin and thick branches nest in a loop.
    backend = SINGLE
    count = 64
    depths = np.geomspace(1e-3, 30, count).astype(np.float32)
    steps = (np.arange(count) % 5 + 1).astype(np.uint32)
    depth, limit = backend.Float(depths), backend.UInt(steps)

    def body(i, passed, radiance):
        w0, w1, transmittance = ExactLinear().weights(depth, backend.Float(0.5), backend.Float(1.5))
        return i + 1, passed * transmittance, dr.fma(passed, w0 + w1, radiance)

    _, passed, radiance = dr.while_loop(
        (dr.zeros(backend.UInt, count), dr.ones(backend.Float, count), dr.zeros(backend.Float, count)),
        lambda i, passed, radiance: i < limit,
        body,
    )
    np.testing.assert_allclose(passed.numpy(), np.exp(-depths.astype(float) * steps), rtol=2e-5, atol=1e-30)
    np.testing.assert_allclose(radiance.numpy() + passed.numpy(), 1, atol=1e-6)
