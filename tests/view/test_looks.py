"""How scalars look of which nothing is said: their distribution, range, colours and opacities."""

import sys

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.errors import CaptureError, MeshError
from difftetvr.view.looks import Appearance, Distribution, colormap_colors
from difftetvr.view.looks.opacities import opacity_knots


def box(upper=(1.0, 1.0, 1.0), cells=(8, 8, 8)):
    return dtv.TetMesh.grid(cells, lower=(0.0, 0.0, 0.0), upper=upper, dtype=torch.float64)


def along(mesh, axis=0):
    return mesh.vertices[:, axis] / mesh.vertices[:, axis].max()


def test_the_distribution_of_a_linear_scalar():
    mesh = box((2.0, 1.0, 1.0))
    found = Distribution.of_scalars(mesh, along(mesh), "vertex")
    # Lengths are told in the longest side.
    assert float(found.volumes.sum()) == pytest.approx(0.25) and found.surface == pytest.approx(2.5)
    assert torch.allclose(found.slopes, torch.ones_like(found.slopes)) and found.ends == (0.0, 1.0)
    assert found.quantiles([0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.03)
    assert found.mean_depth(torch.full_like(found.values, 3.0)) == pytest.approx(3.0 * 4.0 * 0.25 / 2.5)
    middles = along(mesh)[mesh.tets.long()].mean(1)
    cells = Distribution.of_scalars(mesh, middles, "cell")
    assert len(cells.values) == mesh.num_cells and cells.quantiles([0.5]) == pytest.approx([0.5], abs=0.04)
    assert float(cells.slopes.median()) == pytest.approx(1.0, abs=0.1)


def test_the_distribution_of_a_volume_is_that_of_the_mesh_with_its_values():
    values = np.linspace(0.0, 1.0, 21, dtype=np.float32)[None, None, :].repeat(11, 0).repeat(11, 1)
    found = Distribution.of_volume(dtv.Volume(values))
    assert float(found.volumes.sum()) == pytest.approx(0.25) and found.surface == pytest.approx(2.5)
    assert torch.allclose(found.slopes, torch.ones_like(found.slopes), atol=1e-4)


def test_each_step_of_a_scalar_has_the_same_depth_however_steep_it_is():
    """Four for the whole range, by default, of a rod that is thin enough to be seen through."""
    mesh = box((1.0, 0.1, 0.1), (64, 2, 2))
    x = along(mesh)
    camera = dtv.Camera.look_at((-1.0, 0.05, 0.05), (1.0, 0.05, 0.05), width=1, height=1, fov_y=0.01)
    for scalar in (x, torch.where(x < 0.25, 2.0 * x, 0.5 + (x - 0.25) * 2 / 3), torch.sigmoid(30.0 * (x - 0.5))):
        look = Appearance().look(Distribution.of_scalars(mesh, scalar, "vertex"), "s")
        field = dtv.ScalarField(scalar, look.transfer_function, look.attenuation, look.value_range)
        assert float(dtv.render(mesh, field, camera).optical_depth) == pytest.approx(4.0, rel=0.12)


def test_a_scalar_in_a_thick_body_is_seen_through():
    mesh = box()
    look = Appearance().look(Distribution.of_scalars(mesh, along(mesh), "vertex"), "s")
    opacity, function = look.transfer_function.opacity, look.transfer_function
    assert float(opacity.min()) == pytest.approx(1.0, abs=1e-3), "a slope that is the same everywhere"
    field = dtv.ScalarField(along(mesh), function, look.attenuation)
    depths = dtv.render(mesh, field, dtv.capture.fibonacci_orbit(60, (0.5, 0.5, 0.5), 9.0, 0.16, 24, 24)).optical_depth
    assert float(depths[depths > 0].mean()) == pytest.approx(2.0, rel=0.05)


def test_what_does_not_change_is_not_seen():
    mesh = box((1.0, 1.0, 1.0), (20, 4, 4))
    scalar = ((along(mesh) - 0.5) / 0.1).clamp(-1.0, 1.0)
    look = Appearance().look(Distribution.of_scalars(mesh, scalar, "vertex"), "s")
    knots = look.transfer_function(torch.tensor([0.0, 0.5, 1.0]))[1]
    assert float(knots[1]) > 5.0 * float(knots[0]) and float(knots[1]) > 5.0 * float(knots[2])


def test_presets():
    mesh = box()
    found = Distribution.of_scalars(mesh, along(mesh), "vertex")
    for preset in ("ramp", "flat"):
        knots, densities = opacity_knots(preset, found, found.values)
        shape = knots if preset == "ramp" else torch.ones_like(knots)
        assert torch.allclose(densities / densities.max(), shape)
        assert found.mean_depth(
            densities.max() * (found.values if preset == "ramp" else 1.0) * torch.ones_like(found.values)
        ) == pytest.approx(2.0, rel=1e-3)
    knots, densities = opacity_knots("peak", found, found.values)
    assert int((densities > 0).sum()) == 6 and float(torch.trapezoid(densities, knots)) == pytest.approx(6 * 0.4)


def test_the_range_leaves_outliers_out_and_nothing_else():
    mesh = box(cells=(14, 14, 14))
    scalar = along(mesh).clone()
    assert Appearance().look(Distribution.of_scalars(mesh, scalar, "vertex"), "s").value_range == (0.0, 1.0)
    scalar[300] = 1e6
    low, high = Appearance().look(Distribution.of_scalars(mesh, scalar, "vertex"), "s").value_range
    assert -0.01 <= low < 0.2 and 0.8 < high < 20.0
    two = (along(mesh) > 0.99).double()
    assert Appearance().look(Distribution.of_scalars(mesh, two, "vertex"), "s").value_range == (0.0, 1.0)
    chosen = Appearance(percentile=(25.0, 75.0)).look(Distribution.of_scalars(mesh, along(mesh), "vertex"), "s")
    assert chosen.value_range == pytest.approx((0.25, 0.75), abs=0.03)


def test_logarithms():
    mesh = box(cells=(48, 2, 2))
    scalar = 10.0 ** (4.0 * along(mesh) - 2.0)
    look = Appearance("gray", is_log=True).look(Distribution.of_scalars(mesh, scalar, "vertex"), "s")
    assert look.value_range == pytest.approx((0.01, 100.0))
    middle = (torch.tensor([1.0]) - 0.01) / 99.99
    assert float(look.transfer_function(middle)[0][0, 0]) == pytest.approx(0.5, abs=0.02)
    # The slope of the logarithm is what counts, and that is the same everywhere.
    opacity = look.transfer_function.opacity[4:-4]
    assert float(opacity.min()) > 0.8 * float(opacity.max())
    with pytest.raises(MeshError, match="greater than 0"):
        Appearance(is_log=True).look(Distribution.of_scalars(mesh, -scalar, "vertex"), "s")
    with pytest.raises(MeshError, match="begins with 0"):
        Appearance(value_range=(0.0, 1.0), is_log=True).look(Distribution.of_scalars(mesh, scalar, "vertex"), "s")


def test_colour_maps_by_name(monkeypatch):
    assert colormap_colors("gray", torch.tensor([0.0, 1.0])).tolist() == [[0, 0, 0], [1, 1, 1]]
    assert torch.equal(colormap_colors("viridis_r", torch.zeros(1)), colormap_colors("viridis", torch.ones(1)))
    monkeypatch.setitem(sys.modules, "cmcrameri", None)  # as if it were not installed
    with pytest.raises(CaptureError, match=r"'virdis' \(is it 'viridis'\?\).*difftetvr\[colormaps\]"):
        colormap_colors("virdis", torch.zeros(1))


def test_scientific_colour_maps():
    pytest.importorskip("cmcrameri")
    colors = colormap_colors("batlow", torch.linspace(0, 1, 3))
    assert torch.equal(colors, colormap_colors("cmc.batlow", torch.linspace(0, 1, 3))) and colors.unique().numel() > 6
