"""Transfer functions: values, gradients, files, and one-sentence errors."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import torch

from difftetvr.errors import CaptureError
from difftetvr.optics.transfer_function import TransferFunction

KNOTS = {
    "scalar": [0.125, 0.375, 0.375, 0.875],
    "opacity": [0.0, 0.5, 0.2, 1.0],
    "color": [[0, 0, 0], [1, 0.5, 0], [0, 0, 1], [2, 1, 0.5]],
}
XML = """<TransferFunction colorspace="sRGB" interpolation_colorspace="Linear RGB">
    <OpacityPoints>
        <OpacityPoint position="0" opacity="0"/>
        <OpacityPoint position="0.5" opacity="1"/>
        <OpacityPoint position="0.5" opacity="0.25"/>
        <OpacityPoint position="1" opacity="0.75"/>
    </OpacityPoints>
    <ColorPoints{attribute}>
        <ColorPoint position="0" r="0" g="0" b="0"/>
        <ColorPoint position="0.25" r="{full}" g="0" b="0"/>
        <ColorPoint position="1" r="{full}" g="{full}" b="0"/>
    </ColorPoints>
</TransferFunction>
"""


def one_sentence(error: pytest.ExceptionInfo[CaptureError]) -> bool:
    return "\n" not in str(error.value) and str(error.value).endswith(".")


def test_values_between_at_and_outside_knots() -> None:
    function = TransferFunction(**KNOTS)
    color, opacity = function(np.array([[0.0, 0.125, 0.25], [0.375, 0.625, 1.0]]))
    assert opacity.dtype == np.float64
    np.testing.assert_allclose(opacity, [[0, 0, 0.25], [0.2, 0.6, 1.0]], atol=1e-7)
    np.testing.assert_allclose(color[0, 2], [0.5, 0.25, 0], atol=1e-7)
    np.testing.assert_allclose(color[1], [[0, 0, 1], [1, 0.5, 0.75], [2, 1, 0.5]], atol=1e-7)


def test_agrees_with_numpy_interp() -> None:
    random = np.random.default_rng(0)
    scalar = np.sort(random.random(20))
    function = TransferFunction(
        torch.tensor(scalar), torch.tensor(random.random(20)), torch.tensor(random.random((20, 3)))
    )
    at = random.random(1000)
    color, opacity = function(at)
    np.testing.assert_allclose(opacity, np.interp(at, scalar, function.opacity.numpy()), atol=1e-12)
    for channel in range(3):
        np.testing.assert_allclose(
            color[:, channel], np.interp(at, scalar, function.color[:, channel].numpy()), atol=1e-12
        )


def test_gradients_reach_scalars_and_knots() -> None:
    knots = [torch.tensor(v, dtype=torch.float64) for v in ([0.1, 0.4, 0.9], [0.1, 0.5, 0.9], np.eye(3) + 0.5)]
    at = torch.tensor([0.15, 0.3, 0.5, 0.8], dtype=torch.float64)

    def evaluate(scalar: torch.Tensor, opacity: torch.Tensor, color: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
        color, opacity = TransferFunction(scalar, opacity, color)(at)
        return torch.cat([color, opacity[:, None]], dim=1)

    assert torch.autograd.gradcheck(evaluate, tuple(v.requires_grad_() for v in (*knots, at)))


def test_transparent_intervals_match_dense_sampling() -> None:
    function = TransferFunction([0.0, 0.3, 0.5, 0.6, 0.6, 0.8], [0, 0, 0.5, 0, 0.2, 0], np.ones((6, 3)))
    ends = np.sort(np.random.default_rng(1).random((60, 2)), axis=1)
    ends = np.concatenate([ends, [[0.0, 0.3], [0.3, 0.3], [0.6, 0.6], [0.55, 0.6], [0.8, 1.0], [0.79, 1.0]]])
    expected = [not (function(np.linspace(low, high, 1001))[1] > 0).any() for low, high in ends]
    np.testing.assert_array_equal(function.is_transparent(ends[:, 0], ends[:, 1]), expected)
    assert any(expected) and not all(expected)


def test_packaged_tooth_function_takes_stored_colors() -> None:
    from difftetvr.capture import VolumeCapture

    _, function = VolumeCapture().load_volume()
    color, opacity = function(np.array([0.43534138798713684, 0.7287114858627319]))
    np.testing.assert_allclose(opacity, [0.42, 1.0], atol=1e-6)
    np.testing.assert_allclose(color[1], [0.0882354, 0.2276888, 1.0], atol=1e-6)


def test_json_round_trip_is_exact(tmp_path) -> None:
    function = TransferFunction(**KNOTS, name="shells")
    function.save(tmp_path / "f.json")
    again = TransferFunction.load(tmp_path / "f.json")
    assert again.name == "shells"
    for key in ("scalar", "opacity", "color"):
        assert torch.equal(getattr(again, key), getattr(function, key))
    assert [p.name for p in tmp_path.iterdir()] == ["f.json"]


@pytest.mark.parametrize(
    ("attribute", "full"),
    [("", 255), (' color_data="ubyte"', 255), (' color_data="ushort"', 65535), (' color_data="float"', 1.0)],
)
def test_xml_merges_opacity_and_color_points(tmp_path, attribute: str, full: float) -> None:
    path = tmp_path / "f.xml"
    path.write_text(XML.format(attribute=attribute, full=full))
    color, opacity = TransferFunction.load(path)(np.array([0.125, 0.25, 0.4999, 0.5, 0.625, 1.0]))
    np.testing.assert_allclose(opacity, [0.25, 0.5, 0.9998, 0.25, 0.375, 0.75], atol=1e-6)
    np.testing.assert_allclose(color[:, 0], [0.5, 1, 1, 1, 1, 1], atol=1e-6)
    np.testing.assert_allclose(color[:, 1], [0, 0, 0.2499 / 0.75, 1 / 3, 0.5, 1], atol=1e-6)


def test_xml_and_json_of_the_same_function_agree(tmp_path) -> None:
    function = TransferFunction([0.0, 0.4, 1.0], [0.0, 0.5, 1.0], np.eye(3))
    points = "".join(f'<OpacityPoint position="{s}" opacity="{o}"/>' for s, o in zip([0, 0.4, 1], [0, 0.5, 1]))
    colors = "".join(
        f'<ColorPoint position="{s}" r="{c[0]}" g="{c[1]}" b="{c[2]}"/>' for s, c in zip([0, 0.4, 1], np.eye(3))
    )
    path = tmp_path / "f.xml"
    path.write_text(
        f"<TransferFunction><OpacityPoints>{points}</OpacityPoints>"
        f'<ColorPoints color_data="float">{colors}</ColorPoints></TransferFunction>'
    )
    again = TransferFunction.load(path)
    assert torch.equal(again.scalar, function.scalar) and torch.equal(again.color, function.color)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scalar": []}, "no control points"),
        ({"scalar": [0.1, 0.5, 0.4, 0.9]}, "Control point 2 .* smaller"),
        ({"scalar": [0.1, 0.4, 0.5, 1.1]}, r"Control point 3 .* outside \[0, 1\]"),
        ({"opacity": [0.0, -0.1, 0.2, 1.0]}, "Control point 1 .* opacity"),
        ({"opacity": [0.0, float("nan"), 0.2, 1.0]}, "Control point 1 .* opacity"),
        ({"opacity": [0.0, 0.2, 1.0]}, "4 scalars but opacities"),
        ({"color": [[0, 0, 0], [1, 0, 0], [0, -1, 1], [0, 0, 0]]}, "Control point 2 .* colour"),
    ],
)
def test_invalid_points_are_named(change: dict, message: str) -> None:
    with pytest.raises(CaptureError, match=message) as error:
        TransferFunction(**{**KNOTS, **change})
    assert one_sentence(error)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("f.json", "{", "not valid JSON"),
        ("f.json", "[1, 2]", "no 'scalar' list"),
        ("f.json", json.dumps({"scalar": [0], "opacity": [0]}), "no 'color' list"),
        ("f.json", json.dumps({"scalar": ["x"], "opacity": [0], "color": [[0, 0, 0]]}), "'scalar' .* not a list"),
        ("f.json", json.dumps({"scalar": [0], "opacity": [0], "color": [[0, 0, 0], [1]]}), "'color' .* not a list"),
        ("f.xml", "<TransferFunction>", "not valid XML"),
        ("f.xml", "<Other/>", "root <Other>"),
        ("f.xml", "<TransferFunction/>", "no <OpacityPoint>"),
        ("f.xml", XML.format(attribute=' color_data="half"', full=1), "colours as 'half'"),
        ("f.xml", XML.format(attribute="", full="red"), "<ColorPoint> 1 .* needs numbers"),
        ("f.xml", XML.format(attribute="", full=255).replace('"0.25"', '"-0.25"'), "positions .* decrease"),
        ("f.txt", "", "no transfer function that can be read"),
    ],
)
def test_bad_files_give_one_sentence(tmp_path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(CaptureError, match=message) as error:
        TransferFunction.load(path)
    assert one_sentence(error) and name in str(error.value)


def test_missing_and_binary_files(tmp_path) -> None:
    with pytest.raises(CaptureError, match="Cannot read"):
        TransferFunction.load(tmp_path / "none.json")
    (tmp_path / "binary.xml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(CaptureError, match="not a text file"):
        TransferFunction.load(tmp_path / "binary.xml")
    with pytest.raises(CaptureError, match=re.escape("none")):
        TransferFunction(**KNOTS).save(tmp_path / "none" / "f.json")


@pytest.mark.parametrize("suffix", [".json", ".xml"])
def test_mutated_files_load_or_give_a_capture_error(tmp_path, suffix: str) -> None:
    text = (XML.format(attribute="", full=255) if suffix == ".xml" else json.dumps(KNOTS)).encode()
    random = np.random.default_rng(3)
    path = tmp_path / f"f{suffix}"
    for _ in range(200):
        data = bytearray(text)
        for position in random.integers(0, len(data), 3):
            data[position] = random.integers(0, 256)
        path.write_bytes(bytes(data[: random.integers(0, len(data) + 1)]) if random.random() < 0.3 else bytes(data))
        try:
            TransferFunction.load(path)
        except CaptureError as error:
            assert "\n" not in str(error)
