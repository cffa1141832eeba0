"""From where does it show most?
=============================

The entropy of a picture's opacities says how evenly it is filled, and is differentiable in the camera's pose.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# Two discs that stand across each other, and a bar: from most places something hides something else.

mesh = dtv.TetMesh.grid((20, 20, 20), (-1, -1, -1), (1, 1, 1))
x, y, z = mesh.vertices.T
upright = torch.exp(-40 * (x - 0.3) ** 2) * torch.sigmoid(20 * (0.7 - (y**2 + z**2).sqrt()))
lying = torch.exp(-40 * (z + 0.4) ** 2) * torch.sigmoid(20 * (0.6 - ((x + 0.2) ** 2 + y**2).sqrt()))
bar = torch.exp(-40 * ((x + 0.5) ** 2 + (z - 0.5) ** 2)) * torch.sigmoid(20 * (0.8 - y.abs()))
parts = torch.stack([upright, lying, bar], dim=1)
colors = torch.tensor([[1.0, 0.6, 0.2], [0.3, 0.7, 1.0], [0.9, 0.9, 0.8]])
field = dtv.Field(parts @ colors / (parts.sum(1, keepdim=True) + 1e-3), 12 * parts.sum(1))

# %%
# 32 views look around; from the best of them that are not neighbours, climbs go along the gradient.

config = dtv.inverse.ViewpointConfig(starts=4, scouts=32, width=64, height=64)
search = dtv.best_viewpoint(mesh, field, config)
scouts = max(view.entropy for view in search.scouts)
print(f"Entropy {search.best.entropy:.5f}, best of {len(search.scouts)} scouts {scouts:.5f}")

# %%
# The best view and the worst one, and where on the sphere they lie.

for name, view in (("best", search.best), ("worst", search.worst)):
    camera = view.camera.with_size(384, 384)
    image = dtv.render(mesh, field, camera, background=(1, 1, 1))
    dtv.view.save_png(folder / f"viewpoint_{name}.png", image.color)
dtv.view.viewpoints.save_viewpoint_map(folder / "viewpoint_map.png", search)
