"""What the renderers' tests share: scenes as meshes and fields, and the gradients of a random linear loss."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from oracle.oracle import OracleImage, render_oracle
from oracle.scenes import Scene
from torch import Tensor

from difftetvr.mesh import Field, TetMesh
from difftetvr.rendering import RenderedImage, render
from difftetvr.rendering.cameras.pinhole import Camera

LEAVES = ("vertices", "color", "density", "pose", "background")


@dataclass(frozen=True)
class LossWeights:
    """A loss that is a random linear function of an image, so that every pixel and channel counts."""

    color: Tensor
    alpha: Tensor
    depth: Tensor

    @staticmethod
    def random(reference: OracleImage, size: float, seed: int = 0) -> LossWeights:
        """Weights for one scene; depth is weighed by the mesh's ``size`` and only where the volume is visible.

        Where next to nothing is absorbed, expected depth is a quotient of two roundings.
        """
        generator = torch.Generator().manual_seed(seed)
        color = torch.randn(reference.color.shape, generator=generator, dtype=torch.float64)
        alpha = torch.randn(reference.alpha.shape, generator=generator, dtype=torch.float64)
        depth = torch.randn(reference.depth.shape, generator=generator, dtype=torch.float64)
        return LossWeights(color, alpha, depth * (reference.alpha.detach() > 0.05) / size)

    def __call__(self, image: Any) -> Tensor:
        """The loss of a rendered or of a reference image."""
        pairs = ((self.color, image.color), (self.alpha, image.alpha), (self.depth, image.depth))
        return torch.stack([(weight.to(output.dtype) * output).sum() for weight, output in pairs]).sum()


def leaves_of(scene: Scene, dtype: torch.dtype, requires_grad: Iterable[str] = ()) -> dict[str, Tensor]:
    """The scene's differentiable tensors as fresh leaves; black background where the scene has none."""
    background = torch.zeros(3) if scene.background is None else scene.background
    tensors = (scene.vertices, scene.color, scene.density, scene.camera.world_to_camera, background)
    return {
        name: tensor.to(dtype).clone().requires_grad_(name in requires_grad)
        for name, tensor in zip(LEAVES, tensors, strict=True)
    }


def render_leaves(
    scene: Scene, leaves: dict[str, Tensor], mesh: TetMesh | None = None, **options: Any
) -> RenderedImage:
    """Render leaves made by :func:`leaves_of`, on ``mesh``'s topology if it is given."""
    mesh = TetMesh(leaves["vertices"], scene.tets) if mesh is None else mesh.with_vertices(leaves["vertices"])
    field = Field(leaves["color"], leaves["density"], "cell" if scene.per_cell else "vertex")
    camera = scene.camera.with_pose(leaves["pose"])
    return render(mesh, field, camera, background=leaves["background"], **options)


def oracle_leaves(scene: Scene, leaves: dict[str, Tensor]) -> OracleImage:
    """The reference image of leaves made by :func:`leaves_of`."""
    camera = scene.camera.with_pose(leaves["pose"])
    fields = leaves["color"], leaves["density"], camera, leaves["background"]
    return render_oracle(leaves["vertices"], scene.tets, *fields, scene.per_cell)


def render_scene(scene: Scene, dtype: torch.dtype = torch.float32, **options: Any) -> RenderedImage:
    """The scene's image without gradients."""
    return render_leaves(scene, leaves_of(scene, dtype), **options)


def gradients(scene: Scene, dtype: torch.dtype, weights: LossWeights | None = None) -> dict[str, Tensor]:
    """Gradients of the random loss to all leaves, rendered at the given precision."""
    weights = weights or LossWeights.random(scene.oracle(), scene.size)
    leaves = leaves_of(scene, dtype, LEAVES)
    weights(render_leaves(scene, leaves)).backward()
    return {name: _gradient(leaf) for name, leaf in leaves.items()}


@functools.lru_cache(maxsize=100)
def oracle_gradients(scene: Scene) -> tuple[LossWeights, dict[str, Tensor]]:
    """The random loss of a scene and its reference gradients."""
    leaves = leaves_of(scene, torch.float64, LEAVES)
    image = oracle_leaves(scene, leaves)
    weights = LossWeights.random(image, scene.size)
    weights(image).backward()
    return weights, {name: _gradient(leaf) for name, leaf in leaves.items()}


def resized(scene: Scene, width: int, height: int) -> Scene:
    """The same scene at another resolution."""
    return replace(scene, camera=scene.camera.with_size(width, height))


def in_double(camera: Camera) -> Camera:
    """The camera with float64 extrinsics."""
    return camera.with_pose(camera.world_to_camera.double())


def _gradient(leaf: Tensor) -> Tensor:
    assert leaf.grad is not None
    return leaf.grad


def assert_sentence(error: BaseException) -> None:
    """One line that ends in a full stop and is of a readable length."""
    text = str(error)
    assert text.endswith(".") and "\n" not in text and 20 < len(text) < 300, text
