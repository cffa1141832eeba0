"""What windows show: each quantity, the pace, the studio, where things are in a browser. No browser is needed."""

import dataclasses
import threading

import numpy as np
import pytest
import torch
from view.live import scenes

from difftetvr.errors import DiffTetError
from difftetvr.mesh import Field
from difftetvr.rendering import Camera, render
from difftetvr.rendering.inspection import inspect_rays
from difftetvr.view.live import quantities
from difftetvr.view.live.contents import MeshContent
from difftetvr.view.live.pace import FRAME_SECONDS, Pace
from difftetvr.view.live.placement import Placement, fov_that_holds
from difftetvr.view.live.quantities import measured, painted, picture_of
from difftetvr.view.live.scene import Views
from difftetvr.view.live.settings import Settings
from difftetvr.view.live.studio import Studio
from difftetvr.view.pictures import to_picture


def seen(scene, mode, camera=scenes.START, **settings):
    """The numbers, and the picture, of a mode."""
    chosen = dataclasses.replace(scene.settings, mode=mode, **settings)
    values = measured(scene, chosen, camera)
    return values, painted(values, chosen)


def test_colours_are_those_of_render_over_the_background_and_behind_the_plane():
    scene, clip, behind = scenes.colored(), (1.0, 0.0, 0.0, -2.0), (0.2, 0.4, 0.6)
    _, picture = seen(scene, "color", clip=clip, background=behind)
    truth = render(scene.content.mesh, scene.content.field, scenes.START, torch.tensor(behind), clip_plane=clip)
    difference = picture.pixels.astype(int) - np.asarray(to_picture(truth.color)).astype(int)
    assert np.abs(difference).max() <= 1 and picture.scale is None
    assert picture.pixels.std() > 20


def test_numbers_are_those_of_the_library_and_have_a_scale():
    scene = scenes.colored()
    truth = render(scene.content.mesh, scene.content.field, scenes.START)
    met = inspect_rays(scene.content.mesh, scenes.START)
    depth, picture = seen(scene, "depth")
    known = truth.alpha >= 1 / 255
    assert torch.equal(depth[..., 0].isnan(), ~known) and torch.equal(depth[..., 0][known], truth.depth[known])
    assert truth.depth.max() * 0.5 < picture.scale.lowest < picture.scale.highest <= truth.depth.max()
    assert torch.equal(seen(scene, "opacity")[0][..., 0], truth.alpha)
    assert torch.equal(seen(scene, "depth complexity")[0][..., 0].int(), met.depth_complexity)
    assert seen(scene, "depth complexity")[1].scale.highest == met.depth_complexity.max()
    quality, picture = seen(scene, "cell quality")
    assert torch.equal(quality[..., 0].nan_to_num(), met.worst_quality.nan_to_num()) and picture.scale.is_logarithmic
    assert (picture.pixels[quality[..., 0].isnan().numpy()] == round(0.08 * 255)).all()


@pytest.mark.parametrize("wrong", [0.0, 0.1])
def test_the_error_at_a_photograph_is_its_own_and_small_beside_it(wrong):
    scene = scenes.photographed(wrong)
    camera = scene.views.cameras[1]
    values = seen(scene, "error", camera)[0][..., 0]
    # Interpolated between the photograph's own pixels, so to the rounding of where these are.
    assert values.isnan().sum() < 0.05 * values.numel() and (values.nan_to_num(wrong) - wrong).abs().max() < 2e-3
    aside = Camera.look_at((-3.2, 6.2, 4.1), scenes.MIDDLE, (0.0, 1.0, 0.5), 0.8, 48, 36)
    assert scene.views.nearest_to(aside, scene.focus) == 1
    shifted = seen(scene, "error", aside)[0][..., 0]
    assert abs(float(shifted.nanmean()) - wrong) < 0.06
    assert "error" in scene.modes and "error" not in scenes.colored().modes


def test_pixels_of_a_photograph_that_do_not_count_have_no_error():
    scene = scenes.photographed()
    capture = scene.views.capture
    valid = torch.ones(3, 36, 48, dtype=torch.bool)
    valid[1, :, :24] = False
    masked = dataclasses.replace(scene, views=Views.of(dataclasses.replace(capture, valid=valid)))
    is_known = ~seen(masked, "error", scene.views.cameras[1])[0][..., 0].isnan()
    assert not is_known[:, :23].any() and is_known[1:-1, 25:-1].all()


def test_without_a_model_a_camera_shows_its_photograph_and_other_places_nothing():
    scene = dataclasses.replace(scenes.photographed(), content=None)
    capture, camera = scene.views.capture, scene.views.cameras[2]
    values = seen(scene, "color", camera)[0]
    known = values[..., 3] > 0
    assert known[1:-1, 1:-1].all() and (values[..., :3] - capture.images[2])[known].abs().max() < 2e-3
    assert not seen(scene, "color")[0].any()


def test_a_large_picture_is_that_of_its_parts(monkeypatch):
    scene = scenes.colored()
    whole = np.asarray(picture_of(scene, scene.settings, scenes.START))
    monkeypatch.setattr(quantities, "_MOST_AT_ONCE", 60 * 7)
    assert np.array_equal(np.asarray(picture_of(scene, scene.settings, scenes.START)), whole)


@pytest.mark.parametrize("channels", [0, 1, 2, 5])
def test_fields_of_other_channels_are_seen_as_colours(channels):
    mesh = scenes.grid()
    values, density = torch.rand(mesh.num_vertices, channels), torch.rand(mesh.num_vertices)
    color = MeshContent(mesh, Field(values, density)).seen_by(scenes.START, Settings()).color
    dense = density if channels else density * 25.0 / (4.0 * float(np.quantile(density.numpy(), 0.999)))
    truth = render(mesh, Field(values, dense), scenes.START)
    if channels < 2:  # white, and grey
        expected = (truth.color if channels else truth.alpha[..., None]).expand(-1, -1, 3)
    else:
        expected = torch.nn.functional.pad(truth.color, (0, 1))[..., :3]
    assert (color - expected).abs().max() < 1e-5 and color.max() > 0.1


def test_a_look_changes_scalars():
    scene = scenes.scalars()
    look = scene.settings.look
    one = seen(scene, "color")[1].pixels
    other = seen(scene, "color", look=dataclasses.replace(look, density=2.0))[1].pixels
    ranged = seen(scene, "color", look=dataclasses.replace(look, value_range=(0.0, 9.0)))[1].pixels
    assert np.abs(one.astype(int) - other).max() > 30 and np.abs(one.astype(int) - ranged).max() > 30
    assert np.array_equal(one, seen(scene, "color")[1].pixels)


def test_the_pace_leaves_room_for_ten_frames_a_second_and_comes_back():
    pace, window = Pace(), 1280 * 720

    def drawn(seconds_per_pixel, frames=12):
        for _ in range(frames):
            width, height = pace.size(1280, 720)
            seconds = width * height * seconds_per_pixel
            pace.observe(width * height, seconds, window)
        return seconds

    assert drawn(1e-6) < FRAME_SECONDS and pace.level > 0
    slow = pace.level
    assert drawn(1e-8) < FRAME_SECONDS and pace.level == 0 < slow
    assert drawn(1e-5) < 2 * FRAME_SECONDS  # as coarse as it gets
    assert min(pace.size(20, 3000)) >= 20 and pace.size(64, 48)[0] >= 32


class Windows:
    """A studio whose windows keep what they are shown."""

    def __init__(self, scene):
        self.complaints, self.shown = [], []
        self.studio = Studio(scene, self.complaints.append)

    def open(self, camera=scenes.START):
        shown = []
        window = self.studio.open(lambda picture, is_full: shown.append((picture, is_full)))
        self.studio.look(window, camera)
        self.shown.append(shown)
        return window

    def work(self):
        while self.studio.work(0.3):
            pass


BIG = scenes.START.with_size(150, 100)


def test_a_window_is_shown_a_draft_and_then_the_picture_in_full():
    windows = Windows(scenes.colored())
    windows.open(BIG)
    windows.work()
    (shown,) = windows.shown
    sizes = [picture.pixels.shape[:2] for picture, _ in shown]
    assert sizes[0] < (100, 150) and sizes[-1] == (100, 150) and [full for _, full in shown] == [False, True]
    # In bands of rows, it is the picture that is drawn at once.
    assert np.array_equal(shown[-1][0].pixels, np.asarray(picture_of(scenes.colored(), windows.studio.settings, BIG)))
    assert not windows.studio.work(0.0)


def test_settings_reach_all_windows_and_those_that_are_gone_are_left_alone():
    windows = Windows(scenes.colored())
    first, _ = windows.open(), windows.open()
    windows.work()
    counts = [len(shown) for shown in windows.shown]
    windows.studio.close(first)
    windows.studio.close(first)
    windows.studio.change(mode="opacity")
    windows.work()
    assert len(windows.shown[0]) == counts[0] and len(windows.shown[1]) > counts[1]
    assert windows.shown[1][-1][0].scale.label == "opacity"
    windows.studio.look(first, scenes.START)
    assert not windows.studio.work(0.0)


def test_the_newest_camera_counts_and_a_picture_in_full_is_given_up_for_it():
    windows = Windows(scenes.colored())
    window = windows.open(BIG)
    windows.studio.work(0.3)
    windows.studio.work(0.3)  # some rows of it
    assert window.rows
    for angle in range(5):
        windows.studio.look(window, Camera.look_at((6.0, angle, 5.0), scenes.MIDDLE, (0, 0, 1), 0.9, 150, 100))
    assert not window.rows
    windows.work()
    (shown,) = windows.shown
    assert len(shown) == 3  # the first draft, that of the last camera, and its picture
    last = picture_of(scenes.colored(), windows.studio.settings, window.camera)
    assert np.array_equal(shown[-1][0].pixels, np.asarray(last))


def test_what_cannot_be_drawn_is_said_once_and_all_else_goes_on():
    windows = Windows(scenes.scalars())
    windows.open()
    wrong = dataclasses.replace(windows.studio.settings.look, value_range=(1.0, float("inf")))
    windows.studio.change(look=wrong)
    windows.work()
    assert len(set(windows.complaints)) == 1 and "range" in windows.complaints[0]
    windows.studio.change(look=None)
    windows.work()
    assert windows.shown[0][-1][1]


def test_jobs_are_done_where_all_is_drawn():
    studio = Windows(scenes.colored()).studio
    threads = []
    asking = threading.Thread(target=lambda: studio.ask(lambda: threads.append(threading.current_thread())))
    asking.start()
    assert studio.work(5.0) and threads == [threading.current_thread()]
    asking.join()

    def fail():
        raise DiffTetError("No.")

    studio.ask(fail)
    assert studio.work(1.0) and not studio.work(0.0)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e5])
def test_a_camera_goes_to_the_browser_and_back(size):
    bounds = size * torch.tensor([[3.0, 1.0, -2.0], [5.0, 5.0, 0.0]], dtype=torch.float64)
    placement = Placement.of(bounds)
    corners = placement.inward(bounds.numpy())
    assert np.allclose(corners, [[-0.25, -0.5, -0.25], [0.25, 0.5, 0.25]])
    eye, target = size * np.array([7.0, 9.0, 1.0]), size * np.array([4.0, 3.0, -1.0])
    camera = Camera.look_at(eye.tolist(), target.tolist(), (0.1, 0.2, 1.0), 0.7, 320, 200)
    wxyz, position = placement.pose(camera)
    back = placement.camera(wxyz, position, fov_that_holds(camera, 1.6), (320, 200))
    points = bounds.double()
    ours, theirs = camera.project(points)[0].double(), back.project(points)[0].double()
    assert (ours - theirs).abs().max() < 1e-2


def test_a_window_of_other_proportions_holds_all_of_a_camera():
    camera = Camera.look_at((0.0, -5.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.7, 300, 200)
    assert fov_that_holds(camera, 2.0) == pytest.approx(0.7)
    narrow = fov_that_holds(camera, 0.75)
    assert np.tan(narrow / 2) == pytest.approx(2.0 * np.tan(0.35))
