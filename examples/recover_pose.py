"""Where did the camera stand?
===========================

An image is differentiable in the camera's pose, so a pose can be found by gradient descent.
"""

import sys
from pathlib import Path

import torch

import difftetvr as dtv

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples")
folder.mkdir(parents=True, exist_ok=True)
# %%
# A photo of a known volume, taken from a place that is to be found.

torch.manual_seed(0)
mesh = dtv.TetMesh.grid((6, 6, 6), (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
field = dtv.Field(torch.rand(mesh.num_vertices, 3), 6.0 * torch.rand(mesh.num_vertices))
truth = dtv.Camera.look_at(eye=(1.5, -1.2, 0.9), target=(0, 0, 0), fov_y=0.8, width=96, height=96)
photo = dtv.render(mesh, field, truth).color

# %%
# A pose has six degrees of freedom, a rotation vector and a translation; these are about a guess.


def rigid(rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    x, y, z, zero = *rotation, rotation.new_zeros(())
    skew = torch.stack([torch.stack([zero, -z, y]), torch.stack([z, zero, -x]), torch.stack([-y, x, zero])])
    top = torch.cat([torch.linalg.matrix_exp(skew), translation[:, None]], dim=1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


guess = rigid(torch.tensor([0.03, -0.04, 0.05]), torch.tensor([0.04, -0.03, 0.06])) @ truth.world_to_camera

# %%
# The search. The motion is about the object's centre, which is better conditioned than the camera's.

rotation, translation = torch.zeros(3, requires_grad=True), torch.zeros(3, requires_grad=True)
optimizer = torch.optim.Adam([rotation, translation], lr=1e-2)
schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.98)
for step in range(201):
    camera = truth.with_pose(guess @ rigid(rotation, translation))
    image = dtv.render(mesh, field, camera).color
    loss = (image - photo).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    schedule.step()
    if step % 50 == 0:
        error = (camera.position.detach() - truth.position).norm()
        print(f"step {step:3d}  loss {loss.item():.2e}  camera off by {error.item():.4f}")

# %%
# The photo beside the guess and beside what was found.
first = dtv.render(mesh, field, truth.with_pose(guess)).color
rows = [("photo", photo, first, 1.0), ("photo", photo, image, 1.0)]
dtv.view.pictures.save_comparisons(folder / "recover_pose.png", rows)
