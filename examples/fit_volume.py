"""From a scan to a mesh
=====================

The built-in CT scan of a tooth, reconstructed from rendered views of it: ``difftetvr fit``, from Python. Views and
cells are few here, so that it takes seconds.
"""

import sys
from pathlib import Path

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# Cameras on a sphere and their pictures; every fifth is held out. A volume of your own:
# ``VolumeCapture(path="scan.nrrd", transfer_function="tf.json")``.

capture = dtv.VolumeCapture(path="tooth", views=20, width=64, height=64).build()

# %%
# Colours, densities and vertices are optimised, and the mesh is refined on the way.

result = dtv.fit(capture, dtv.FitConfig(cells=5_000, iterations=150))
print(f"Held-out PSNR {result.metrics['psnr']:.2f} dB with {result.mesh.num_cells} cells")

# %%
# A held-out view, larger than those it learned from, and a cut through the mesh.

view = int(capture.test_indices[0])
image = dtv.render(result.mesh, result.field, capture.cameras[view].with_size(384, 384))
dtv.view.save_png(folder / "fit_volume.png", image.color)
dtv.view.cut.cut_picture(result.mesh, result.field, size=384).save(folder / "fit_volume_cut.png")
dtv.save(folder / "fit_volume.vtu", result.mesh, result.field)
