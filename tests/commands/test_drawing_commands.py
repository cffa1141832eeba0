"""`render` and `cut`: cameras of captures, films, looks of scalars, what is around a picture, volumes."""

import json

import numpy as np
import pytest
import torch
from capture.photos.photo_scene import write_nerf_synthetic
from commands.helpers import fails
from PIL import Image

import difftetvr as dtv
import difftetvr.cli as cli
from difftetvr.capture import load_cameras
from difftetvr.view.pictures import to_picture

SMALL = ["--width", "24", "--height", "20", "--device", "cpu"]


def draw(command, *args):
    """The picture that a successful command writes, (H, W, C) bytes."""
    args = [str(a) for a in args]
    assert cli.main([command, *args]) == 0
    return np.asarray(Image.open(args[args.index("-o") + 1])).astype(int)


@pytest.fixture
def simulation(tmp_path):
    mesh = dtv.TetMesh.grid((4, 4, 4))
    points = mesh.vertices.numpy()
    np.savez(tmp_path / "flow.npz", vertices=points, tets=mesh.tets.numpy(), pressure=points[:, 2] ** 2)
    return tmp_path / "flow.npz"


@pytest.fixture
def photo_run(tmp_path):
    """The folder of a run from photographs, as far as pictures need it: a ball in a much larger shell."""
    write_nerf_synthetic(tmp_path / "ball")
    folder = tmp_path / "run"
    folder.mkdir()
    mesh = dtv.TetMesh.grid((6, 6, 6), lower=(-8.0, -8.0, -8.0), upper=(8.0, 8.0, 8.0))
    radius = mesh.vertices.norm(dim=1)
    density = 3.0 * ((radius < 3.0) | (radius > 7.0)).float()
    color = torch.stack([(radius < 3.0).float(), torch.zeros_like(radius), (radius > 7.0).float()], 1)
    dtv.save(folder / "model.vtu", mesh, dtv.Field(color, density))
    config = {"capture": str(tmp_path / "ball"), "capture_options": {"downscale": 2}, "fit": {"background": "white"}}
    (folder / "config.json").write_text(json.dumps(config))
    return folder / "model.vtu"


def seen_by(model, camera, background=(1.0, 1.0, 1.0)):
    mesh, field = dtv.load(model)
    return np.asarray(to_picture(dtv.render(mesh, field, camera, background).color)).astype(int)


def test_views_of_the_run_behind_a_model(photo_run, tmp_path, capsys):
    views = load_cameras(tmp_path / "ball", downscale=2)
    shown = draw("render", photo_run, "-o", tmp_path / "a.png", "--view", 3, "--device", "cpu")
    assert np.abs(shown - seen_by(photo_run, views.cameras[3])).max() <= 1
    given = ["--capture", tmp_path / "ball", "--view", 3, "--width", 45, "--device", "cpu"]
    assert draw("render", photo_run, "-o", tmp_path / "a.png", *given).shape == (30, 45, 3)
    message = fails(capsys, "render", photo_run, "-o", tmp_path / "a.png", "--view", len(views.cameras))
    assert f"'ball' has {len(views.cameras)} views, numbered from 0" in message


def test_a_model_of_photographs_is_looked_at_as_they_were_taken(photo_run, tmp_path, capsys):
    typical = load_cameras(tmp_path / "ball", downscale=2).typical
    shown = draw("render", photo_run, "-o", tmp_path / "a.png", "--width", 30, "--device", "cpu")
    assert np.abs(shown - seen_by(photo_run, typical.with_size(30, 20))).max() <= 1
    # Without its photographs it is seen from outside, and a line says why.
    capsys.readouterr()
    (tmp_path / "ball").rename(tmp_path / "gone")
    draw("render", photo_run, "-o", tmp_path / "b.png", *SMALL)
    assert "is no longer there" in capsys.readouterr().out
    draw("render", photo_run, "-o", tmp_path / "b.png", "--capture", tmp_path / "gone", "--view", 0)
    alone = photo_run.rename(tmp_path / "alone.vtu")
    assert "needs the name of a --capture" in fails(capsys, "render", alone, "-o", tmp_path / "a.png", "--view", 0)


def test_films_around_photographs(photo_run, tmp_path):
    for path in ("ellipse", "interpolate"):
        given = ["--path", path, "--frames", 3, "--width", 12, "--device", "cpu"]
        draw("render", photo_run, "-o", tmp_path / f"{path}.webp", *given)
        film = Image.open(tmp_path / f"{path}.webp")
        assert film.n_frames == 3 and film.size == (12, 8)
    assert cli.main(["render", str(photo_run), "-o", str(tmp_path / "film"), "--turntable", "4", *SMALL[:2]]) == 0
    frames = [np.asarray(Image.open(file)).astype(int) for file in sorted((tmp_path / "film").iterdir())]
    assert len(frames) == 4
    first = load_cameras(tmp_path / "ball", downscale=2).typical.with_size(24, 16)
    assert np.abs(frames[0] - seen_by(photo_run, first)).max() <= 1


def test_a_turntable_of_a_simulation(simulation, tmp_path):
    assert cli.main(["render", str(simulation), "-o", str(tmp_path / "film"), "--turntable", "2", *SMALL]) == 0
    begin, half = (np.asarray(Image.open(file)).astype(int) for file in sorted((tmp_path / "film").iterdir()))
    # From behind, a cube whose values grow upwards looks nearly the same.
    assert np.abs(half - begin).mean() < 12 and half.max() > 50


def test_a_path_from_a_file(simulation, tmp_path, capsys):
    from difftetvr.rendering import save_camera

    entries = []
    for x in (0.2, 0.8):
        camera = dtv.Camera.look_at((x, -2.0, 0.5), (x, 0.5, 0.5), width=20, height=20)
        save_camera(tmp_path / "camera.json", camera)
        entries.append(json.loads((tmp_path / "camera.json").read_text()))
    content = {"format": "difftetvr-camera-path", "cameras": entries, "frames": 5, "fps": 8}
    (tmp_path / "path.json").write_text(json.dumps(content))
    draw("render", simulation, "-o", tmp_path / "a.webp", "--path", tmp_path / "path.json", "--device", "cpu")
    assert "5 frames of 20 x 20, 8 a second" in capsys.readouterr().out
    assert Image.open(tmp_path / "a.webp").n_frames == 5


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["-o", "a.png", "--turntable", 3], "A film is written as"),
        (["-o", "a.webp"], "make one with --turntable or --path"),
        (["-o", "a.webp", "--turntable", 0], "--turntable is 0"),
        (["-o", "a.webp", "--turntable", 3, "--path", "ellipse"], "both say how the camera moves"),
        (["-o", "a.webp", "--path", "ellipse"], "--path ellipse needs the name of a --capture"),
        (["-o", "a.webp", "--path", "none.json"], "Cannot read the camera path"),
        (["-o", "a.png", "--frames", 3], "--frames counts those of a --path"),
        (["-o", "a.png", "--fps", 3], "--fps is for films"),
        (["-o", "a.png", "--view", 3, "--eye", 1, 2, 3], "--view 3 says where the camera is; leave out --eye"),
        (["-o", "a.png", "--percentile", 50, 10], "--percentile is 50 10"),
        (["-o", "a.png", "--percentile", 5, 10, "--value-range", 0, 1], "leave out one of them"),
        (["-o", "a.png", "--colormap", "nothing-like-it"], "no colour map 'nothing-like-it'"),
        (["-o", "a.png", "--transfer-function", "tf.json", "--log"], "leave out --log, or --transfer-function"),
        (["-o", "a.png", "--transparent", "--background", "white"], "--transparent leaves no background"),
        (["-o", "a.png", "--light", 0, 0, 1], "--light is the direction to the light of --shade"),
        (["-o", "a.png", "--shape", 3, 3, 3], "is a mesh, of which --shape says nothing"),
        (["-o", "a.png", "--save-transfer-function", "a.xml"], "written as .json"),
        (["-o", "a.png", "--unit", "mm"], "--unit mm is what --axes are told in"),
        (["-o", "a.webp", "--path", "a.json", "--view", 3], "--path a.json says where the camera is; leave out --view"),
        (["-o", "a.png", "--show", "cell-quality", "--axes"], "--axes is for the image"),
        (["-o", "a.png", "--show", "cell-quality", "--log"], "--log is for the image"),
    ],
)
def test_options_that_make_no_sense(simulation, tmp_path, capsys, monkeypatch, options, said):
    monkeypatch.chdir(tmp_path)
    dtv.TransferFunction.default().save("tf.json")
    before = sorted(tmp_path.iterdir())
    assert said in fails(capsys, "render", simulation, *options)
    assert sorted(tmp_path.iterdir()) == before


def test_looks_of_scalars_are_refused_for_what_has_its_own_colours(photo_run, tmp_path, capsys):
    for option in (["--log"], ["--colormap", "gray"], ["--percentile", 1, 99], ["--value-range", 0, 1]):
        for command in ("render", "cut"):
            message = fails(capsys, command, photo_run, "-o", tmp_path / "a.png", *option)
            assert f"{option[0]} is for scalars, but {photo_run} has color and density" in message
    draw("render", photo_run, "-o", tmp_path / "a.png", *SMALL[:2], "--scalar", "density", "--log")


def test_what_has_no_logarithm_is_transparent(tmp_path):
    mesh = dtv.TetMesh.grid((10, 10, 10))
    x = mesh.vertices[:, 0].numpy()
    names = {"vertices": mesh.vertices.numpy(), "tets": mesh.tets.numpy()}
    for name, scalar in (("zero", np.maximum(x - 0.5, 0.0)), ("negative", x - 0.5)):
        np.savez(tmp_path / f"{name}.npz", **names, q=scalar)
        given = ["--eye", 0.5, -3, 0.5, "--target", 0.5, 0.5, 0.5, "--opacity", "flat", "--log", "--transparent"]
        alpha = draw("render", tmp_path / f"{name}.npz", "-o", tmp_path / "a.png", *given, *SMALL)[9:11, :, 3]
        assert not alpha[:, :12].any() and alpha[:, 13].min() > 60


def test_a_saved_transfer_function_makes_the_same_picture(simulation, tmp_path, capsys):
    look = ["--colormap", "viridis", "--opacity", "peak", "--percentile", 2, 98, "--log"]
    first = draw(
        "render", simulation, "-o", tmp_path / "a.png", *SMALL, *look, "--save-transfer-function", tmp_path / "tf.json"
    )
    said = capsys.readouterr().out.splitlines()
    again = next(line for line in said if "the same picture" in line).partition("picture: ")[2].split()
    assert first.max() > 40
    assert np.abs(draw("render", simulation, "-o", tmp_path / "b.png", *SMALL, *again) - first).max() <= 1


def test_what_is_around_a_picture(simulation, tmp_path):
    plain = draw("render", simulation, "-o", tmp_path / "a.png", *SMALL, "--background", "white")
    assert plain[0, 0].tolist() == [255, 255, 255]
    clear = draw("render", simulation, "-o", tmp_path / "a.png", *SMALL, "--transparent")
    assert clear.shape == (20, 24, 4) and clear[0, 0, 3] == 0
    alpha = clear[..., 3:] / 255
    assert np.abs(clear[..., :3] * alpha + 255 * (1 - alpha) - plain).max() < 3
    larger = ["--width", 160, "--height", 160, "--eye", 2, -2, 1, "--device", "cpu", "--background", "white"]
    bare = draw("render", simulation, "-o", tmp_path / "a.png", *larger)
    full = draw("render", simulation, "-o", tmp_path / "a.png", *larger, "--colorbar", "--axes", "--unit", "mm")
    changed = np.abs(full - bare).max(2) > 60
    assert changed[:, 135:].any() and changed[:, :80].any() and not changed[70:90, 70:90].any()


def test_the_default_camera_sees_all_and_wastes_no_room(tmp_path):
    for upper in ((1.0, 1.0, 1.0), (6.0, 1.0, 1.0), (1.0, 1.0, 9.0)):
        mesh = dtv.TetMesh.grid((2, 2, 2), upper=upper)
        field = dtv.Field(torch.ones(mesh.num_vertices, 3), torch.full((mesh.num_vertices,), 1e4))
        dtv.save(tmp_path / "m.vtu", mesh, field)
        for width, height in ((80, 80), (120, 60), (60, 120)):
            args = ["--width", width, "--height", height, "--device", "cpu"]
            seen = draw("render", tmp_path / "m.vtu", "-o", tmp_path / "a.png", *args).max(2) > 128
            rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
            assert rows[0] > 0 and rows[-1] < height - 1 and columns[0] > 0 and columns[-1] < width - 1
            assert max(np.ptp(rows) / height, np.ptp(columns) / width) > 0.85
            middle = (rows[0] + rows[-1] + 1) / 2, (columns[0] + columns[-1] + 1) / 2
            assert middle == pytest.approx((height / 2, width / 2), abs=2)


def test_a_turntable_sees_all_of_what_turns(tmp_path):
    """Also of what is short from the front and long from the side."""
    mesh = dtv.TetMesh.grid((2, 2, 2), upper=(1.0, 6.0, 1.0))
    field = dtv.Field(torch.ones(mesh.num_vertices, 3), torch.full((mesh.num_vertices,), 1e4))
    dtv.save(tmp_path / "m.vtu", mesh, field)
    args = ["--width", "60", "--height", "60", "--device", "cpu", "--turntable", "8"]
    assert cli.main(["render", str(tmp_path / "m.vtu"), "-o", str(tmp_path / "film"), *args]) == 0
    for file in (tmp_path / "film").iterdir():
        seen = np.asarray(Image.open(file)).max(2) > 128
        assert seen.any() and not (seen[[0, -1]].any() or seen[:, [0, -1]].any())


def test_shading_darkens_what_faces_across_the_light(simulation, tmp_path):
    plain = draw("render", simulation, "-o", tmp_path / "a.png", *SMALL)
    above = draw("render", simulation, "-o", tmp_path / "a.png", *SMALL, "--shade", "--light", 0, 0, 1)
    across = draw("render", simulation, "-o", tmp_path / "a.png", *SMALL, "--shade", "--light", 1, 0, 0)
    assert np.abs(above - plain).max() <= 2
    assert across.sum() == pytest.approx(0.35 * plain.sum(), rel=0.05)


def test_a_volume_is_drawn_as_it_is(tmp_path, capsys):
    shown = draw("render", "tooth", "-o", tmp_path / "a.png", "--eye", 0, -1.5, 0.2, "--target", 0, 0, 0, *SMALL)
    volume, function = dtv.VolumeCapture().load_volume()
    camera = dtv.Camera.look_at((0, -1.5, 0.2), (0, 0, 0), fov_y=np.radians(53.13), width=24, height=20)
    images, _ = dtv.capture.VolumeRenderer(volume, function, 25.0, device="cpu").render([camera])
    assert np.abs(shown - np.asarray(to_picture(images[0]))).max() <= 1
    values = np.random.default_rng(0).random((5, 6, 7)).astype(np.float32)
    np.save(tmp_path / "scan.npy", values)
    look = ["--colormap", "gray", "--opacity", "flat", "--colorbar"]
    capsys.readouterr()
    assert draw("render", tmp_path / "scan.npy", "-o", tmp_path / "b.png", *SMALL, *look).max() > 60
    assert "stand for 0 to 1" not in capsys.readouterr().out, "the bar tells the range, which is another one"
    # What is said of its looks stands in for the transfer function that the tooth brings along.
    asked = ["--colormap", "gray", *SMALL]
    gray = draw("render", "tooth", "-o", tmp_path / "a.png", *asked)
    assert np.ptp(gray, axis=2).max() <= 1 and gray.max() > 60
    assert np.ptp(shown, axis=2).max() > 60
    for option in (["--clip", 1, 0, 0, 0], ["--scalar", "x"], ["--shade"], ["--renderer", "marching"]):
        message = fails(capsys, "render", "tooth", "-o", tmp_path / "c.png", *option)
        assert f"tooth is a volume, and {option[0]} is for meshes" in message


def test_the_range_of_a_volume_is_told_in_the_values_of_its_file(tmp_path, capsys):
    """The same picture, whether its values are counted from 0 to 1 or in other units."""
    x = np.linspace(0.0, 1.0, 16, dtype=np.float32)[None, None, :].repeat(8, 0).repeat(8, 1)
    pictures = []
    for name, values, ends in (("unit", x, (0.25, 0.75)), ("other", 200.0 * x - 1000.0, (-950.0, -850.0))):
        np.save(tmp_path / f"{name}.npy", values)
        given = [*SMALL, "--value-range", *ends, "--opacity", "ramp"]
        pictures.append(draw("render", tmp_path / f"{name}.npy", "-o", tmp_path / "a.png", *given))
    assert pictures[0].max() > 60 and np.abs(pictures[0] - pictures[1]).max() <= 1


def test_cuts_of_scalars(simulation, tmp_path, capsys):
    given = ["--no-cells", "--size", 64, "--colormap", "gray"]
    shown = draw("cut", simulation, "-o", tmp_path / "a.png", *given)
    assert shown.shape == (64, 64, 3)
    # The scalar is linear in cells, the colours are those of the map: no slab, no light.
    z = (np.arange(64)[::-1] + 0.0) / 63
    nodes = np.linspace(0, 1, 5)
    assert np.abs(shown[:, 32, 0] / 255 - np.interp(z, nodes, nodes**2)).max() < 0.02
    half = draw("cut", simulation, "-o", tmp_path / "a.png", *given, "--value-range", 0.25, 0.5, "--colorbar")
    assert half.shape[1] > 64 and half[2, 32, 0] == 255 and half[60, 32, 0] == 0
    assert "no scalar 'heat'" in fails(capsys, "cut", simulation, "-o", tmp_path / "a.png", "--scalar", "heat")


def test_cuts_of_models_of_photographs_leave_the_surroundings_out(photo_run, tmp_path):
    views = load_cameras(tmp_path / "ball", downscale=2)
    assert float(views.inner_bounds.abs().max()) < 6.0, "less than the mesh, which reaches to 8"
    near = draw("cut", photo_run, "-o", tmp_path / "a.png", "--no-cells", "--size", 64)
    whole = draw("cut", photo_run.rename(tmp_path / "alone.vtu"), "-o", tmp_path / "a.png", "--no-cells", "--size", 64)
    shares = [(picture[..., 0] > 60).mean() for picture in (near, whole)]
    assert shares[0] > 1.5 * shares[1] > 0


@pytest.mark.parametrize(
    ("low", "high"), [(-1.7e308, 1.7e308), (1e-310, 1e-300), (1e-290, 1e300), (-3e-30, 5e-30), (1e9, 1e9 + 1e-3)]
)
def test_looks_do_not_depend_on_the_unit_of_a_scalar(tmp_path, low, high, recwarn):
    mesh = dtv.TetMesh.grid((4, 4, 4))
    share = mesh.vertices[:, 2].double().numpy()
    pictures = []
    for ends in ((0.0, 1.0), (low, high)):
        scalar = ends[0] * (1.0 - share) + ends[1] * share
        np.savez(tmp_path / "a.npz", vertices=mesh.vertices.numpy(), tets=mesh.tets.numpy(), s=scalar)
        pictures.append(draw("render", tmp_path / "a.npz", "-o", tmp_path / "a.png", *SMALL))
        draw(
            "render", tmp_path / "a.npz", "-o", tmp_path / "b.png", *SMALL, "--opacity", "peak", "--shade", "--colorbar"
        )
        draw("cut", tmp_path / "a.npz", "-o", tmp_path / "b.png", "--size", 32, "--colorbar")
        if ends[0] > 0:
            draw("render", tmp_path / "a.npz", "-o", tmp_path / "b.png", *SMALL, "--log", "--colorbar")
    assert pictures[0].max() > 60 and np.abs(pictures[0] - pictures[1]).max() <= 3
    assert not recwarn.list
