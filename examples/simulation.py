"""A scalar through a transfer function
====================================

What a simulation computed, shown on its own cells: here the wave function of an electron in the hydrogen atom.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# One number for each vertex. From a file it would be ``data = dtv.load_data("flow.vtu")``, then ``data.mesh`` and
# ``data.point_data["pressure"]``.

mesh = dtv.TetMesh.grid((32, 32, 32), lower=(-22, -22, -22), upper=(22, 22, 22))
radius = mesh.vertices.norm(dim=1)
wave = (3 * mesh.vertices[:, 2] ** 2 - radius**2) * torch.exp(-radius / 3)

# %%
# A transfer function gives a colour and an opacity to every value: blue where the wave is negative, orange where it is
# positive, nothing in between. It is applied all along each ray, so its edges are sharp however coarse the cells are.

blue, orange = [0.15, 0.4, 1.0], [1.0, 0.5, 0.1]
knots = torch.tensor([0.0, 0.35, 0.44, 0.48, 0.52, 0.56, 0.65, 1.0])
opacity = torch.tensor([0.9, 0.3, 0.06, 0.0, 0.0, 0.06, 0.3, 0.9], requires_grad=True)
function = dtv.TransferFunction(knots, opacity, torch.tensor([blue] * 4 + [orange] * 4))
most = float(wave.abs().max())
field = dtv.ScalarField(wave, function, attenuation=1.0, value_range=(-most, most))

camera = dtv.Camera.look_at(eye=(32, -42, 20), target=(0, 0, 0), width=480, height=480)
image = dtv.render(mesh, field, camera)
dtv.view.save_png(folder / "simulation.png", image.color)

# %%
# Cut open by a plane: only what lies in y >= 0 is seen.

opened = dtv.render(mesh, field, camera, clip_plane=(0, 1, 0, 0))
dtv.view.save_png(folder / "simulation_opened.png", opened.color)

# %%
# Gradients reach the scalars and the transfer function: which opacities would brighten the picture?

image.color.mean().backward()
print("Brightness per opacity:", [f"{value:+.3f}" for value in opacity.grad.tolist()])
