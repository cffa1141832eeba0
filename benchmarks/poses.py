"""Fits of photographs whose poses are off, with and without their refinement, beside one with true poses.

Every camera is turned by --degrees about a random axis and shifted by --shift of its distance from the middle of the
box, in a random direction; held-out views, too. They are compared at poses that were found on their own images, as in
BARF; with true poses as they are.

    python benchmarks/poses.py ../shared/data/lego --downscale 8 [--iterations 2400] [--figure poses.png]
"""

from __future__ import annotations

import argparse
import dataclasses
import math

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

import difftetvr as dtv
from difftetvr.fitting import CameraRefinement
from difftetvr.fitting.cameras.refined import rotation_of


def disturbed(capture: dtv.Capture, degrees: float, shift: float, seed: int = 0) -> dtv.Capture:
    """The capture with poses that are off."""
    random = torch.Generator().manual_seed(seed)
    center = capture.bounds.double().mean(0)
    cameras = []
    for camera in capture.cameras:
        axis, along = torch.randn(2, 3, generator=random, dtype=torch.float64)
        pose = camera.world_to_camera.double()
        eye = camera.position.double()
        moved = eye + shift * (eye - center).norm() * along / along.norm()
        rotation = rotation_of(math.radians(degrees) * axis / axis.norm()) @ pose[:3, :3]
        wrong = torch.eye(4, dtype=torch.float64)
        wrong[:3, :3], wrong[:3, 3] = rotation, -rotation @ moved
        cameras.append(camera.with_pose(wrong.to(camera.world_to_camera)))
    return dataclasses.replace(capture, cameras=cameras)


def some_views(capture: dtv.Capture, training: int, tested: int) -> dtv.Capture:
    """The capture with fewer views, evenly spread; 0 leaves all of a kind."""
    chosen: list[int] = []
    for indices, count in ((capture.train_indices.tolist(), training), (capture.test_indices.tolist(), tested)):
        chosen += indices if not count else [indices[k * len(indices) // count] for k in range(count)]
    images, alphas = (torch.stack([part[view] for view in chosen]) for part in (capture.images, capture.alphas))
    cameras = [capture.cameras[view] for view in chosen]
    return dataclasses.replace(capture, cameras=cameras, images=images, alphas=alphas, test=capture.test[chosen])


Errors = tuple[torch.Tensor, torch.Tensor]
"""Of each camera, of directions in degrees and of positions in parts of the distance."""


def pose_errors(found: list[dtv.Camera], true: list[dtv.Camera], views: list[int]) -> Errors:
    """Errors of cameras after a similarity transform."""
    a, b = (torch.stack([cameras[v].position.double() for v in views]) for cameras in (found, true))
    middle_a, middle_b = a.mean(0), b.mean(0)
    left, sizes, right = torch.linalg.svd((b - middle_b).T @ (a - middle_a))
    flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.det(left @ right)))], dtype=torch.float64))
    rotation = left @ flip @ right
    scale = (sizes * flip.diagonal()).sum() / (a - middle_a).square().sum()
    places = scale * (a - middle_a) @ rotation.T + middle_b
    angles = []
    for v in views:
        turned = found[v].world_to_camera[:3, :3].double() @ rotation.T
        # By the chord: near 0 a cosine has lost half of its digits.
        chord = (turned - true[v].world_to_camera[:3, :3].double()).norm() / math.sqrt(8.0)
        angles.append(math.degrees(2.0 * math.asin(min(1.0, float(chord)))))
    distance = (b - middle_b).norm(dim=1).mean()
    return torch.tensor(angles), (places - b).norm(dim=1) / distance


@dataclasses.dataclass
class Row:
    """A fit: what it is called, what a held-out view looks like, how far off its cameras are."""

    name: str
    psnr: float
    picture: torch.Tensor
    errors: Errors


def picture_of(result: dtv.FitResult, cameras: list[dtv.Camera], view: int) -> torch.Tensor:
    """A view over white, as photographs store it."""
    with torch.no_grad():
        color = dtv.render(result.mesh, result.field, cameras[view], (1.0, 1.0, 1.0)).color
    return color.clamp(0.0, 1.0)


def draw(path: str, truth: torch.Tensor, rows: list[Row]) -> None:
    """A held-out view as photographed and from each fit, and the errors of all cameras."""
    figure = Figure(figsize=(3.0 * len(rows) + 7.0, 3.4), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(rows) + 2, width_ratios=[*[1.0] * (len(rows) + 1), 1.3])
    titles = ["photograph", *(f"{row.name}: {row.psnr:.2f} dB" for row in rows)]
    for place, picture, title in zip(axes, [truth, *(row.picture for row in rows)], titles, strict=False):
        place.imshow(picture.cpu().numpy(), interpolation="nearest")
        place.set_title(title, fontsize=10)
        place.set_axis_off()
    for row, marker in zip(rows[1:], "x.", strict=False):
        angles, places = row.errors
        axes[-1].loglog(angles, 100.0 * places, marker, label=row.name, alpha=0.7)
    axes[-1].set_xlabel("direction off by, degrees")
    axes[-1].set_ylabel("position off by, % of the distance")
    axes[-1].grid(alpha=0.3, which="both")
    for axis in (axes[-1].xaxis, axes[-1].yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes[-1].legend(fontsize=8)
    canvas.print_png(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture")
    parser.add_argument("--downscale", type=int, default=8)
    parser.add_argument("--iterations", type=int, default=2400)
    parser.add_argument("--cells", type=int, default=40_000)
    parser.add_argument("--degrees", type=float, default=0.5)
    parser.add_argument("--shift", type=float, default=0.01)
    parser.add_argument("--views", type=int, default=0, help="training views to take, evenly spread; 0: all")
    parser.add_argument("--tested", type=int, default=0, help="held-out views to take; 0: all")
    parser.add_argument("--rates", nargs="+", type=float, default=[CameraRefinement().rate])
    parser.add_argument("--only-refined", action="store_true")
    parser.add_argument("--figure", help="draw a held-out view of each fit and the errors of its cameras into this PNG")
    options = parser.parse_args()
    capture = dtv.load_capture(options.capture, downscale=options.downscale)
    capture = some_views(capture, options.views, options.tested)
    off = disturbed(capture, options.degrees, options.shift)
    plain = dtv.FitConfig(cells=options.cells, iterations=options.iterations, evaluate_every=0)
    refined = [
        dataclasses.replace(plain, refine_poses=True, cameras=CameraRefinement(rate=rate, final_rate=0.1 * rate))
        for rate in options.rates
    ]
    rows = [("true", capture, plain), ("off, as given", off, plain)] if not options.only_refined else []
    names = ["off, refined"] if len(refined) == 1 else [f"off, refined at {rate:g}" for rate in options.rates]
    rows += [(name, off, config) for name, config in zip(names, refined, strict=True)]
    training = capture.train_indices.tolist()
    print("| poses | PSNR, dB | SSIM | off by, degrees | off by, % of the distance | s |\n|---|---|---|---|---|---|")
    view, drawn = capture.test_indices.tolist()[0], []
    for name, images, config in rows:
        result = dtv.fit(images, config)
        found = images.cameras if result.refined is None else result.refined.cameras()
        errors = pose_errors(found, capture.cameras, training)
        angle, place = (float(part.mean()) for part in errors)
        psnr, ssim = result.evaluation.mean_psnr, result.evaluation.mean_ssim
        seconds = result.history.seconds
        print(f"| {name} | {psnr:.2f} | {ssim:.4f} | {angle:.3f} | {100 * place:.3f} | {seconds:.0f} |", flush=True)
        drawn.append(Row(name, psnr, picture_of(result, found, view), errors))
    if options.figure:
        image, alpha = capture.images[view], capture.alphas[view]
        draw(options.figure, image + (1.0 - alpha)[..., None], drawn)


if __name__ == "__main__":
    main()
