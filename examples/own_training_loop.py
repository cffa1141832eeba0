"""Colours, densities and vertex positions in a loop of your own: the renderer is just another PyTorch operation."""

import torch

import difftetvr as dtv
from difftetvr.fitting import VertexOptimizer, VertexOptimizerConfig

STEPS = 160


def main() -> None:
    capture = dtv.VolumeCapture(path="tooth", views=16, width=48, height=48).build()
    lower, upper = capture.bounds.tolist()
    mesh = dtv.TetMesh.grid((5, 5, 8), lower, upper)

    color = torch.full((mesh.num_vertices, 3), 0.5, requires_grad=True)
    density = torch.full((mesh.num_vertices,), 0.05, requires_grad=True)
    optimizer = torch.optim.Adam([color, density], lr=0.03, betas=(0.9, 0.99), eps=1e-15)
    # Steps in units of the cells' altitudes; no cell is ever inverted.
    config = VertexOptimizerConfig(boundary="slide")
    positions = VertexOptimizer(mesh, config)

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
            positions.step(config.rate_at(step / STEPS))
            positions.zero_grad()
        if step % 40 == 0:
            smallest = positions.mesh.volumes().min().item()
            print(f"step {step:3d}  PSNR {-10 * torch.log10(loss).item():.2f} dB  smallest cell {smallest:.2e}")


if __name__ == "__main__":
    main()
