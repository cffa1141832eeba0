"""Images kept as bytes: a quarter of the memory of floats, which photographs do not fill."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
        return self.data[index].to(torch.float32) / 255.0

    def __len__(self) -> int:
        return len(self.data)

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
