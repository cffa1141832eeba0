"""What hands change: transfer functions, names of files, films."""

import threading

import numpy as np
import pytest
import torch
from PIL import Image
from view.live import scenes

from difftetvr.capture.camera_paths import CameraPath, load_camera_path, save_camera_path
from difftetvr.errors import CameraError, CaptureError
from difftetvr.optics import TransferFunction
from difftetvr.rendering import LensCamera
from difftetvr.view.live.edited_function import MOST_KNOTS, EditedFunction
from difftetvr.view.live.panels.desk import Desk
from difftetvr.view.live.placement import Placement
from difftetvr.view.live.shooting import Shooting
from difftetvr.view.live.studio import Studio
from difftetvr.view.looks import colormap_colors

PLACES = torch.linspace(0.0, 1.0, 201)


@pytest.mark.parametrize(
    "function",
    [
        TransferFunction.default(),
        TransferFunction([0.2, 0.5, 0.5, 0.7], [0.1, 0.0, 0.9, 0.3], torch.rand(4, 3)),
        TransferFunction([0.4], [0.6], [[1.0, 0.5, 0.0]]),
    ],
)
def test_few_knots_are_kept_as_they_are(function):
    edited = EditedFunction.of(function)
    assert edited.places[0] == 0.0 and edited.places[-1] == 1.0
    for ours, theirs in zip(edited.function(PLACES), function(PLACES)):
        assert (ours - theirs).abs().max() < 1e-5


def test_many_knots_become_few_that_look_alike():
    places = torch.linspace(0.0, 1.0, 65)
    bumps = 0.8 * torch.exp(-(((places - 0.3) / 0.05) ** 2)) + 0.3 * torch.exp(-(((places - 0.8) / 0.1) ** 2))
    function = TransferFunction(places, bumps, torch.rand(65, 3))
    edited = EditedFunction.of(function)
    assert len(edited.places) <= MOST_KNOTS
    color, opacity = edited.function(PLACES)
    assert (opacity - function(PLACES)[1]).abs().max() < 0.08
    assert (color - function(PLACES)[0]).abs().max() < 1e-5


def test_knots_are_moved_raised_added_and_taken_away():
    edited = EditedFunction.of(TransferFunction([0.0, 0.5, 1.0], [0.0, 0.8, 0.2], torch.rand(3, 3)))
    assert edited.moved((0.0, 0.3, 1.0)).function(torch.tensor([0.3]))[1] == pytest.approx(0.8)
    assert edited.moved((0.6, 0.5, 2.0)).places == (0.6, 0.6, 1.0)
    assert edited.with_opacity(1, 7.0).opacities == pytest.approx((0.0, 1.0, 0.2))
    more, chosen = edited.with_knot_after(2)
    assert chosen == 2 and more.places == (0.0, 0.5, 0.75, 1.0) and more.opacities[2] == pytest.approx(0.5)
    assert (more.function(PLACES)[1] - edited.function(PLACES)[1]).abs().max() < 1e-6
    fewer = more.without_knot(1).without_knot(1).without_knot(0)
    assert fewer.places == (0.0, 1.0)
    viridis = edited.in_colors_of("viridis").function
    assert (viridis(PLACES)[0] - colormap_colors("viridis", PLACES)).abs().max() < 0.02
    assert (viridis(PLACES)[1] - edited.function(PLACES)[1]).abs().max() < 1e-6
    with pytest.raises(CaptureError, match="no colour map 'virides'"):
        edited.in_colors_of("virides")
    assert edited.drawing(1).count("<circle") == 3


class Nobody:
    """A server without clients."""

    def get_clients(self):
        return {}


@pytest.fixture
def desk(tmp_path):
    scene = scenes.colored()
    folder = tmp_path / "mine"
    folder.mkdir()
    (tmp_path / "theirs").mkdir()
    return Desk(Nobody(), Studio(scene, print), Placement.of(scene.bounds), folder)


@pytest.mark.parametrize(
    "name", ["../a", "a/b", "/tmp/a", "..", ".", "", " ", ".png", ".a", "a\\b", "C:a", "a\0", "link"]
)
def test_files_are_named_in_one_folder_alone(desk, name):
    (desk.folder / "link.png").symlink_to(desk.folder.parent / "theirs" / "b.png")
    with pytest.raises(CaptureError, match="no name of a file in"):
        desk.file(name, ".png")


def test_no_file_is_replaced(desk):
    assert desk.file("a", ".png") == desk.file(" a.png ", ".png") == desk.folder / "a.png"
    assert desk.free_name("a", ".png") == "a-1"
    (desk.folder / "a-1.png").write_text("mine")
    assert desk.free_name("a", ".png") == "a-2"
    with pytest.raises(CaptureError, match="is there already"):
        desk.file("a-1", ".png")


def filmed(studio, path, stop_at=None):
    """What is said at the end of a film, drawn by this thread."""
    ended, said = threading.Event(), []

    def tell(share):
        if stop_at is not None and share >= stop_at:
            shooting.stop()

    def end(sentence, is_there):
        said.append((sentence, is_there))
        ended.set()

    shooting = Shooting(studio, [scenes.START] * 5, tell)
    shooting.begin(path, 10.0, end)
    while not ended.is_set():
        studio.work(0.05)
    return said[0]


def test_a_film_is_drawn_between_pictures_and_can_be_stopped(desk):
    sentence, is_there = filmed(desk.studio, desk.folder / "a.gif")
    assert is_there and "a.gif (5 frames)" in sentence
    assert Image.open(desk.folder / "a.gif").size == (60, 40)
    sentence, is_there = filmed(desk.studio, desk.folder / "b.gif", stop_at=0.4)
    assert not is_there and "stopped" in sentence
    assert [path.name for path in desk.folder.iterdir()] == ["a.gif"]


def test_paths_are_read_back(tmp_path):
    views = scenes.photographed().views
    path = CameraPath(list(views.cameras), 7, True, 12.5)
    save_camera_path(tmp_path / "a.json", path)
    read = load_camera_path(tmp_path / "a.json")
    assert (read.frames, read.loop, read.fps) == (7, True, 12.5)
    for one, other in zip(read.cameras, path.cameras, strict=True):
        assert torch.equal(one.world_to_camera.double(), other.world_to_camera.double()) and one.fx == other.fx
    assert len(read.cameras_of_frames()) == 7
    save_camera_path(tmp_path / "b.json", CameraPath([scenes.START]))
    assert load_camera_path(tmp_path / "b.json").frames is None
    with pytest.raises(CameraError, match="Only pinhole"):
        save_camera_path(tmp_path / "c.json", CameraPath([lens_camera()]))
    assert np.all([p.name != "c.json" for p in tmp_path.iterdir()])


def lens_camera():
    start = scenes.START
    numbers = (start.fx, start.fy, start.cx, start.cy, start.width, start.height)
    return LensCamera(start.world_to_camera, *numbers, coefficients=torch.tensor([0.1, 0.0]))
