"""Reconstruct the built-in Tooth scan from rendered views, from Python instead of the command line."""

import sys
from pathlib import Path

import difftetvr as dtv
from difftetvr.view.pictures import save_png


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    # A volume of your own: VolumeCapture(path="scan.nrrd", transfer_function="tf.json").
    capture = dtv.VolumeCapture(path="tooth", views=20, width=64, height=64).build()
    result = dtv.fit(capture, dtv.FitConfig(cells=5_000, iterations=150))

    view = int(capture.test_indices[0])
    image = dtv.render(result.mesh, result.field, capture.cameras[view].with_size(256, 256))
    save_png(folder / "fit_volume.png", image.color)
    dtv.save(folder / "fit_volume.vtu", result.mesh, result.field)
    print(f"Held-out PSNR {result.metrics['psnr']:.2f} dB with {result.mesh.num_cells} cells; wrote {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
