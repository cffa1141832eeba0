"""Which scalar was that?
=======================

Images show a scalar through a transfer function that is known; the scalar is not. It is found on a mesh that moves and
refines itself, and can then be seen through any other function.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.view.pictures import beside, labelled, save_picture, to_picture

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# Sixteen images of a ball with a denser core, of which every fourth is held out. With images from files this would be
# ``dtv.load_capture``.

mesh = dtv.TetMesh.grid((16, 16, 16), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
radius = (mesh.vertices - torch.tensor([0.05, 0.0, -0.05])).norm(dim=1)
scalar = (1.1 - 2.4 * radius).clamp(0.0, 1.0)
function = dtv.TransferFunction(
    [0.0, 0.15, 0.5, 1.0], [0.0, 0.05, 0.25, 0.6], [[0.1, 0.2, 1.0], [0.2, 0.5, 1.0], [0.95, 0.9, 0.7], [1.0, 0.3, 0.1]]
)
cameras = dtv.capture.fibonacci_orbit(16, radius=1.6, width=48, height=48)
images = dtv.render(mesh, dtv.ScalarField(scalar, function, attenuation=12.0), cameras)
held_out = torch.arange(16) % 4 == 1
capture = dtv.Capture(cameras, images.color, None, held_out, mesh.bounds(), "ball", density_unit=12.0)

# %%
# A quarter as many iterations first fit colours and densities, from which scalars begin.

config = dtv.inverse.ScalarConfig(cells=1500, iterations=160, evaluate_every=0)
result = dtv.inverse.fit_scalar(capture, function, config)
print(f"PSNR {result.evaluation.mean_psnr:.2f} dB, held out, with {result.mesh.num_cells} cells")

# %%
# Truth and result through the function that made the images, and through one that no image has seen.

other = dtv.TransferFunction([0.0, 0.4, 1.0], [0.0, 0.1, 0.8], [[0.0, 0.6, 0.3], [0.1, 0.9, 0.4], [1.0, 1.0, 0.6]])
view = cameras[1].with_size(192, 192)
panels = []
for name, through in (("", function), (", another function", other)):
    for label, shown, values in (("truth", mesh, scalar), ("found", result.mesh, result.field.scalar)):
        image = dtv.render(shown, dtv.ScalarField(values, through, attenuation=12.0, value_range=(0.0, 1.0)), view)
        panels.append(labelled(to_picture(image.color), label + name))
save_picture(folder / "fit_scalar.png", beside(panels))
dtv.save(folder / "fit_scalar.vtu", result.mesh, result.field)
