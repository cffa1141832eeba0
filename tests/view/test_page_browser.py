"""Pages in a browser without a window: their pictures are those of `render`, and they do what is asked."""

import io
import json
import time
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from PIL import Image
from view.browser import CHROMIUM, WEBGPU_OPTIONS, Browser
from view.page_scenes import (
    CAMERAS,
    constant_colors,
    constant_scalars,
    directional_colors,
    jittered,
    require_alike,
    require_no_complaints,
    require_webgpu,
    scalars_with_a_jump,
)

import difftetvr as dtv
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, ScalarField

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")

SETTLED = "/pixels in/.test(document.querySelector('.drawn').textContent)"


@pytest.fixture(scope="module")
def webgl() -> Iterator[Browser]:
    with Browser(720, 480, fragment="#webgl") as browser:
        yield browser


@pytest.fixture(scope="module")
def webgpu(tmp_path_factory) -> Iterator[Browser]:
    with Browser(720, 480, WEBGPU_OPTIONS, "#webgpu") as browser:
        require_webgpu(browser, tmp_path_factory.mktemp("empty"))
        yield browser


@pytest.fixture(params=["webgl", "webgpu"])
def browser(request) -> Iterator[Browser]:
    browser = request.getfixturevalue(request.param)
    yield browser
    require_no_complaints(browser)


def opened(browser, tmp_path, mesh, field, **options) -> None:
    dtv.view.save_page(tmp_path / "a.html", mesh, field, dtv.view.PageOptions(**options))
    browser.open(tmp_path / "a.html")
    assert browser.failure is None
    assert browser.run("difftetvr.renderer") == {"#webgl": "WebGL 2", "#webgpu": "WebGPU"}[browser.fragment]


def test_directional_colours_of_a_mesh_with_holes(browser, tmp_path):
    scene = directional_colors()
    opened(browser, tmp_path, *scene)
    require_alike(browser, scene, CAMERAS)
    require_alike(browser, scene, CAMERAS[:1], clip=(0.6, 0.8, 0.1, -3.0))


def test_scalars_with_a_jump(browser, tmp_path):
    scene = scalars_with_a_jump()
    opened(browser, tmp_path, *scene)
    require_alike(browser, scene, CAMERAS)
    require_alike(browser, scene, CAMERAS[1:2], clip=(0.0, 0.0, -1.0, 5.6))


@pytest.mark.parametrize("scene", [constant_colors, constant_scalars])
def test_cells_that_are_constant(browser, tmp_path, scene):
    scene = scene()
    opened(browser, tmp_path, *scene)
    require_alike(browser, scene, CAMERAS)


def test_rays_along_edges_and_through_vertices(browser, tmp_path):
    """Where nearly every decision is a tie."""
    mesh = TetMesh.grid((8, 8, 8), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    field = Field(mesh.vertices.clone(), torch.full((mesh.num_vertices,), 2.0))
    opened(browser, tmp_path, mesh, field)
    eyes = [(0.5, -2.0, 0.5), (3.0, 3.0, 3.0), (-1.5, 0.5, 2.5), (0.5, 0.5, 0.5)]
    cameras = [
        Camera.look_at(e, (0.5, 0.5, 0.501 if k == 3 else 0.5), (0, 0.1, 1), 0.9, 65, 65)
        for k, e in enumerate(eyes[:3])
    ]
    cameras.append(Camera.look_at(eyes[3], (0.5, 1.5, 0.5), (0, 0, 1), 1.2, 65, 65))
    require_alike(browser, (mesh, field), cameras)


def test_cells_that_rounding_turns_inside_out(browser, tmp_path):
    """A layer as thin as no float of the page tells."""
    mesh = TetMesh.grid((5, 5, 3)).to(dtype=torch.float64)
    x, y, layer = mesh.vertices.unbind(1)
    z = torch.tensor([0.0, 0.5, 0.5 + 1e-9, 1.0], dtype=torch.float64)[(3 * layer).round().long()]
    turn = torch.linalg.qr(torch.tensor([[1.0, 0.3, 0.2], [0.1, 1.0, 0.4], [0.3, 0.2, 1.0]]).double())[0]
    turn = turn * torch.linalg.det(turn)
    mesh = mesh.with_vertices(torch.stack((x, y, z), dim=1) @ turn.T + torch.tensor([4.0, 0.0, 5.5]))
    field = Field(torch.rand(mesh.num_vertices, 3), 3.0 * torch.rand(mesh.num_vertices))
    page = dtv.view.save_page(tmp_path / "a.html", mesh, field)
    assert page.inverted > 5 and float(mesh.volumes().min()) > 0.0
    browser.open(tmp_path / "a.html")
    require_alike(browser, (mesh, field), CAMERAS[:2])


def changed_by(browser, action) -> bool:
    """Whether a settled picture is another after something was done and it has settled again."""
    browser.wait_for(SETTLED)
    before = browser.picture()
    browser.run("document.querySelector('.drawn').textContent = ''")
    action()
    browser.wait_for(SETTLED)
    return browser.picture() != before


def choosing(control: int, item: int) -> str:
    """What chooses an item: of the quality 0 Fast, of the cut 1 across x."""
    chosen = f"s.selectedIndex = {item}; s.dispatchEvent(new Event('change'))"
    return f"{{ const s = document.querySelectorAll('select')[{control}]; {chosen} }}"


def test_what_hands_do(browser, tmp_path):
    mesh = jittered(3, 3, 3)
    field = ScalarField(mesh.vertices[:, 0], TransferFunction.default())
    opened(browser, tmp_path, mesh, field, title="A & B", scalar="height")
    assert browser.run("document.querySelector('h1').textContent") == "A & B"
    browser.wait_for(SETTLED)
    browser.run("document.querySelector('.drawn').textContent = ''")
    browser.resize(700, 300)  # a small picture is a quick one; any narrower, and the panel would be below it
    browser.run(choosing(0, 0))
    assert changed_by(browser, lambda: browser.drag((60, 200), (90, 180)))
    browser.wait_for("document.querySelector('#poster').classList.contains('gone')")
    assert changed_by(browser, lambda: browser.mouse("mouseWheel", 60, 200, deltaX=0, deltaY=-120))

    def pinch() -> None:
        for kind, places in (("touchStart", (50, 90)), ("touchMove", (30, 130)), ("touchEnd", ())):
            points = [{"x": x, "y": 200, "id": k} for k, x in enumerate(places)]
            browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    assert changed_by(browser, pinch)
    box = browser.run("JSON.stringify(document.querySelector('.curve').getBoundingClientRect())")
    box = json.loads(box)
    # The last knot of the default function: opacity 0.7.
    knot = (box["right"] - 9, box["bottom"] - 9 - 0.7**0.5 * (box["height"] - 18))
    assert changed_by(browser, lambda: browser.drag(knot, (knot[0], box["bottom"] - 10)))
    assert changed_by(browser, lambda: browser.run(choosing(1, 1)))
    reset, save = (f"document.querySelectorAll('.buttons button')[{k}].click()" for k in (0, 1))
    assert changed_by(browser, lambda: browser.run(reset))
    browser.run("URL.createObjectURL = blob => { window.saved = blob; return '' }")
    browser.run("HTMLAnchorElement.prototype.click = () => {}")
    browser.run(save)
    browser.wait_for("window.saved")
    size = "createImageBitmap(saved).then(image => [saved.type, image.width, image.height])"
    # Without what the panel covers, in the quality Fast.
    assert browser.run(size) == ["image/png", round((700 - 324) / 2), 150]
    browser.resize(720, 480)


def test_a_browser_that_cannot_draw_says_so_and_shows_the_poster(browser, tmp_path):
    mesh = jittered(2, 2, 2)
    field = Field(torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices))
    dtv.view.save_page(tmp_path / "a.html", mesh, field)
    with browser.scripted("HTMLCanvasElement.prototype.getContext = () => null"):
        browser.open(tmp_path / "a.html")
    assert "no WebGL 2" in browser.failure
    is_seen = "p.complete && p.naturalWidth === 512 && !p.classList.contains('gone')"
    assert browser.run(f"(p => {is_seen})(document.querySelector('#poster'))")


def test_a_frame_in_a_notebook_draws(browser, tmp_path):
    mesh = jittered(2, 2, 2)
    field = Field(torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices))
    (tmp_path / "a.html").write_text(f"<body>{dtv.view.show(mesh, field, height=200)._repr_html_()}")
    browser.call("Page.navigate", url=(tmp_path / "a.html").as_uri())
    browser.wait_for("document.readyState === 'complete' && document.querySelector('iframe')")
    # The frame's inside is closed to the page around it, so the picture has to tell.
    for _ in range(200):
        picture = np.asarray(Image.open(io.BytesIO(browser.picture())).convert("RGB"))
        if picture[80:140, 120:300].std() > 2.0 and (picture[:, 20:700] == 0).all(axis=2).any():
            return
        time.sleep(0.05)
    raise AssertionError("the frame stays empty")
