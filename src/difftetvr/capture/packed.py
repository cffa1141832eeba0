"""Images in memory: as bytes, a quarter of the memory of floats, which photographs do not fill, or each of its size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch


@dataclass(frozen=True, eq=False)
class PackedImages:
    """Images or alphas of 8 bits a value that look like a float32 tensor when they are taken.

    ``packed[view]`` unpacks one view, so a capture of hundreds of photographs never exists in floats as a whole.

    Attributes:
        data: uint8 values on the CPU, (N, H, W, 3) images or (N, H, W) alphas; 255 stands for 1.
    """

    data: torch.Tensor

    def __getitem__(self, index: Any) -> torch.Tensor:
        """Float32 values in [0, 1] of what the index selects, as for a tensor."""
        return unpacked(self.data[index])

    def __len__(self) -> int:
        return len(self.data)

    def __iter__(self) -> Iterator[torch.Tensor]:
        return (self[view] for view in range(len(self)))

    @property
    def shape(self) -> torch.Size:
        """Shape of the whole."""
        return self.data.shape

    @property
    def dtype(self) -> torch.dtype:
        """Type of the values that are taken."""
        return torch.float32

    def mean(self, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        """Mean of all values, a scalar."""
        means = torch.stack([view.to(torch.float64).mean() for view in self.data])
        return (means.mean() / 255.0).to(dtype)


@dataclass(frozen=True, eq=False)
class MixedImages:
    """Images, alphas or masks of several sizes, which are taken one by one: ``mixed[view]``.

    Attributes:
        data: N tensors on the CPU, (H, W, 3) images or (H, W) alphas or masks, each with a size of its own. uint8
            values are unpacked to float32 when they are taken, 255 to 1; others are as they are.
    """

    data: tuple[torch.Tensor, ...]

    def __getitem__(self, view: int) -> torch.Tensor:
        """The values of one view."""
        return unpacked(self.data[view])

    def __len__(self) -> int:
        return len(self.data)

    def __iter__(self) -> Iterator[torch.Tensor]:
        return (self[view] for view in range(len(self)))

    def mean(self, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        """Mean of all values, a scalar."""
        total = sum(float(view.to(torch.float64).sum()) for view in self)
        return torch.tensor(total / sum(view.numel() for view in self.data), dtype=dtype)


Images: TypeAlias = torch.Tensor | PackedImages | MixedImages
"""Images or alphas of N views, which ``images[view]`` takes as float32."""

Masks: TypeAlias = torch.Tensor | MixedImages
"""Masks of N views, which ``masks[view]`` takes as bool."""


def shapes_of(values: Images) -> list[tuple[int, ...]]:
    """The shape of each view's values."""
    if isinstance(values, MixedImages):
        return [tuple(view.shape) for view in values.data]
    return [tuple(values.shape[1:])] * (values.shape[0] if values.shape else 0)


def stored(values: Images | Masks, view: int) -> torch.Tensor:
    """The values of a view as they are kept, without a copy: bytes, float32, or the bools of masks."""
    return values[view] if isinstance(values, torch.Tensor) else values.data[view]


def unpacked(values: torch.Tensor) -> torch.Tensor:
    """Values as they are taken: float32 of bytes, 1 of 255, on the device of these; others are as they are."""
    if values.dtype != torch.uint8:
        return values
    # A number of Python's, PyTorch would turn into a product on a GPU, which rounds otherwise than the quotient.
    return values.to(torch.float32) / torch.full((), 255.0, device=values.device)
