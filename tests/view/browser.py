"""Chromium without a window, driven through two pipes by its DevTools protocol: no packages, no ports."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
_OPTIONS = [
    *("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--remote-debugging-pipe", "--no-first-run", "--disable-extensions", "--hide-scrollbars", "--mute-audio"),
]

# WebGPU without a graphics card, and how its pictures come to the screen.
WEBGPU_OPTIONS = (
    *("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader"),
    *("--enable-features=Vulkan", "--use-vulkan=swiftshader"),
)
# What is in the log, but is no complaint about a page: that there is no graphics card, and that reading takes time.
_REMARKS = ("No available adapters", "GL Driver Message (OpenGL, Performance")
_LONGEST_WAIT = 60  # seconds


class Browser:
    """A browser with one window; a context manager.

    Args:
        width: Pixels of the window's inside.
        height: Likewise.
        options: Further ones of Chromium's.
        fragment: What is put behind the addresses of pages: which renderer draws.
    """

    def __init__(self, width: int = 640, height: int = 480, options: Sequence[str] = (), fragment: str = "") -> None:
        assert CHROMIUM is not None
        self.fragment = fragment
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        command = [CHROMIUM, *_OPTIONS, *options, f"--user-data-dir={self._folder.name}"]
        its_input, self._to = os.pipe()
        self._from, its_output = os.pipe()
        # The protocol's ends are files 3 and 4, whatever numbers the pipes have here.
        script = f'exec "$@" 3<&{its_input} 4>&{its_output}'
        self._process = subprocess.Popen(
            ["bash", "-c", script, "bash", *command],
            pass_fds=(its_input, its_output),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(its_input)
        os.close(its_output)
        self._buffer, self._count = b"", 0
        self._session: str | None = None
        self.errors: list[str] = []
        self.requests: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Page", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.resize(width, height)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._process.terminate()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)
        self._folder.cleanup()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Asks for something and waits for the answer; what else comes is noted."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def open(self, page: Path) -> None:
        """Opens a page and waits until its script has begun."""
        # An address of its own: to go to that of the page that is open, with a fragment, would load nothing.
        self.call("Page.navigate", url=f"{page.resolve().as_uri()}?{self._count}{self.fragment}")
        self.wait_for("window.difftetvr || document.querySelector('.failure')")

    def visit(self, address: str) -> None:
        """Goes to an address and waits until something can be drawn there."""
        self.call("Page.navigate", url=address)
        self.wait_for("document.querySelector('canvas')")

    @contextmanager
    def scripted(self, script: str) -> Iterator[None]:
        """Pages that are opened meanwhile run a script before their own."""
        hook = self.call("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"]
        yield
        self.call("Page.removeScriptToEvaluateOnNewDocument", identifier=hook)

    @property
    def failure(self) -> str | None:
        """What the page says that went wrong."""
        return self.run("document.querySelector('.failure')?.textContent ?? null")

    def resize(self, width: int, height: int) -> None:
        """Gives the window's inside a size in pixels."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)

    def run(self, expression: str) -> Any:
        """What an expression is worth."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, condition: str) -> None:
        """Waits until an expression is true."""
        look = f"const look = () => ({condition}) ? done() : setTimeout(look, 30); look();"
        give_up = f"setTimeout(() => fail(Error('waited in vain')), {1000 * _LONGEST_WAIT});"
        self.run(f"new Promise((done, fail) => {{ {look} {give_up} }})")

    def mouse(self, kind: str, x: float, y: float, **parameters: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **parameters)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Presses, moves and lets go."""
        held = {"button": "left", "buttons": 1}
        self.mouse("mousePressed", *start, clickCount=1, **held)
        self.mouse("mouseMoved", *end, **held)
        self.mouse("mouseReleased", *end, clickCount=1, button="left")

    def picture(self) -> bytes:
        """PNG of the window."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            is_there = select.select([self._from], [], [], 2 * _LONGEST_WAIT)[0]
            received = os.read(self._from, 1 << 20) if is_there else b""
            assert received, "the browser has ended, or says nothing any more"
            self._buffer += received
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def _note(self, event: dict[str, Any]) -> None:
        method, parameters = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.errors.append(str(parameters["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning"):
            self.errors.append(str(parameters["args"]))
        elif method == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
            entry = parameters["entry"]
            if not any(remark in entry["text"] for remark in _REMARKS):
                self.errors.append(str(entry))
        elif method == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])


def rendered(browser: Browser, camera: Any, background: Any = (0, 0, 0), clip: Any = None) -> tuple[np.ndarray, dict]:
    """(H, W, 3) values from 0 to 1 that the page draws for a camera, and what happened to its rays."""
    request = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    request |= {"worldToCamera": camera.world_to_camera.double().tolist(), "background": list(background)}
    request |= {"clip": list(clip)} if clip is not None else {}
    answer = browser.run(f"difftetvr.render({json.dumps(request)})")
    pixels = np.frombuffer(base64.b64decode(answer["pixels"]), np.uint8)
    return pixels.reshape(camera.height, camera.width, 4)[..., :3] / 255.0, answer["audit"]
