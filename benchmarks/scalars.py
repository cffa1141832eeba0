"""Scalars behind a known transfer function, from images of the Tooth: seen through it, and through another one.

    python benchmarks/scalars.py [--cells 20000] [--iterations 2400] [--report FOLDER]

Rows: the scan itself on a uniform grid of as many cells; colours and densities fitted to the same images; scalars that
begin with what looks like these, and scalars that begin with the same everywhere. All meshes but the first move and
exchange cells, and each row's run has as many iterations in all. PSNR is of the held-out views, through the function
that made the images and through one that no run has seen, with other colours, and opaque where the other has a valley.
Colours and densities are as they are and cannot be seen through another function.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.fitting import evaluate
from difftetvr.inverse import ScalarConfig, fit_scalar, volume_on_grid
from difftetvr.view.pictures import beside, labelled, save_picture, to_picture

UNSEEN = dtv.TransferFunction(
    torch.tensor([0.0, 0.33, 0.435, 0.545, 0.665, 0.73, 1.0]),
    torch.tensor([0.0, 0.0, 0.06, 0.2, 0.12, 0.3, 0.9]),
    torch.tensor(
        [[0, 0, 0], [0, 0.2, 0.6], [0.1, 0.5, 0.9], [0.2, 0.8, 0.5], [0.9, 0.8, 0.2], [0.9, 0.3, 0.1], [1.0, 0.9, 0.8]]
    ),
)
"""Shows no scalar that the Tooth's own function hides: of these, no image tells anything."""


def unseen_capture(seen: dtv.Capture, folder: Path) -> dtv.Capture:
    """The same views of the scan through the other function."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "unseen.json"
    UNSEEN.save(file)
    return dtv.VolumeCapture(transfer_function=str(file), views=len(seen.cameras)).build()


class Table:
    """Prints a row for each result, with pictures of one view."""

    def __init__(self, seen: dtv.Capture, unseen: dtv.Capture) -> None:
        self.seen, self.unseen = seen, unseen
        self.views = seen.test_indices.tolist()
        self.view = view = self.views[len(self.views) // 2]
        self.panels = [[("truth", seen.images[view])], [("truth, unseen function", unseen.images[view])]]
        print("| | cells | held out, dB | through the unseen function, dB | s |\n|---|---|---|---|---|", flush=True)

    def add(self, name: str, mesh: dtv.TetMesh, field: dtv.Field | dtv.ScalarField, seconds: float | None) -> None:
        """Compares a reconstruction with both captures."""
        fields = {0: field}
        if isinstance(field, dtv.ScalarField):
            fields[1] = dtv.ScalarField(field.scalar, UNSEEN, field.attenuation, (0.0, 1.0))
        psnr = {
            k: evaluate(mesh, shown, (self.seen, self.unseen)[k], self.views).mean_psnr for k, shown in fields.items()
        }
        for k, shown in fields.items():
            with torch.no_grad():
                image = dtv.render(mesh, shown, self.seen.cameras[self.view]).color
            self.panels[k].append((name, image))
        cells = f"{mesh.num_cells:,}".replace(",", " ")
        told = [f"{psnr[k]:.2f}" if k in psnr else "" for k in (0, 1)]
        print(f"| {name} | {cells} | {told[0]} | {told[1]} | {'' if seconds is None else round(seconds)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=20_000)
    parser.add_argument("--iterations", type=int, default=2400)
    parser.add_argument("--total-variation", type=float, default=ScalarConfig().total_variation)
    parser.add_argument("--report", type=Path, default=Path("out/scalars"))
    options = parser.parse_args()
    source = dtv.VolumeCapture()
    (volume, function), seen = source.load_volume(), source.build()
    table = Table(seen, unseen_capture(seen, options.report))
    grid, values = volume_on_grid(volume, options.cells)
    table.add("the scan on a grid", grid, dtv.ScalarField(values, function, source.attenuation, (0.0, 1.0)), None)
    start = time.perf_counter()
    colors = dtv.fit(seen, dtv.FitConfig(cells=options.cells, iterations=options.iterations, evaluate_every=0))
    table.add("colours and densities", colors.mesh, colors.field, time.perf_counter() - start)
    first = 2 * options.iterations // 5
    for name, colors_first in (("scalars, from colours and densities", first), ("scalars, from one everywhere", 0)):
        config = ScalarConfig(
            cells=options.cells,
            iterations=options.iterations - colors_first,
            colors_first=colors_first,
            total_variation=options.total_variation,
            evaluate_every=0,
        )
        start = time.perf_counter()
        found = fit_scalar(seen, function, config, attenuation=source.attenuation)
        table.add(name, found.mesh, found.field, time.perf_counter() - start)
    for name, panels in zip(("seen", "unseen"), table.panels):
        save_picture(
            options.report / f"{name}.png", beside([labelled(to_picture(image), label) for label, image in panels])
        )


if __name__ == "__main__":
    main()
