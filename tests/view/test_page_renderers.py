"""Which renderer draws a page: WebGPU, or WebGL 2 where that cannot; and that both draw the same."""

import io
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image
from view.browser import CHROMIUM, WEBGPU_OPTIONS, Browser, rendered
from view.page_scenes import (
    BACKGROUND,
    CAMERAS,
    constant_colors,
    directional_colors,
    psnr,
    require_alike,
    require_no_complaints,
    require_webgpu,
    scalars_with_a_jump,
)

import difftetvr as dtv

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")

DRAWN_BY = "(document.querySelector('.drawn').innerText.match(/Drawn by .*/) ?? [''])[0]"
# Adapters that compute on the CPU say that they do not.
AS_IF_A_CARD = "Object.defineProperty(GPUAdapterInfo.prototype, 'isFallbackAdapter', { get: () => false });"
KEEP_DEVICE = """{
  const { requestDevice } = GPUAdapter.prototype;
  GPUAdapter.prototype.requestDevice = async function (...wanted) {
    return (window.device = await requestDevice.apply(this, wanted));
  };
}"""


@pytest.fixture(scope="module")
def shared_browser(tmp_path_factory) -> Iterator[Browser]:
    with Browser(720, 200, WEBGPU_OPTIONS) as browser:
        require_webgpu(browser, tmp_path_factory.mktemp("empty"))
        yield browser


@pytest.fixture
def browser(shared_browser) -> Iterator[Browser]:
    yield shared_browser
    shared_browser.fragment = ""
    require_no_complaints(shared_browser)


def opened(browser, folder, scene, fragment="") -> None:
    path = folder / f"{scene.__name__}-{fragment[1:]}.html"
    dtv.view.save_page(path, *scene())
    browser.fragment = fragment
    browser.open(path)
    assert browser.failure is None


def drawn_by(browser) -> str:
    """What the panel says, once the picture is there."""
    browser.wait_for(DRAWN_BY)
    assert browser.run("document.querySelectorAll('.picture canvas').length") == 1
    return browser.run(DRAWN_BY)


def window_of(browser) -> np.ndarray:
    """What is seen, but for the panel: that tells who draws."""
    return np.asarray(Image.open(io.BytesIO(browser.picture())).convert("RGB"))[:, :380] / 255.0


@pytest.mark.parametrize("scene", [directional_colors, scalars_with_a_jump, constant_colors])
def test_both_renderers_draw_the_same(browser, tmp_path, scene):
    pictures, audits = [], []
    for fragment in ("#webgl", "#webgpu"):
        opened(browser, tmp_path, scene, fragment)
        found = [rendered(browser, camera, BACKGROUND) for camera in CAMERAS]
        pictures.append([pixels for pixels, _ in found])
        audits.append([audit for _, audit in found])
    assert browser.run("difftetvr.renderer") == "WebGPU"
    # Levels of 8 bits may be rounded to either side, and steps along an edge go to either side of it.
    assert all(psnr(a, b) > 55.0 for a, b in zip(*pictures, strict=True))
    for a, b in zip(*audits, strict=True):
        assert a["mostSteps"] == b["mostSteps"] and abs(a["meanSteps"] / b["meanSteps"] - 1.0) < 1e-3


def test_webgpu_draws_where_there_is_a_graphics_card(browser, tmp_path):
    with browser.scripted(AS_IF_A_CARD):
        opened(browser, tmp_path, constant_colors)
        assert drawn_by(browser) == "Drawn by WebGPU"
    opened(browser, tmp_path, scalars_with_a_jump)
    assert drawn_by(browser) == "Drawn by WebGL 2. WebGPU would compute on the CPU here."


FAILURES = {
    "This browser has no WebGPU": "delete Navigator.prototype.gpu",
    "WebGPU finds no graphics card here": "GPU.prototype.requestAdapter = async () => null",
    "no device today": "GPUAdapter.prototype.requestDevice = async () => { throw Error('no device today') }",
    "WebGPU's buffers are too small": (
        "Object.defineProperty(GPUSupportedLimits.prototype, 'maxBufferSize', { get: () => 1000 })"
    ),
    "unresolved value 'nonsense'": """{
      const { createShaderModule } = GPUDevice.prototype;
      GPUDevice.prototype.createShaderModule = function ({ code }) {
        return createShaderModule.call(this, { code: code + 'const a = nonsense;' });
      };
    }""",
    "WebGPU cannot draw on this page": """{
      const { getContext } = HTMLCanvasElement.prototype;
      HTMLCanvasElement.prototype.getContext = function (kind, ...options) {
        return kind === 'webgpu' ? null : getContext.call(this, kind, ...options);
      };
    }""",
}


@pytest.mark.parametrize("reason", FAILURES)
def test_pages_go_back_to_webgl(browser, tmp_path, reason):
    with browser.scripted(FAILURES[reason]):
        opened(browser, tmp_path, constant_colors, "#webgpu")
    assert drawn_by(browser).startswith("Drawn by WebGL 2. ") and reason in drawn_by(browser)
    require_alike(browser, constant_colors(), CAMERAS[:1])


def test_a_lost_device_is_replaced_with_all_that_was_set(browser, tmp_path):
    with browser.scripted(KEEP_DEVICE):
        opened(browser, tmp_path, scalars_with_a_jump, "#webgpu")
    drawn_by(browser)
    # Half of it is cut away.
    choose = "s.selectedIndex = 1; s.dispatchEvent(new Event('change'))"
    forget = "document.querySelector('.drawn').textContent = ''"
    browser.run(f"{{ const s = document.querySelectorAll('select')[1]; {choose}; {forget} }}")
    drawn_by(browser)
    before = window_of(browser)
    browser.run(f"{forget}; device.destroy()")
    assert drawn_by(browser).startswith("Drawn by WebGL 2. WebGPU has failed: ")
    assert browser.run("difftetvr.renderer") == "WebGL 2" and browser.failure is None
    assert psnr(window_of(browser), before) > 55.0
    require_alike(browser, scalars_with_a_jump(), CAMERAS[:1])


def test_a_device_lost_in_the_middle_of_a_picture(browser, tmp_path):
    with browser.scripted(KEEP_DEVICE):
        opened(browser, tmp_path, directional_colors, "#webgpu")
    browser.run("device.destroy()")
    assert drawn_by(browser).startswith("Drawn by WebGL 2. WebGPU has failed: ")
    browser.wait_for("document.querySelector('#poster').classList.contains('gone')")
    require_alike(browser, directional_colors(), CAMERAS[:1])
