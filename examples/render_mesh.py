"""Render a tetrahedral mesh with colours and densities of your own and save picture and mesh."""

import sys
from pathlib import Path

import torch

import difftetvr as dtv
from difftetvr.view.pictures import save_png


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    mesh = dtv.TetMesh.grid((24, 24, 24), lower=(-1, -1, -1), upper=(1, 1, 1))

    # Two nested shells, cut open; any (V, 3) colours in linear RGB and (V,) densities per unit length do.
    x, y, z = mesh.vertices.T
    radius = mesh.vertices.norm(dim=1)
    outer, inner = (torch.exp(-((radius - r) ** 2) / (2 * 0.06**2)) for r in (0.85, 0.45))
    opened = (x > 0) & (y < 0) & (z > -0.1)
    density = torch.where(opened, 0.0, 9.0 * outer) + 25.0 * inner
    normal_map = 0.5 + 0.5 * mesh.vertices / (radius[:, None] + 1e-6)
    orange = torch.tensor([1.0, 0.55, 0.2])
    color = (outer[:, None] * normal_map + inner[:, None] * orange) / (outer + inner + 1e-6)[:, None]

    camera = dtv.Camera.look_at(eye=(2.2, -2.6, 1.6), target=(0, 0, 0), up=(0, 0, 1), fov_y=0.7, width=400, height=300)
    field = dtv.Field(color, density)
    image = dtv.render(mesh, field, camera, background=(1.0, 1.0, 1.0))

    save_png(folder / "render_mesh.png", image.color)
    dtv.save(folder / "render_mesh.vtu", mesh, field)
    print(f"Wrote {folder / 'render_mesh.png'} and {folder / 'render_mesh.vtu'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
