"""Captures that say nothing about a scene are named as that, instead of being fitted to a PSNR that says nothing."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import difftetvr as dtv
from difftetvr.capture import Capture, MixedImages, PackedImages, fibonacci_orbit
from difftetvr.capture.degenerate import why_degenerate
from difftetvr.errors import CaptureError

COUNT = 4


def example(**changes) -> Capture:
    content = {
        "cameras": fibonacci_orbit(COUNT, width=6, height=5),
        "images": torch.rand(COUNT, 5, 6, 3, generator=torch.Generator().manual_seed(0)),
        "alphas": None,
        "test": torch.tensor([False, True, False, False]),
        "bounds": torch.tensor([[-0.5] * 3, [0.5] * 3]),
        "name": "example",
        **changes,
    }
    return Capture(**content)


WHITE = torch.ones(COUNT, 5, 6, 3)
BLACK = torch.zeros(COUNT, 5, 6, 3)
BYTES = torch.full((COUNT, 5, 6, 3), 255, dtype=torch.uint8)
NOISE = torch.randint(254, 256, (COUNT, 5, 6, 3), dtype=torch.uint8)
ONE = torch.tensor([False, True, True, True])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": WHITE}, r"shows one colour only, such as \(1, 1, 1\), .* check the transfer function"),
        ({"images": BLACK, "alphas": BLACK[..., 0]}, r"one colour only, such as \(0, 0, 0\)"),
        ({"images": PackedImages(BYTES), "encoding": "srgb"}, r"one colour only, .*; check the images"),
        ({"images": PackedImages(NOISE), "encoding": "srgb"}, "one colour only"),
        ({"images": torch.linspace(0, 1, COUNT)[:, None, None, None].expand(COUNT, 5, 6, 3)}, "one colour only"),
        ({"images": MixedImages(tuple(WHITE)), "alphas": MixedImages(tuple(WHITE[..., 0]))}, "one colour only"),
        ({"test": ONE}, "one view to train on, .* give two at least"),
        ({"cameras": [fibonacci_orbit(COUNT, width=6, height=5)[0]] * COUNT}, "taken from one place"),
        ({"valid": BLACK[..., 0] > 0}, "masks of 'example' exclude all pixels"),
    ],
)
def test_degenerate_captures_are_refused(changes: dict, message: str) -> None:
    capture = example(**changes)
    with pytest.raises(CaptureError, match=message) as error:
        dtv.fit(capture, dtv.FitConfig(iterations=1, cells=50, device="cpu", loss="l2"))
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


def test_others_are_not() -> None:
    assert why_degenerate(example()) is None
    one_pixel = BLACK.clone()
    one_pixel[3, 2, 4, 1] = 1e-3  # faint, but linear light is exact
    assert why_degenerate(example(images=one_pixel)) is None
    held_out = BLACK.clone()
    held_out[1] = torch.rand(5, 6, 3)
    assert "one colour" in why_degenerate(example(images=held_out))
    # A black silhouette on black is one.
    silhouette = example(images=BLACK, alphas=torch.rand(COUNT, 5, 6))
    assert why_degenerate(silhouette) is None
    # What is masked does not count.
    masked = dataclasses.replace(example(images=one_pixel), valid=one_pixel[..., 1] == 0)
    assert "one colour" in why_degenerate(masked)


def test_info_says_it() -> None:
    import io

    from rich.console import Console

    from difftetvr.view.describe import capture_table

    console = Console(width=200, record=True, file=io.StringIO())
    console.print(capture_table("white", example(images=WHITE)))
    assert "degenerate" in console.export_text()
