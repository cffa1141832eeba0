"""The viewer in browsers without a window: pictures, drags, edits, several clients, and what stays in memory."""

import io
import logging
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from view.browser import CHROMIUM, Browser
from view.live import scenes

from difftetvr.capture.camera_paths import load_camera_path
from difftetvr.errors import DiffTetError
from difftetvr.rendering import Camera, load_camera
from difftetvr.view.cut import Plane, cut_edges
from difftetvr.view.live.quantities import picture_of
from difftetvr.view.live.server import Listening, LiveServer

pytest.importorskip("viser")

SIZE = (640, 400)
PANEL = 340  # pixels on the right that the panels may cover
MOST_GROWTH = 24e6  # bytes
_PATIENCE = 30.0


class Served:
    """A server whose pictures are drawn by a thread of its own."""

    def __init__(self, scene, folder):
        self.server = LiveServer(scene, Listening(folder, port=0))
        self.is_over = threading.Event()
        self._thread = threading.Thread(target=self.server.serve, args=(self.is_over.is_set,))
        self._thread.start()

    def close(self):
        self.is_over.set()
        self._thread.join()
        self.server.close()

    @property
    def clients(self):
        return self.server.desk.server.get_clients()


def wait_until(condition) -> None:
    end = time.monotonic() + _PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Iterator[Served]:
    served = Served(scenes.scalars(), tmp_path_factory.mktemp("saved"))
    yield served
    served.close()


@pytest.fixture(scope="module")
def browser(served) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    with Browser(*SIZE) as browser:
        open_in(browser, served)
        yield browser


def open_in(browser, served) -> None:
    """Opens the page, without what it says of browsers that draw without a GPU."""
    browser.visit(served.server.address)
    wait_until(lambda: len(served.clients) == 1)
    close = "document.querySelectorAll('.mantine-Notification-closeButton')"
    browser.wait_for(f"{close}.length")
    browser.run(f"{close}.forEach(button => button.click())")
    wait_until(lambda: not browser.run(f"{close}.length"))


@pytest.fixture(autouse=True)
def without_complaints(request) -> Iterator[None]:
    yield
    if "browser" in request.fixturenames:
        complaints = [e for e in request.getfixturevalue("browser").errors if "THREE.Clock" not in e]
        assert not complaints


def screen(browser) -> np.ndarray:
    """(H, W, 3) what is seen beside the panels."""
    picture = Image.open(io.BytesIO(browser.picture())).convert("RGB")
    return np.asarray(picture).astype(float)[:, : SIZE[0] - PANEL]


def drawn(served, client) -> Image.Image:
    """What a client is to see, in the pixels that its browser draws in: fewer than the window's where that is slow."""
    studio = served.server.studio
    return picture_of(studio.scene, studio.settings, served.server.desk.camera_of(client))


def expected(served, client) -> np.ndarray:
    """The same in the pixels of the window, beside the panels."""
    return np.asarray(drawn(served, client).resize(SIZE)).astype(float)[:, : SIZE[0] - PANEL]


def settled(browser, served) -> np.ndarray:
    """What is seen, once that is what the first client is to see."""
    client = next(iter(served.clients.values()))
    end, difference = time.monotonic() + _PATIENCE, np.inf
    while time.monotonic() < end:
        seen = screen(browser)
        difference = np.abs(seen - expected(served, client)).mean()
        if difference < 2.0:
            return seen
    raise AssertionError(f"what is seen is {difference:.1f} of 255 off what is to be seen")


def test_it_opens_and_draws_what_render_does_from_the_same_camera(browser, served):
    seen = settled(browser, served)
    assert seen.std() > 10.0
    client = next(iter(served.clients.values()))
    camera = served.server.desk.camera_of(client)
    assert camera.width / camera.height == pytest.approx(SIZE[0] / SIZE[1], rel=0.01)
    assert np.allclose(camera.position.numpy(), scenes.START.position.numpy(), atol=1e-4)


def test_a_drag_changes_the_picture(browser, served):
    before = settled(browser, served)
    browser.drag((80, 250), (160, 230))
    wait_until(lambda: np.abs(screen(browser) - before).mean() > 2.0)
    settled(browser, served)


def test_a_drag_of_a_knot_and_another_colour_map_change_the_picture(browser, served):
    before = settled(browser, served)
    look = served.server.studio.settings.look
    thumb = "[...document.querySelectorAll('.multi-slider-thumb')].at(-1).getBoundingClientRect()"
    x, y = browser.run(f"(r => [r.x + r.width / 2, r.y + r.height / 2])({thumb})")
    browser.drag((x, y), (x - 60, y))
    wait_until(lambda: served.server.studio.settings.look is not look)
    assert served.server.studio.settings.look.transfer_function.scalar[-2] < 0.9
    wait_until(lambda: np.abs(screen(browser) - before).max() > 20.0)
    dragged = settled(browser, served)
    browser.run("[...document.querySelectorAll('input')].find(i => i.value == 'as given').click()")
    option = "[...document.querySelectorAll('[role=option]')].find(o => o.textContent == 'viridis')"
    browser.run(f"{option}.click()")
    wait_until(lambda: served.server.studio.settings.look.transfer_function.color.shape[0] > 30)
    wait_until(lambda: np.abs(screen(browser) - dragged).max() > 20.0)
    settled(browser, served)


def test_outlines_of_cells_lie_where_the_picture_has_them(browser, served):
    before = settled(browser, served)
    studio, panel = served.server.studio, served.server.clip_panel
    client = next(iter(served.clients.values()))
    panel.choose("x", is_on=True, has_cells=True)
    wait_until(lambda: studio.settings.clip is not None)
    edges = cut_edges(studio.scene.content.mesh, Plane((1.0, 0.0, 0.0), (2.0, 2.0, 2.0)))
    camera = served.server.desk.camera_of(client)
    points = camera.project(torch.from_numpy(edges.mean(1)))[0].numpy() * (SIZE[0] / camera.width)
    points = points[(points > 4).all(1) & (points[:, 0] < SIZE[0] - PANEL - 4) & (points[:, 1] < SIZE[1] - 4)]
    assert len(points) > 20
    column, row = points.round().astype(int).T

    def shares() -> tuple[float, float]:
        lit = screen(browser).min(2) > 110.0
        near = [lit[r - 2 : r + 2, c - 2 : c + 2].any() for r, c in zip(row, column)]
        return float(np.mean(near)), float(lit.mean())

    wait_until(lambda: shares()[0] > 0.9)
    assert shares()[1] < 0.3  # and not everywhere
    panel.choose("x", is_on=False, has_cells=False)
    wait_until(lambda: np.abs(screen(browser) - before).mean() < 1.0)


def test_two_clients_see_the_same_scene_from_their_own_places_and_one_goes_away(browser, served):
    with Browser(*SIZE) as other:
        other.visit(served.server.address)
        wait_until(lambda: len(served.clients) == 2)
        first, second = served.clients.values()
        served.server.desk.move(second, Camera.look_at((2.0, -7.0, 2.0), scenes.MIDDLE, (0, 0, 1), 0.9, *SIZE))
        served.server.studio.change(mode="depth complexity")
        settled(browser, served)
        wait_until(lambda: np.abs(screen(other) - expected(served, second))[200:, :].mean() < 3.0)
        assert np.abs(expected(served, first) - expected(served, second)).mean() > 3.0
    wait_until(lambda: len(served.clients) == 1)
    served.server.studio.change(mode="color")
    settled(browser, served)


def press(browser, text) -> None:
    """Clicks on the innermost thing with a text: a button, or the head of a folder."""
    browser.run(f"[...document.querySelectorAll('*')].filter(e => e.textContent.trim() == '{text}').at(-1).click()")


def test_pictures_cameras_paths_and_films_are_saved_by_hand(browser, served):
    settled(browser, served)
    folder, client = served.server.desk.folder, next(iter(served.clients.values()))
    for head, content in (("Save", "Save picture"), ("Camera path", "Add this view")):
        press(browser, head)
        browser.wait_for(f"document.body.innerText.includes('{content}')")
    press(browser, "Save picture")
    wait_until(lambda: (folder / "picture-1.png").exists())
    assert np.array_equal(np.asarray(Image.open(folder / "picture-1.png")), np.asarray(drawn(served, client)))
    press(browser, "Save camera")
    wait_until(lambda: (folder / "camera-1.json").exists())
    camera = load_camera(folder / "camera-1.json")
    assert (camera.width, camera.height) == drawn(served, client).size
    press(browser, "Add this view")
    wait_until(lambda: "1 view to run through" in browser.run("document.body.innerText"))
    served.server.desk.move(client, Camera.look_at((2.0, -7.0, 2.0), scenes.MIDDLE, (0, 0, 1), 0.9, *SIZE))
    wait_until(lambda: served.server.desk.camera_of(client).position[1] < -6.9)
    press(browser, "Add this view")
    wait_until(lambda: "2 views to run through" in browser.run("document.body.innerText"))
    press(browser, "Save path")
    wait_until(lambda: (folder / "path-1.json").exists())
    path = load_camera_path(folder / "path-1.json")
    assert len(path.cameras) == 2 and path.frames == 120
    assert torch.allclose(path.cameras[0].position, camera.position.double(), atol=1e-4)
    press(browser, "Clear")
    assert sorted(file.name for file in folder.iterdir()) == ["camera-1.json", "path-1.json", "picture-1.png"]


def resident() -> float:
    """Bytes of memory of this process."""
    return 1024.0 * int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0])


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is looked up where Linux tells it")
@pytest.mark.parametrize("frames", [150, pytest.param(500, marks=pytest.mark.slow)])
def test_memory_does_not_grow_with_frames(browser, served, frames):
    client = next(iter(served.clients.values()))
    studio, window = served.server.studio, served.server.window_of(client)
    show, shown = window.show, threading.Semaphore(0)

    def counting(picture, is_full):
        show(picture, is_full)
        shown.release()

    window.show = counting

    def turn(count) -> None:
        for frame in range(count):
            angle = 0.05 * frame
            eye = (2.0 + 7.0 * np.cos(angle), 2.0 + 7.0 * np.sin(angle), 3.5)
            studio.look(window, Camera.look_at(eye, scenes.MIDDLE, (0, 0, 1), 0.9, 320, 200))
            assert shown.acquire(timeout=_PATIENCE)

    def in_browser() -> float:
        browser.call("HeapProfiler.collectGarbage")
        return float(browser.run("performance.memory.usedJSHeapSize"))

    browser.resize(160, 120)  # drawn by the CPU, a large window takes most of it
    turn(60)
    before, before_there = resident(), in_browser()
    turn(frames)
    grown, grown_there = resident() - before, in_browser() - before_there
    browser.resize(*SIZE)
    assert grown < MOST_GROWTH and grown_there < MOST_GROWTH


def test_pages_of_other_sites_are_refused(served):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    address, version = served.server.address.replace("http", "ws"), __import__("viser").__version__
    protocols = [f"viser-v{version}"]
    with connect(address, subprotocols=protocols, max_size=None) as own:
        assert own.recv(timeout=_PATIENCE)
    port = served.server.desk.server.get_port()
    with socket.create_connection(("127.0.0.1", port)) as line:
        strangers = [
            (address, {"origin": "http://elsewhere.example"}),
            (f"ws://elsewhere.example:{port}", {"sock": line}),
        ]
        for name, how in strangers:
            with connect(name, subprotocols=protocols, max_size=None, **how) as other:
                with pytest.raises(ConnectionClosed):
                    other.recv(timeout=_PATIENCE)
                assert other.close_code == 1008


def test_garbage_harms_nobody_and_is_not_told_with_a_traceback(tmp_path, capfd, monkeypatch):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # those of pytest, which no user has
    with LiveServer(scenes.colored(), Listening(tmp_path, port=0)) as server:
        with socket.create_connection(("127.0.0.1", server.desk.server.get_port())) as line:
            line.sendall(bytes(range(256)))
            assert line.recv(1) == b""
        address, protocol = server.address.replace("http", "ws"), f"viser-v{__import__('viser').__version__}"
        for garbage in ("words", b"\xff", b"\x81\xa4type\xa7Nothing"):
            with connect(address, subprotocols=[protocol], max_size=None) as stranger:
                stranger.send(garbage)
                with pytest.raises(ConnectionClosed):
                    while True:
                        stranger.recv(timeout=_PATIENCE)
        with connect(address, subprotocols=[protocol], max_size=None) as other:
            assert other.recv(timeout=_PATIENCE)
        wait_until(lambda: not server.is_watched)
    assert "Traceback" not in capfd.readouterr().err


def test_a_click_on_a_frustum_looks_through_its_camera(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    scene = scenes.photographed()
    asked = scene.views.cameras[1]
    served = Served(scene, tmp_path)
    try:
        with Browser(*SIZE) as browser:
            open_in(browser, served)
            client = next(iter(served.clients.values()))
            camera = served.server.desk.camera_of(client)
            # Amid its frustum, which is some pixels wide.
            place = asked.position.double() + 0.3 * asked.world_to_camera[2, :3].double()
            x, y = (camera.project(place[None])[0][0] * SIZE[0] / camera.width).tolist()

            def is_there() -> bool:
                browser.mouse("mouseMoved", x, y)
                browser.drag((x, y), (x, y))
                now = served.server.desk.camera_of(client).position
                return bool(torch.allclose(now.double(), asked.position.double(), atol=0.01))

            wait_until(is_there)
            settled(browser, served)
    finally:
        served.close()


def test_no_page_can_have_the_viewer_shown_elsewhere(served):
    assert served.server.desk.server.request_share_url() is None


def test_a_taken_port_and_an_address_of_others_are_named(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DiffTetError, match=f"Cannot listen at port {port} of 127.0.0.1 .* give another --port"):
            LiveServer(scenes.colored(), Listening(tmp_path, port=port))
    with pytest.raises(DiffTetError, match=r"of 192\.0\.2\.1"):
        LiveServer(scenes.colored(), Listening(tmp_path, "192.0.2.1"))


def test_who_can_look_is_said(served, tmp_path):
    assert served.server.announcement.endswith("only this machine can reach it.")
    with LiveServer(scenes.colored(), Listening(tmp_path, "0.0.0.0", 0)) as open_to_all:
        assert f"anyone in its network can, and can write files to {tmp_path}." in open_to_all.announcement
