"""LPIPS: what is handed to the packages that compute it, and what is said where they or their weights are missing.

The packages are stood in for: what they are asked is checked, not what they answer.
"""

import importlib.machinery
import sys
import types

import pytest
import torch

from difftetvr.errors import FitError
from difftetvr.fitting.records import perceptual
from difftetvr.fitting.records.evaluation import rendered_image, true_image
from difftetvr.mesh import Field, TetMesh


def module(name, **contents):
    made = types.ModuleType(name)
    made.__spec__ = importlib.machinery.ModuleSpec(name, None)
    vars(made).update(contents)
    return made


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A torchvision whose weights are there or not: the file of those of AlexNet."""
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    urls = {
        "AlexNet_Weights": "https://weights.example/alex-1.pth",
        "VGG16_Weights": "https://weights.example/vgg-1.pth",
    }
    kinds = {
        name: types.SimpleNamespace(IMAGENET1K_V1=types.SimpleNamespace(url=address)) for name, address in urls.items()
    }
    models = module("torchvision.models", **kinds)
    monkeypatch.setitem(sys.modules, "torchvision", module("torchvision", models=models))
    monkeypatch.setitem(sys.modules, "torchvision.models", models)
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    return folder / "alex-1.pth"


@pytest.fixture
def asked(monkeypatch):
    """What the package lpips is asked, in order."""
    questions = []

    class Stub:
        def __init__(self, net, verbose):
            questions.append(net)

        def __call__(self, image, truth, normalize):
            questions.append((image, truth, normalize, torch.is_grad_enabled()))
            return (image - truth).abs().mean().reshape(1, 1, 1, 1)

    monkeypatch.setitem(sys.modules, "lpips", module("lpips", LPIPS=Stub))
    return questions


@pytest.fixture(scope="module")
def scene(small_capture):
    mesh = TetMesh.grid((2, 2, 2), *small_capture.bounds.tolist())
    return mesh, Field(torch.rand(27, 3, generator=torch.Generator().manual_seed(1)), torch.full((27,), 2.0))


def test_views_are_compared_as_they_are_shown(small_capture, scene, weights, asked, monkeypatch):
    weights.touch()
    monkeypatch.setitem(perceptual._LEAST_SIDE, "alex", 8)
    found = perceptual.lpips_of(*scene, small_capture, [2, 7], "alex")
    assert asked[0] == "alex" and len(asked) == 3
    for view, value, (image, truth, is_in_0_1, learns) in zip((2, 7), found, asked[1:], strict=True):
        assert image.shape == truth.shape == (1, 3, 24, 24) and is_in_0_1 and not learns
        expected = rendered_image(*scene, small_capture, view), true_image(small_capture, view)
        assert torch.equal(image[0].permute(1, 2, 0), expected[0].clamp(0, 1))
        assert torch.equal(truth[0].permute(1, 2, 0), expected[1].clamp(0, 1))
        assert value == pytest.approx(float((expected[0].clamp(0, 1) - expected[1].clamp(0, 1)).abs().mean()))


def test_too_small_images_are_refused(small_capture, scene, weights, asked):
    weights.touch()
    with pytest.raises(FitError, match="images of at least 31 pixels a side, and 'tooth' has some of 24; leave it out"):
        perceptual.lpips_of(*scene, small_capture, [2], "alex")
    assert not asked


def test_missing_weights_are_named_and_not_fetched(weights, asked):
    sentence = f"LPIPS by alex needs the weights alex-1.pth in {weights.parent}; put https://weights.example/alex-1.pth"
    with pytest.raises(FitError) as caught:
        perceptual.require_lpips("alex")
    assert str(caught.value) == f"{sentence} there."


def test_missing_packages_are_named(weights, monkeypatch):
    monkeypatch.setattr(perceptual.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FitError, match=r"not all of that is installed; pip install 'difftetvr\[lpips\]'"):
        perceptual.require_lpips("vgg")


def test_a_torchvision_for_another_pytorch_is_told(asked, monkeypatch, tmp_path):
    (tmp_path / "torchvision.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "torchmetrics", None)
    with pytest.raises(FitError, match=r"does not run beside PyTorch .* \(operator torchvision::nms does not exist\)"):
        perceptual.require_lpips("alex")
