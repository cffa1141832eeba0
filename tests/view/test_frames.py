"""Pictures with what is around a volume, and films of them."""

import itertools
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import difftetvr as dtv
from difftetvr.errors import CaptureError
from difftetvr.view.frames import AxesBox, ColorScale, FrameStyle, framed, save_film
from difftetvr.view.frames.axes import ProjectedBox
from difftetvr.view.frames.color_bar import beside_color_bar, draw_color_bar
from difftetvr.view.frames.lettering import Ink, Layer

CAMERA = dtv.Camera.look_at((2.0, -3.0, 2.0), (0.5, 0.5, 0.5), width=200, height=160)
BOX = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
FUNCTION = dtv.TransferFunction([0.0, 1.0], [1.0, 1.0], [[0, 0, 1], [1, 0, 0]])


def seen():
    """Half of the picture opaque red, a quarter half so, a quarter nothing."""
    color, alpha = torch.zeros(160, 200, 3), torch.zeros(160, 200)
    color[:, :100, 0], alpha[:, :100] = 0.8, 1.0
    color[:, 100:150, 0], alpha[:, 100:150] = 0.4, 0.5
    return color, alpha


def pixels(picture):
    return np.asarray(picture).astype(int)


def test_a_background_lies_behind_and_none_is_straight_alpha():
    over = pixels(framed(*seen(), CAMERA, FrameStyle((0.0, 1.0, 1.0))))
    assert [over[80, x].tolist() for x in (50, 120, 180)] == [[204, 0, 0], [102, 128, 128], [0, 255, 255]]
    clear = framed(*seen(), CAMERA, FrameStyle(None))
    assert clear.mode == "RGBA"
    assert [pixels(clear)[80, x].tolist() for x in (50, 120)] == [[204, 0, 0, 255], [204, 0, 0, 128]]
    assert pixels(clear)[80, 180, 3] == 0


def test_the_axes_box_lies_behind_the_volume_and_its_numbers_beside():
    blank = torch.zeros(160, 200, 3), torch.zeros(160, 200)
    style = FrameStyle((1.0, 1.0, 1.0), box=AxesBox(BOX, unit="m"))
    around = pixels(framed(*blank, CAMERA, style)).sum(2) < 600
    assert around.any(0).sum() > 100
    opaque = torch.ones(160, 200, 3), torch.ones(160, 200)
    before = pixels(framed(*opaque, CAMERA, style)).sum(2) < 600
    # The far corner's edges are hidden by what is opaque, the numbers are not.
    far, _ = CAMERA.project(torch.tensor([[0.0, 1.0, 0.6]]))
    x, y = far[0].int().tolist()
    assert around[y - 2 : y + 3, x - 2 : x + 3].any() and not before[y - 2 : y + 3, x - 2 : x + 3].any()
    assert 50 < before.sum() < around.sum()


def test_a_box_around_the_camera_is_left_out():
    inside = dtv.Camera.look_at((0.5, 0.5, 0.5), (1.0, 0.5, 0.5), width=40, height=40)
    blank = torch.zeros(40, 40, 3), torch.zeros(40, 40)
    assert not pixels(framed(*blank, inside, FrameStyle(box=AxesBox(BOX)))).any()


def test_a_colour_bar_has_the_colours_of_its_function_and_numbers_in_its_range():
    scale = ColorScale("p", (10.0, 20.0), FUNCTION)
    assert torch.allclose(scale.colors(3), torch.tensor([[0, 0, 1], [0.5, 0, 0.5], [1, 0, 0]]).double())
    places, labels = zip(*scale.ticks(), strict=True)
    assert [float(label) for label in labels] == pytest.approx([10 + 10 * place for place in places])
    assert len(labels) > 3
    blank = torch.zeros(160, 200, 3), torch.zeros(160, 200)
    drawn = pixels(framed(*blank, CAMERA, FrameStyle(scale=scale)))
    assert not drawn[:, :150].any()
    blue, red = (np.argwhere((drawn[..., channel] > 200) & (drawn[..., 1] < 60)) for channel in (2, 0))
    assert len(blue) and len(red) and blue[:, 0].mean() > red[:, 0].mean(), "the greatest value is above"


def test_a_logarithmic_bar():
    scale = ColorScale("p", (1.0, 1000.0), FUNCTION, is_log=True)
    places = {label: place for place, label in scale.ticks()}
    assert places["10¹"] == pytest.approx(1 / 3) and places["10²"] == pytest.approx(2 / 3)
    assert float(scale.colors(4)[1, 0]) == pytest.approx(9 / 999)
    assert all(0 <= place <= 1 for place, _ in ColorScale("p", (2.0, 5.0), FUNCTION, is_log=True).ticks())


def test_words_stand_apart_within_the_picture(recwarn):
    """However flat the box, however long the numbers and the name of the scalar, and whatever that is."""
    for size, bounds, ends, is_log, label in (
        (512, BOX * torch.tensor([4.0, 4.0, 1.0]) - 2.0, (0.5, 1.2), False, "p"),
        (256, BOX + 1e5, (1e60, 1e300), True, "$x_{$ \\foo"),
        (200, 1e30 * BOX.double(), (1e-3, 1e-1), True, "a name that goes on and on " * 9),
    ):
        middle = bounds.double().mean(0)
        eye = middle + 3.0 * float(bounds[1, 0] - bounds[0, 0]) * torch.tensor([0.5, -0.8, 0.5], dtype=torch.float64)
        box = AxesBox(bounds, unit="mm")
        layer = Layer(size, size, Ink("white", "black"))
        draw_color_bar(layer, ColorScale(label, ends, FUNCTION, is_log))
        ProjectedBox(box, dtv.Camera.look_at(eye, middle, width=size, height=size)).draw_numbers(layer)
        words = layer.words
        assert sum("(mm)" in text for text, _ in words) == 3
        boxes = [box for _, box in words]
        assert all(min(box.left, box.top, size - box.right, size - box.bottom) >= 0.0 for box in boxes)
        assert not any(one.meets(other, 0.0) for one, other in itertools.combinations(boxes, 2))
    assert not recwarn.list


def test_small_letters_are_whole():
    """Matplotlib moves straight lines to pixels, and so leaves bars of letters out."""
    for part in range(8):
        layer = Layer(40, 20, Ink("white", "black"))
        layer.text((20.0, 10.0 + part / 8), "E")
        drawn = np.asarray(layer.drawn()).astype(int)
        bright = drawn[..., 0] * drawn[..., 3] // 255
        lit = bright[:, np.flatnonzero((bright > 100).any(0))[-2]] > 60
        assert np.count_nonzero(lit[1:] & ~lit[:-1]) == 3, "an E has three bars"


def test_a_bar_beside_a_picture_leaves_it_as_it_is():
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 300, 3), dtype=np.uint8))
    whole = beside_color_bar(picture, ColorScale("p", (0.0, 1.0), FUNCTION), (1.0, 1.0, 1.0))
    assert whole.height == 90 and whole.width > 350
    assert np.array_equal(pixels(whole)[:, :300], pixels(picture))
    assert (pixels(whole)[:, 300:].sum(2) < 600).any()


def frames(count, then=None):
    for index in range(count):
        yield Image.new("RGB", (31, 22), (40 * index, 0, 0))
    if then is not None:
        raise then


def test_films_as_folders_and_animations(tmp_path):
    assert save_film(tmp_path / "film", frames(3), 10.0) == 3
    assert [path.name for path in sorted((tmp_path / "film").iterdir())] == ["00000.png", "00001.png", "00002.png"]
    assert Image.open(tmp_path / "film" / "00002.png").getpixel((5, 5)) == (80, 0, 0)
    for name in ("film.webp", "film.gif"):
        assert save_film(tmp_path / name, frames(3), 10.0) == 3
        film = Image.open(tmp_path / name)
        assert film.n_frames == 3 and film.size == (31, 22)
        film.seek(2)
        assert abs(film.convert("RGB").getpixel((5, 5))[0] - 80) < 8
        assert film.info["duration"] == 100
    with pytest.raises(CaptureError, match="is there already"):
        save_film(tmp_path / "film", frames(1), 10.0)
    with pytest.raises(CaptureError, match=r"written as \.mp4"):
        save_film(tmp_path / "film.png", frames(1), 10.0)
    with pytest.raises(CaptureError, match="has no frames"):
        save_film(tmp_path / "none.webp", frames(0), 10.0)


@pytest.mark.parametrize("name", ["film", "film.webp", "film.mp4"])
def test_what_is_interrupted_leaves_nothing(tmp_path, name):
    if name.endswith(".mp4"):
        pytest.importorskip("imageio_ffmpeg")
    for error in (KeyboardInterrupt(), CaptureError("no.")):
        with pytest.raises(type(error)):
            save_film(tmp_path / name, frames(2, error), 10.0)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["film.mp4", "film.webm"])
def test_videos(tmp_path, name, capfd):
    reader = pytest.importorskip("imageio_ffmpeg")
    assert save_film(tmp_path / name, frames(5), 10.0) == 5
    film = reader.read_frames(str(tmp_path / name))
    about = next(film)
    assert about["size"] == (30, 22) and about["fps"] == 10.0
    shown = [np.frombuffer(frame, np.uint8).reshape(22, 30, 3) for frame in film]
    assert [frame[11, 15, 0] for frame in shown] == pytest.approx([0, 40, 80, 120, 160], abs=6)
    # Players of large videos take another red than those of small ones, where none is named.
    assert "bt709" in about["pix_fmt"]
    assert capfd.readouterr() == ("", ""), "the encoder is silent"


def test_films_of_a_kind_that_cannot_look_so(tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    clear, point = Image.new("RGBA", (20, 20)), Image.new("RGB", (1, 20))
    for name, frame, fps, said in (
        ("film.mp4", clear, 10, "A .mp4 knows no shades of transparency"),
        ("film.gif", clear, 10, "A .gif knows no shades of transparency"),
        ("film.webm", point, 10, "1 x 20 pixels is too small"),
        ("film.gif", point, 60, "at most 50 frames a second"),
    ):
        with pytest.raises(CaptureError, match=said):
            save_film(tmp_path / name, [frame], fps)
    assert list(tmp_path.iterdir()) == []
    assert save_film(tmp_path / "film.webp", [clear], 10) == 1


def test_animations_take_as_long_as_they_should(tmp_path):
    for name, fps in (("film.gif", 30.0), ("film.webp", 24.0)):
        save_film(tmp_path / name, frames(6), fps)
        film, took = Image.open(tmp_path / name), []
        for index in range(film.n_frames):
            film.seek(index)
            film.load()
            took.append(film.info["duration"])
        assert sum(took) == pytest.approx(1000 * 6 / fps, abs=0.1)


@pytest.mark.parametrize("stop", [0, 2])
def test_a_video_that_its_encoder_could_not_finish_is_none(tmp_path, monkeypatch, stop):
    """As on a full disk, of which the encoder may learn while it closes the file."""
    reader = pytest.importorskip("imageio_ffmpeg")
    write = reader.write_frames

    def failing(path, *args, **options):
        encoder = write(path, *args, **options)
        yield encoder.send(None)
        count = 0
        try:
            while True:
                encoder.send((yield))
                count += 1
                if count == stop:
                    raise OSError("FFMPEG COMMAND:\nand more")
        finally:
            encoder.close()
            with open(path, "r+b") as file:
                file.truncate(100)

    monkeypatch.setattr(reader, "write_frames", failing)
    with pytest.raises(CaptureError, match=r"^Cannot write [^\n]*film\.mp4: the encoder [^\n]*$"):
        save_film(tmp_path / "film.mp4", frames(4), 10.0)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(CaptureError, match=r"pip install 'difftetvr\[film\]'"):
        save_film(tmp_path / "film.mp4", frames(2), 10.0)
    assert list(tmp_path.iterdir()) == []
