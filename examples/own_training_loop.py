"""A training loop of your own
===========================

The renderer is just another PyTorch operation: colours, densities and vertex positions, in a loop that you write.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.fitting import VertexOptimizer, VertexOptimizerConfig

STEPS = 160
folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# What to learn from, and what is learned. Vertices have an optimiser of their own: its steps are counted in altitudes
# of the cells, and no cell is ever inverted.

capture = dtv.VolumeCapture(path="tooth", views=16, width=48, height=48).build()
mesh = dtv.TetMesh.grid((5, 5, 8), *capture.bounds.tolist())
color = torch.full((mesh.num_vertices, 3), 0.5, requires_grad=True)
density = torch.full((mesh.num_vertices,), 0.05, requires_grad=True)
optimizer = torch.optim.Adam([color, density], lr=0.03, betas=(0.9, 0.99), eps=1e-15)
positions = VertexOptimizer(mesh, VertexOptimizerConfig(boundary="slide"))

# %%
# The loop. After each step colours and densities are projected to where they are valid.

for step in range(STEPS + 1):
    view = step % len(capture.cameras)
    field = dtv.Field(color, capture.density_unit * density)
    image = dtv.render(positions.mesh, field, capture.cameras[view]).color
    loss = (image - capture.images[view]).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    with torch.no_grad():
        color.clamp_(0.0, 1.0)
        density.clamp_(min=0.0)
    if step % 2 == 1:  # the gradients of two views make one move
        positions.step(positions.config.rate_at(step / STEPS))
        positions.zero_grad()
    if step % 40 == 0:
        smallest = positions.mesh.volumes().min().item()
        psnr = -10 * torch.log10(loss).item()
        print(f"step {step:3d}  PSNR {psnr:.2f} dB  smallest cell {smallest:.2e}")

# %%
# The last view beside its truth, and where the vertices went.

row = (f"truth, view {view}", capture.images[view], image.detach(), 1.0)
dtv.view.pictures.save_comparisons(folder / "own_training_loop.png", [row])
field = dtv.Field(color.detach(), capture.density_unit * density.detach())
cut = dtv.view.cut.cut_picture(positions.mesh, field, size=384, background=(1.0, 1.0, 1.0))
cut.save(folder / "own_training_loop_cut.png")
# sphinx_gallery_thumbnail_number = 2
