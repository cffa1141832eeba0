"""Find where a camera stood: gradients of an image with respect to the camera's pose."""

import torch

import difftetvr as dtv


def rigid(rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """(4, 4) rigid transform of a rotation vector and a translation."""
    zero = rotation.new_zeros(())
    x, y, z = rotation
    skew = torch.stack([torch.stack([zero, -z, y]), torch.stack([z, zero, -x]), torch.stack([-y, x, zero])])
    top = torch.cat([torch.linalg.matrix_exp(skew), translation[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def main() -> None:
    torch.manual_seed(0)
    mesh = dtv.TetMesh.grid((6, 6, 6), lower=(-0.5, -0.5, -0.5), upper=(0.5, 0.5, 0.5))
    field = dtv.Field(torch.rand(mesh.num_vertices, 3), 6.0 * torch.rand(mesh.num_vertices))
    truth = dtv.Camera.look_at(eye=(1.5, -1.2, 0.9), target=(0, 0, 0), fov_y=0.8, width=96, height=96)
    photo = dtv.render(mesh, field, truth).color

    start = rigid(torch.tensor([0.03, -0.04, 0.05]), torch.tensor([0.04, -0.03, 0.06])) @ truth.world_to_camera
    rotation, translation = torch.zeros(3, requires_grad=True), torch.zeros(3, requires_grad=True)
    optimizer = torch.optim.Adam([rotation, translation], lr=1e-2)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.98)
    for step in range(201):
        pose = start @ rigid(rotation, translation)  # about the object's centre: better conditioned than the camera's
        loss = (dtv.render(mesh, field, truth.with_pose(pose)).color - photo).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 50 == 0:
            error = (truth.with_pose(pose.detach()).position - truth.position).norm()
            print(f"step {step:3d}  loss {loss.item():.2e}  camera off by {error.item():.4f}")


if __name__ == "__main__":
    main()
