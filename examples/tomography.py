"""A density from X-rays
=====================

A tomograph measures the integral of the density along each ray. From such projections a mesh finds densities, places
for its vertices, and where cells are worth most.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.inverse.tomography import TomographyConfig, reconstruct

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)

# %%
# A ball with a bubble in it, as voxels, and what 24 X-rays around it measure, with the noise of 10 000 photons a pixel.

axis = (torch.arange(48) + 0.5) / 24 - 1
x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
ball = (x**2 + y**2 + z**2 < 0.75**2).float()
volume = ball * ((x - 0.3) ** 2 + y**2 + (z - 0.2) ** 2 > 0.3**2)
scanner = {"type": "cone", "views": 24, "source_distance": 5, "detector_distance": 7, "detector": [48, 48]}
geometry = dtv.capture.ProjectionGeometry.from_dict({**scanner, "detector_size": [4, 4], "volume_size": [2, 2, 2]})
noise = dtv.capture.Noise.parse("poisson:1e4")
measured = noise.apply(dtv.capture.project_volume(volume, geometry), seed=0)
test = torch.arange(24) % 8 == 3
scan = dtv.capture.ProjectionCapture(geometry, measured.line_integrals, measured.variance, None, test)

# %%
# The densities that explain them, on a mesh that moves and refines itself.

result = reconstruct(scan, TomographyConfig(cells=3_000, iterations=160, rays=4_000))
score = result.score
print(f"Held-out X-rays: PSNR {score.mean_psnr:.1f} dB, residuals {score.mean_noise:.2f} times the noise")
found = dtv.voxelise(result.mesh, result.field.density, (-1 + 1 / 48,) * 3, 2 / 48, (48,) * 3)
print(f"Volume: off by {100 * float((found - volume).norm() / volume.norm()):.0f} %")

# %%
# The middle slice as it is and as it was found, and the cells that it cuts.

pictures = [part[:, 24, :, None].expand(-1, -1, 3) for part in (volume, found)]
dtv.view.pictures.save_comparisons(folder / "tomography.png", [("truth", *pictures, 1.0)])
field = dtv.Field(torch.ones(result.mesh.num_vertices, 3), result.field.density)
cut = dtv.view.cut.cut_picture(result.mesh, field, dtv.view.cut.Plane((0, -1, 0)), size=384)
cut.save(folder / "tomography_cut.png")
# sphinx_gallery_thumbnail_number = 2
