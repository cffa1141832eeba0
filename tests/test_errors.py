"""What stands in the sentences of errors."""

import math

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.errors import DiffTetError, listed, shown
from difftetvr.fitting import FitConfig
from difftetvr.mesh import TetMesh


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (torch.tensor([1.0, 2.5], requires_grad=True), "[1.0, 2.5]"),
        (torch.tensor(3), "3"),
        (np.float32(0.5), "0.5"),
        (np.zeros((2, 2)), "[[0.0, 0.0], [0.0, 0.0]]"),
        ((torch.tensor(1.0), torch.tensor(math.nan)), "(1.0, nan)"),
        ((torch.tensor(1),), "(1,)"),
        (torch.zeros(100, 3), "a tensor of shape (100, 3)"),
        (np.zeros((100, 3)), "an array of shape (100, 3)"),
        (torch.zeros(2, 0), "a tensor of shape (2, 0)"),
        (torch.zeros(3, device="meta"), "a tensor of shape (3,)"),
        ("grey", "'grey'"),
        (None, "None"),
        ((1.5, True), "(1.5, True)"),
        (list(range(20)), "[0, 1, 2, 3, 4, 5, 6, 7, ...]"),
        (dtv.TransferFunction.default(), "a TransferFunction"),
        (dtv.Camera, "the class Camera"),
        ("two\nlines", r"'two\nlines'"),
        (10**50, "a huge number"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_values_are_shown_as_numbers(value, text):
    assert shown(value) == text


def test_lists():
    assert (listed(["a"]), listed(["a", "b"]), listed(("a", "b", "c"), "or")) == ("a", "a and b", "a, b or c")


def camera():
    return dtv.Camera.look_at((3, 0, 0), (0, 0, 0), width=2, height=2)


WRONG = [
    lambda t: TetMesh.grid((1, 1, 1), t, t),
    lambda t: TetMesh.grid(-t, (0, 0, 0), (1, 1, 1)),
    lambda t: dtv.Camera(torch.eye(4), t, 1.0, 1.0, 1.0, 2, 2),
    lambda t: dtv.Camera(torch.eye(4), 1.0, 1.0, 1.0, 1.0, t, 2),
    lambda t: dtv.ScalarField(torch.rand(8), dtv.TransferFunction.default(), 1.0, (t[1], t[0])),
    lambda t: dtv.ScalarField(torch.rand(8), dtv.TransferFunction.default(), -t[0], (0, 1)),
    lambda t: FitConfig(rate=-t[0]),
    lambda t: dtv.render(TetMesh.grid((1, 1, 1)), dtv.Field(torch.rand(8, 3), torch.rand(8)), camera(), background=t),
    lambda t: dtv.render(TetMesh.grid((1, 1, 1)), dtv.Field(torch.rand(8, 3), torch.rand(8)), camera(), clip_plane=t),
]


@pytest.mark.parametrize("wrong", WRONG, ids=range(len(WRONG)))
def test_sentences_hold_no_reprs_of_tensors(wrong):
    with pytest.raises(DiffTetError) as caught:
        wrong(torch.tensor([1.0, 2.0]))
    assert "tensor(" not in str(caught.value) and "\n" not in str(caught.value)
