"""Colours, densities and vertex positions in a loop of your own: the renderer is just another PyTorch operation."""

import torch

import difftetvr as dtv


def main() -> None:
    capture = dtv.VolumeCapture(path="tooth", views=16, width=48, height=48).build()
    lower, upper = capture.bounds.tolist()
    mesh = dtv.TetMesh.grid((5, 5, 8), lower, upper)

    color = torch.full((mesh.num_vertices, 3), 0.5, requires_grad=True)
    density = torch.full((mesh.num_vertices,), 0.05, requires_grad=True)
    # The surface stays where it is; inner vertices may move a little.
    start = mesh.vertices
    inside = ((start > start.amin(0) + 1e-4) & (start < start.amax(0) - 1e-4)).all(dim=1, keepdim=True)
    offset = torch.zeros_like(start, requires_grad=True)
    optimizer = torch.optim.Adam([{"params": [color, density], "lr": 0.03}, {"params": [offset], "lr": 5e-4}])

    for step in range(121):
        view = step % len(capture.cameras)
        moved = mesh.with_vertices(start + offset * inside)
        field = dtv.Field(color, capture.density_unit * density)
        loss = (dtv.render(moved, field, capture.cameras[view]).color - capture.images[view]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            color.clamp_(0.0, 1.0)
            density.clamp_(min=0.0)
        if step % 40 == 0:
            smallest = moved.volumes().min().item()
            print(f"step {step:3d}  PSNR {-10 * torch.log10(loss).item():.2f} dB  smallest cell {smallest:.2e}")


if __name__ == "__main__":
    main()
