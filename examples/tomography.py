"""A density from X-rays
=====================

A tomograph measures the integral of the density along each ray. An image has it as ``optical_depth``, differentiable as
its colours are, so that a density is found without any colour.
"""

import math
import sys
from pathlib import Path

import torch

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# A ball with a bubble in it, and what 16 X-rays around it measure.

mesh = dtv.TetMesh.grid((10, 10, 10), lower=(-1, -1, -1), upper=(1, 1, 1))
black = torch.zeros(mesh.num_vertices, 3)
radius = mesh.vertices.norm(dim=1)
bubble = (mesh.vertices - torch.tensor([0.3, 0.0, 0.2])).norm(dim=1)
truth = 2.0 * torch.sigmoid(12 * (0.75 - radius)) * torch.sigmoid(12 * (bubble - 0.3))
angles = [2 * math.pi * k / 16 for k in range(16)]
eyes = [(3.5 * math.cos(angle), 3.5 * math.sin(angle), 1.5 * math.sin(3 * angle)) for angle in angles]
cameras = [dtv.Camera.look_at(eye, target=(0, 0, 0), width=48, height=48) for eye in eyes]
measured = [dtv.render(mesh, dtv.Field(black, truth), camera).optical_depth for camera in cameras]

# %%
# The density that explains them.

density = torch.full_like(truth, 0.1, requires_grad=True)
optimizer = torch.optim.Adam([density], lr=0.05)
for step in range(241):
    found = dtv.render(mesh, dtv.Field(black, density), cameras[step % 16]).optical_depth
    loss = (found - measured[step % 16]).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    with torch.no_grad():
        density.clamp_(min=0.0)
    if step % 60 == 0:
        error = (density.detach() - truth).norm() / truth.norm()
        print(f"step {step:3d}  density off by {100 * error:.1f} %")

# %%
# An X-ray as it was measured, as it is found, and the difference; then a cut through the density.

with torch.no_grad():
    found = dtv.render(mesh, dtv.Field(black, density), cameras[0]).optical_depth
pictures = [(depth / measured[0].max())[..., None].expand(-1, -1, 3) for depth in (measured[0], found)]
dtv.view.pictures.save_comparisons(folder / "tomography.png", [("measured", *pictures, 1.0)])
field = dtv.Field(torch.ones(mesh.num_vertices, 3), 4.0 * density.detach())
cut = dtv.view.cut.cut_picture(mesh, field, dtv.view.cut.Plane((0, -1, 0)), size=384)
cut.save(folder / "tomography_cut.png")
# sphinx_gallery_thumbnail_number = 2
