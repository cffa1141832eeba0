"""Which transfer function was that?
=================================

A picture in a paper shows a scalar that is known; the transfer function behind the picture is not. It can be found.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# The known scalar: waves in a cube. The images: six views through a function that is to be found, of which one is held
# out. With images from files this would be ``dtv.load_capture``.

mesh = dtv.TetMesh.grid((8, 8, 8), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
x, y, z = mesh.vertices.T
scalar = 0.5 + 0.3 * torch.sin(6 * x) * torch.cos(5 * y) + 0.2 * torch.sin(7 * z)
colors = [[0.1, 0.2, 0.8], [0.2, 0.6, 1.0], [1.0, 1.0, 0.9], [1.0, 0.5, 0.1], [0.6, 0.0, 0.1]]
truth = dtv.TransferFunction([0.0, 0.3, 0.5, 0.7, 1.0], [0.6, 0.1, 0.0, 0.2, 0.9], colors)

cameras = dtv.capture.fibonacci_orbit(6, radius=1.6, width=40, height=40)
images = dtv.render(mesh, dtv.ScalarField(scalar, truth, attenuation=25.0), cameras)
held_out = torch.arange(6) == 3
capture = dtv.Capture(cameras, images.color, images.alpha.clamp(0, 1), held_out, mesh.bounds(), "waves")

# %%
# Values and places of 16 knots, from random ones.

config = dtv.inverse.TransferConfig(knots=16, iterations=60)
result = dtv.fit_transfer(mesh, scalar, capture, config)
print(f"From {result.start_quality.mean_psnr:.1f} dB to PSNR {result.held_out.mean_psnr:.2f} dB, held out")

# %%
# Truth, start and result, and the three functions; the result as a file that other commands take.

dtv.view.transfer_report.save_transfer_report(folder / "fit_transfer.png", mesh, result, capture, truth)
result.transfer_function.save(folder / "fit_transfer.json")
