"""What is to be written of which data, for grids and surfaces."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from difftetvr.cli.saved import SavedRun, saved_beside
from difftetvr.errors import MeshError, counted

if TYPE_CHECKING:
    import torch
    from rich.console import Console

    from difftetvr.mesh.io import MeshData, Scalar

_MOST_ROUNDED = 1e-5  # of the range of an array: what rounding to float32 may change


@dataclass(frozen=True)
class Job:
    """What is written.

    Attributes:
        model: The mesh's file.
        output: The file to write.
        names: Of the data that were asked for.
        data: What the mesh's file holds.
        console: Where to say what there is to know.
    """

    model: Path
    output: Path
    names: tuple[str, ...]
    data: MeshData
    console: Console

    @property
    def run(self) -> SavedRun | None:
        """The run that the mesh is the result of, as far as its folder tells."""
        return saved_beside(self.model)

    def of_field(self, name: str | None) -> str | None:
        """A name by which data of the field are found where vertices and cells have some of that name."""
        from difftetvr.mesh.io import FIELD_ARRAYS

        field = self.data.field
        if field is None or name not in FIELD_ARRAYS:
            return name
        return f"{'point' if field.location_on(self.data.mesh) == 'vertex' else 'cell'}:{name}"

    @contextlib.contextmanager
    def naming_model(self) -> Iterator[None]:
        """Context in which sentences about data say whose these are."""
        try:
            yield
        except MeshError as error:
            raise MeshError(f"{self.model}: {error}") from error

    def say_missing(self, scalar: Scalar) -> None:
        """Prints which cells were left out."""
        if scalar.missing:
            cells = counted(scalar.missing, "cell")
            verb = "was" if scalar.missing == 1 else "were"
            self.say(f"'{scalar.name}' has no finite value in {cells}, which {verb} left out.")

    def say(self, sentence: str) -> None:
        """Prints a line."""
        self.console.print(sentence, highlight=False)


def dtype_for(arrays: Sequence[torch.Tensor]) -> torch.dtype | None:
    """float64 where float32 would round an array by much of its range; None where a mesh may stay what it is."""
    import torch

    for values in arrays:
        if values.dtype == torch.float64:
            least, greatest = values.aminmax()
            rounding = (values - values.float()).abs().amax()
            if not bool(rounding <= _MOST_ROUNDED * (greatest - least)):
                return torch.float64
    return None
