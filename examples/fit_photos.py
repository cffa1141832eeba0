"""From photographs to a mesh
==========================

A folder of images and a ``cameras.json`` are enough. Here they are made by rendering the built-in scan.
"""

import json
import sys
from pathlib import Path

import torch

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
photos = folder / "photos"
photos.mkdir(parents=True, exist_ok=True)

# %%
# What your own cameras would give: images, and where each of them was taken.

views = dtv.VolumeCapture(path="tooth", views=32, width=64, height=64).build()
cameras = []
for index, camera in enumerate(views.cameras):
    name = f"{index:03}.png"
    dtv.view.save_png(photos / name, views.images[index])
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    cameras.append({"image": name, "world_to_camera": camera.world_to_camera.tolist(), **intrinsics})
(photos / "cameras.json").write_text(json.dumps({"format": "difftetvr-cameras", "cameras": cameras}))

# %%
# Or your own: ``load_capture("garden", downscale=4)``, a folder of NeRF-synthetic, transforms.json or COLMAP.

capture = dtv.load_capture(photos)
result = dtv.fit(capture, dtv.FitConfig(cells=5_000, iterations=150))
print(f"Held-out PSNR {result.metrics['psnr']:.2f} dB with {result.mesh.num_cells} cells")

# %%
# A picture from where no camera was.

middle = capture.bounds.mean(0)
eye = middle + torch.tensor([0.6, -1.0, 0.5])
camera = dtv.Camera.look_at(eye, target=middle, width=384, height=384)
dtv.view.save_png(folder / "fit_photos.png", dtv.render(result.mesh, result.field, camera).color)
dtv.save(folder / "fit_photos.vtu", result.mesh, result.field)
