"""The other optical models, and what all of them have in common."""

from __future__ import annotations

import itertools

import drjit as dr
import numpy as np
import pytest
import torch

from difftetvr.backend import get_backend
from difftetvr.errors import DiffTetError
from difftetvr.optics import ConstantPerCell, ExactLinear, SubSegments

from .reference import crossings, quadrature

SINGLE, DOUBLE = get_backend("cpu", torch.float32), get_backend("cpu", torch.float64)
MODELS = [ExactLinear(), ConstantPerCell(), SubSegments(1), SubSegments(4), SubSegments(16)]


def call(method, backend, *values):
    count = len(values[0])
    results = method(*(backend.Float(np.ascontiguousarray(v)) for v in values))
    dr.eval(results)  # all by one kernel: compiling it is what takes the time here
    return [np.broadcast_to(np.asarray(r.numpy(), dtype=np.float64), count) for r in results]


def algorithm_1(length, s0, s1, count):
    """The article's Algorithms 1 and 3 as written, for colours (1, 0) and (0, 1), parameter over the segment."""
    w = np.zeros((2, len(length)))
    opacity = np.zeros(len(length))
    t = length / count
    for i in range(count):
        density = s0 + (s1 - s0) * (i + 0.5) / count
        passed = np.exp(-density * t)
        for k in range(2):
            near, far = (abs(1 - k - j / count) for j in (i, i + 1))
            slope = passed + (passed - 1) / (density * t)
            w[k] += (1 - opacity) * ((1 - passed) * near + slope * (near - far))
        opacity += (1 - opacity) * (1 - passed)
    return w[0], w[1], 1 - opacity


@pytest.mark.parametrize("count", [1, 4, 16])
def test_subsegments_are_the_articles_algorithm(count):
    random = np.random.default_rng(count)
    length, s0, s1 = 10.0 ** random.uniform(-1, 2, 500), *random.uniform(0.01, 1, (2, 500))
    found = call(SubSegments(count).weights, DOUBLE, length, s0, s1)
    for value, expected in zip(found, algorithm_1(length, s0, s1, count), strict=True):
        np.testing.assert_allclose(value, expected, atol=1e-12)


def test_subsegments_converge_to_the_exact_integral_with_second_order():
    length, s0, s1 = np.full(3, 4.0), np.array([0.0, 0.5, 2.0]), np.array([2.0, 1.5, 0.1])
    expected = quadrature(length, s0, s1)["w0"]
    errors = [np.abs(call(SubSegments(n).weights, DOUBLE, length, s0, s1)[0] - expected) for n in (8, 16, 32)]
    for coarse, fine in itertools.pairwise(errors):
        np.testing.assert_allclose(coarse / fine, 4, rtol=0.1)


@pytest.mark.parametrize("model", [ConstantPerCell(), SubSegments(1), SubSegments(7)])
@pytest.mark.parametrize("backend", [SINGLE, DOUBLE])
def test_all_models_agree_where_density_is_constant(model, backend):
    dtype, tolerance = (np.float64, 1e-13) if backend.is_double else (np.float32, 5e-6)
    length = np.geomspace(1e-8, 1e4, 500).astype(dtype)
    density, zero = np.ones_like(length), np.zeros_like(length)
    expected = quadrature(length, density, density)
    for g0, g1, weight in ((1, 0, "w0"), (0, 1, "w1")):
        result = call(model.adjoint, backend, length, density, density, zero + g0, zero + g1, zero)
        for name, value in zip(("w0", "w1"), result[:2], strict=True):
            np.testing.assert_allclose(value, expected[name], rtol=tolerance, err_msg=name)
        np.testing.assert_allclose(result[2], expected["T1"], rtol=0, atol=tolerance)
        error = np.abs(result[3] - expected[f"{weight}_length"])
        assert (error / (expected["w0_length"] + expected["T1"])).max() <= tolerance
        total = expected[f"{weight}_s0"] + expected[f"{weight}_s1"]
        scale = expected["w0_s0"] + length * expected["T1"]
        assert (np.abs(result[4] + result[5] - total) / scale).max() <= tolerance


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("piece", ["g0", "g1", "gt"])
def test_each_piece_of_the_adjoint_matches_finite_differences(model, piece):
    random = np.random.default_rng(7)
    depth, s0, s1 = 10.0 ** random.uniform(-5, 1.3, 400), *random.uniform(0.05, 1, (2, 400))
    if isinstance(model, ConstantPerCell):
        s1 = s0
    inputs = [2 * depth / (s0 + s1), s0, s1]
    seeds = [random.normal(size=400) * (name == piece) for name in ("g0", "g1", "gt")]

    def loss(values):
        w0, w1, transmittance = call(model.weights, DOUBLE, *values)
        return seeds[0] * w0 + seeds[1] * w1 + seeds[2] * np.log(transmittance)

    result = call(model.adjoint, DOUBLE, *inputs, *seeds)
    for value, expected in zip(result[:3], call(model.weights, DOUBLE, *inputs), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-14)
    for k in range(3):
        step = 1e-5 * inputs[k]
        upper, lower = ([x + sign * step * (j == k) for j, x in enumerate(inputs)] for sign in (1, -1))
        difference = (loss(upper) - loss(lower)) / (2 * step)
        if isinstance(model, ConstantPerCell) and k == 2:
            difference = np.zeros_like(depth)
        # Rounding of the loss, in units of its derivative with respect to the logarithm of the input.
        np.testing.assert_array_less(np.abs(result[3 + k] - difference) * inputs[k], 1e-7 * depth + 1e-10)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("backend", [SINGLE, DOUBLE])
def test_energy_is_conserved_and_everything_finite(model, backend):
    dtype = np.float64 if backend.is_double else np.float32
    length, s0, s1 = crossings(2000, seed=8, dtype=dtype)
    length, s0, s1 = (
        np.concatenate([x, extra]) for x, extra in zip((length, s0, s1), EDGES.astype(dtype), strict=True)
    )
    one = np.ones_like(length)
    result = call(model.adjoint, backend, length, s0, s1, one, -one, 2 * one)
    assert all(np.isfinite(value).all() for value in result)
    w0, w1, transmittance = result[:3]
    np.testing.assert_allclose(w0 + w1 + transmittance, 1, atol=1e-14 if backend.is_double else 1e-6)
    assert min(w0.min(), w1.min(), transmittance.min()) >= 0


EDGES = np.array([[0, 1, 1], [1, 0, 0], [0, 0, 0], [1e10, 1, 0], [1e10, 0, 1], [1e-30, 1, 1]]).T


def test_invalid_number_of_subsegments():
    for count in (0, 257):
        with pytest.raises(DiffTetError, match="from 1 to 256"):
            SubSegments(count)


def test_models_are_hashable_keys():
    assert len({ExactLinear(), ExactLinear(), SubSegments(4), SubSegments(4), SubSegments(5), ConstantPerCell()}) == 4
