"""A first picture
===============

A tetrahedral mesh with colours and densities of your own becomes a picture, and a file that ParaView opens.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# A mesh has (V, 3) vertices and (T, 4) cells. Here it is a grid of cubes, six cells each;
# ``dtv.TetMesh(vertices, tets)`` takes arrays, and ``dtv.load_mesh`` a file.

mesh = dtv.TetMesh.grid((24, 24, 24), lower=(-1, -1, -1), upper=(1, 1, 1))
print(mesh)

# %%
# A field has (V, 3) colours in linear RGB and (V,) densities per unit of length, linear inside each cell. Two nested
# shells, cut open:

x, y, z = mesh.vertices.T
radius = mesh.vertices.norm(dim=1)
outer, inner = (torch.exp(-((radius - r) ** 2) / (2 * 0.06**2)) for r in (0.85, 0.45))
opened = (x > 0) & (y < 0) & (z > -0.1)
density = torch.where(opened, 0.0, 9.0 * outer) + 25.0 * inner
normal_map = 0.5 + 0.5 * mesh.vertices / (radius[:, None] + 1e-6)
orange = torch.tensor([1.0, 0.55, 0.2])
color = (outer[:, None] * normal_map + inner[:, None] * orange) / (outer + inner + 1e-6)[:, None]
field = dtv.Field(color, density)

# %%
# A camera, and the picture. ``image`` also holds ``alpha``, ``depth`` and ``optical_depth``.

eye = (2.2, -2.6, 1.6)
camera = dtv.Camera.look_at(eye, target=(0, 0, 0), fov_y=0.7, width=640, height=480)
image = dtv.render(mesh, field, camera, background=(1.0, 1.0, 1.0))
dtv.view.save_png(folder / "render_mesh.png", image.color)
dtv.save(folder / "render_mesh.vtu", mesh, field)
