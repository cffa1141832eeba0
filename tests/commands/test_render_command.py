"""`render`: scalars through transfer functions, clip planes, the three renderers, statistics."""

import warnings

import numpy as np
import pytest
import torch
from commands.helpers import fails
from PIL import Image

import difftetvr as dtv
import difftetvr.cli as cli

SMALL = ["--width", "24", "--height", "20", "--device", "cpu"]


@pytest.fixture
def simulation(tmp_path):
    """A mesh with a pressure and a velocity, and no colours."""
    mesh = dtv.TetMesh.grid((3, 3, 3))
    path = tmp_path / "flow.npz"
    points = mesh.vertices.numpy()
    velocity = np.stack([points[:, 0], 0 * points[:, 0], points[:, 2]], 1)
    np.savez(path, vertices=points, tets=mesh.tets.numpy(), pressure=points[:, 2], velocity=velocity)
    return path


def render(*args):
    """The picture that a successful command writes, (H, W, 3) in [0, 1]."""
    args = [str(a) for a in args]
    assert cli.main(["render", *args]) == 0
    return np.asarray(Image.open(args[args.index("-o") + 1]).convert("RGB")) / 255.0


def test_scalar_with_the_default_transfer_function(simulation, tmp_path, capsys):
    picture = render(simulation, "-o", tmp_path / "a.png", "--scalar", "pressure", *SMALL)
    assert picture.shape == (20, 24, 3) and picture.max() > 0.2
    assert "pressure" in capsys.readouterr().out
    # Red is for the high values above, blue for the low ones below.
    assert picture[:9, :, 0].sum() > picture[:9, :, 2].sum()
    assert picture[-8:, :, 0].sum() < picture[-8:, :, 2].sum()


def test_the_picture_is_that_of_the_library(simulation, tmp_path):
    function = dtv.TransferFunction([0.0, 0.5, 1.0], [0.0, 0.8, 0.1], [[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    function.save(tmp_path / "tf.json")
    eye, target = (0.5, -2.0, 0.8), (0.5, 0.5, 0.5)
    given = ["--scalar", "pressure", "--transfer-function", tmp_path / "tf.json", "--attenuation", "9"]
    given += ["--value-range", "0.2", "0.9", "--eye", *eye, "--target", *target, "--clip", "-1", "0", "0", "0.5"]
    picture = render(simulation, "-o", tmp_path / "a.png", *given, *SMALL)
    mesh = dtv.TetMesh.grid((3, 3, 3))
    field = dtv.ScalarField(mesh.vertices[:, 2], function, 9.0, (0.2, 0.9))
    camera = dtv.Camera.look_at(eye, target, (0.0, 0.0, 1.0), np.radians(53.13), 24, 20)
    image = dtv.render(mesh, field, camera, clip_plane=(-1.0, 0.0, 0.0, 0.5)).color
    from difftetvr.view.pictures import to_picture

    assert np.array_equal(picture, np.asarray(to_picture(image)) / 255.0)


@pytest.mark.parametrize("size", [1e-140, 1e-42, 1e38, 1e140])
def test_pictures_do_not_depend_on_the_unit_of_length(tmp_path, size, capsys):
    mesh = dtv.TetMesh.grid((2, 2, 2), dtype=torch.float64)
    pictures = []
    for factor in (1.0, size):
        points = factor * mesh.vertices.numpy()
        points = points.astype(np.float32) if 1e-45 < factor < 1e39 else points
        np.savez(tmp_path / "a.npz", vertices=points, tets=mesh.tets.numpy(), p=mesh.vertices[:, 0].numpy())
        pictures.append(render(tmp_path / "a.npz", "-o", tmp_path / "a.png", *SMALL))
    assert pictures[0].max() > 0.2 and np.abs(pictures[1] - pictures[0]).max() < 0.01
    assert capsys.readouterr().out.count("Kept in double precision, as single precision does not hold") == 1


@pytest.mark.parametrize("size", [1e-200, 1e155, 1e300])
def test_sizes_that_no_picture_can_be_computed_of_are_named(tmp_path, size, capsys):
    mesh = dtv.TetMesh.grid((1, 1, 1), dtype=torch.float64)
    np.savez(tmp_path / "a.npz", vertices=size * mesh.vertices.numpy(), tets=mesh.tets.numpy(), p=np.arange(8.0))
    message = fails(capsys, "render", tmp_path / "a.npz", "-o", tmp_path / "a.png", *SMALL)
    assert f"a.npz is {size:.3g} across, of which no picture can be computed; scale its positions." in message


def test_ranges_of_large_integers_are_those_of_the_file(tmp_path):
    mesh = dtv.TetMesh.grid((3, 3, 3))
    steps = (mesh.vertices[:, 2] * 2**11).long().numpy()
    arrays = {"vertices": mesh.vertices.numpy(), "tets": mesh.tets.numpy()}
    pictures = []
    for name, offset in (("near", 0), ("far", 2**60)):
        np.savez(tmp_path / f"{name}.npz", t=steps + offset, **arrays)
        given = ["--scalar", "t", "--value-range", offset + 2**8, offset + 2**10]
        pictures.append(render(tmp_path / f"{name}.npz", "-o", tmp_path / "a.png", *given, *SMALL))
    assert pictures[0].max() > 0.2 and np.array_equal(*pictures)


def test_all_renderers_write_the_same_picture(simulation, tmp_path):
    given = ["--scalar", "velocity", *SMALL]
    pictures = [
        render(simulation, "-o", tmp_path / f"{name}.png", "--renderer", name, *given)
        for name in ("marching", "linked-list", "projected")
    ]
    assert pictures[0].max() > 0.2
    for picture in pictures[1:]:
        assert np.abs(picture - pictures[0]).max() <= 1 / 255


@pytest.mark.parametrize(("show", "found"), [("depth-complexity", "cells a ray"), ("cell-quality", "worst quality")])
def test_statistics(simulation, tmp_path, capsys, show, found):
    picture = render(simulation, "-o", tmp_path / "a.png", "--show", show, *SMALL)
    assert found in capsys.readouterr().out
    # One pixel for each ray, the scale beside them.
    assert picture.shape[0] >= 20 and picture.shape[1] > 24
    assert len(np.unique(picture[:20, :24].reshape(-1, 3), axis=0)) > 1


def test_statistics_of_a_clipped_mesh(simulation, tmp_path):
    """A plane that nothing is in front of leaves nothing to count."""
    given = ["-o", tmp_path / "a.png", "--show", "depth-complexity", *SMALL]
    whole = render(simulation, *given)[:20, :24]
    clipped = render(simulation, "--clip", 1, 0, 0, -10, *given)[:20, :24]
    assert len(np.unique(whole.reshape(-1, 3), axis=0)) > len(np.unique(clipped.reshape(-1, 3), axis=0)) == 1


def test_an_uncertain_order_is_one_sentence(tmp_path, capsys):
    """Without the Python file and line that would issue the warning."""
    mesh = dtv.TetMesh.grid((3, 3, 3))
    middle = ((mesh.vertices[mesh.tets.long()].mean(1) - 0.5).abs() < 0.17).all(1)
    path = tmp_path / "hollow.npz"
    np.savez(path, vertices=mesh.vertices.numpy(), tets=mesh.tets[~middle].numpy(), heat=np.arange(mesh.num_vertices))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render(path, "-o", tmp_path / "a.png", "--renderer", "projected", *SMALL)
    printed = capsys.readouterr()
    assert "no certain front-to-back order" in printed.out
    assert "autograd" not in printed.out + printed.err


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--clip", 1, 0, 0, -5], "the clip plane cuts all of the mesh away; change --clip"),
        (["--value-range", 10, 20], "the scalars, 0 to 1, all lie below the range 10 to 20"),
        (["--eye", 3, 3, 3, "--target", 6, 6, 6], "the mesh lies behind the camera"),
        (["--eye", 3, 0, 0, "--target", 2, 9, 0], "the camera looks past the mesh"),
        (
            ["--clip", 0, 0, 1, -0.9, "--eye", 0.5, -1, 0, "--target", 0.5, 0, 0, "--fov", 9],
            "cuts away what the camera",
        ),
        (["--attenuation", 0], "the attenuation is 0; give a greater --attenuation"),
        (["--attenuation", 1e-6], "lets all light through; raise its density"),
        (["--transfer-function", "clear.json"], "the transfer function is transparent for the scalars, 0 to 1"),
        (["--transfer-function", "black.json"], "has the colour of the background"),
    ],
)
def test_a_picture_on_which_nothing_is_seen_is_said(simulation, tmp_path, capsys, monkeypatch, options, reason):
    """One line beside the picture, which is written: a camera may be meant to look away."""
    monkeypatch.chdir(tmp_path)
    for name, opacity in (("clear", [0, 0]), ("black", [1, 1])):
        dtv.TransferFunction([0, 1], opacity, [[0, 0, 0], [0, 0, 0]]).save(f"{name}.json")
    picture = render(simulation, "-o", tmp_path / "a.png", "--scalar", "pressure", *options, *SMALL)
    assert not picture.any()
    said = " ".join(capsys.readouterr().out.split())
    assert "The picture shows nothing: " in said and reason in said and "Wrote" in said


def test_an_empty_model_is_said_and_a_dim_one_is_not(tmp_path, capsys):
    from difftetvr.mesh.io import save

    mesh = dtv.TetMesh.grid((1, 1, 1))
    for density, is_said in ((0.0, True), (0.05, False)):
        field = dtv.Field(torch.ones(8, 3), torch.full((8,), density))
        save(tmp_path / "m.vtu", mesh, field)
        for renderer in ("marching", "linked-list", "projected"):
            render(tmp_path / "m.vtu", "-o", tmp_path / "a.png", "--renderer", renderer, *SMALL)
            assert ("the density of the mesh is 0 everywhere" in capsys.readouterr().out) == is_said


def test_bad_scalars(simulation, tmp_path, capsys):
    given = ["-o", tmp_path / "a.png", *SMALL]
    assert "pressure, velocity" in fails(capsys, "render", simulation, *given)
    assert "no scalar 'heat' (found: pressure, velocity)" in fails(
        capsys, "render", simulation, "--scalar", "heat", *given
    )
    assert "range" in fails(capsys, "render", simulation, "--scalar", "pressure", "--value-range", 1, 0, *given)
    assert "--attenuation is -1" in fails(
        capsys, "render", simulation, "--scalar", "pressure", "--attenuation", -1, *given
    )
    missing = tmp_path / "none.json"
    assert "none.json" in fails(
        capsys, "render", simulation, "--scalar", "pressure", "--transfer-function", missing, *given
    )
    assert "clip_plane" in fails(capsys, "render", simulation, "--scalar", "pressure", "--clip", 0, 0, 0, 1, *given)
    assert not (tmp_path / "a.png").exists()


def test_constant_scalar_and_no_scalar(tmp_path, capsys):
    mesh = dtv.TetMesh.grid((1, 1, 1))
    arrays = {"vertices": mesh.vertices.numpy(), "tets": mesh.tets.numpy()}
    np.savez(tmp_path / "constant.npz", heat=np.ones(8), **arrays)
    np.savez(tmp_path / "bare.npz", **arrays)
    assert "1 everywhere" in fails(capsys, "render", tmp_path / "constant.npz", "-o", tmp_path / "a.png")
    assert "no scalars" in fails(capsys, "render", tmp_path / "bare.npz", "-o", tmp_path / "a.png")


def test_real_meshes(shared_data, tmp_path, capsys):
    """One command each, with a word about flat cells."""
    meshes = shared_data / "meshes"
    assert render(meshes / "post.vtk", "-o", tmp_path / "a.png", *SMALL).max() > 0.1
    assert render(meshes / "bluntfin.npz", "--scalar", "density", "-o", tmp_path / "b.png", *SMALL).max() > 0.02
    assert "77 of 187,395 cells have no volume" in capsys.readouterr().out
    assert render(meshes / "hexa.vtk", "-o", tmp_path / "c.png", *SMALL).max() > 0.1
    assert "Split 10,648 hexahedra into 63,888 tetrahedra." in capsys.readouterr().out


def test_scalar_of_a_mesh_with_colours(tmp_path):
    """A named scalar is shown even where the file has colours; without a name the colours are."""
    mesh = dtv.TetMesh.grid((2, 2, 2))
    field = {"color": np.tile([0, 1, 0], (mesh.num_vertices, 1)).astype(np.float32)}
    field["density"] = np.full(mesh.num_vertices, 9, np.float32)
    heat = np.linspace(0, 1, mesh.num_vertices)
    path = tmp_path / "both.npz"
    np.savez(path, vertices=mesh.vertices.numpy(), tets=mesh.tets.numpy(), heat=heat, **field)
    green = render(path, "-o", tmp_path / "a.png", *SMALL)
    assert green[..., 1].max() > 0.5 and green[..., 0].max() == 0
    assert render(path, "-o", tmp_path / "b.png", "--scalar", "heat", *SMALL)[..., 0].max() > 0
