"""What a page holds: unpacked again, it is the volume to within the rounding that is promised."""

import base64
import hashlib
import html
import json
import re
import zlib
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch

import difftetvr as dtv
from difftetvr.errors import CameraError, DiffTetError, MeshError
from difftetvr.mesh import Field, TetMesh
from difftetvr.optics import TransferFunction
from difftetvr.rendering import Camera, ScalarField
from difftetvr.view.page.document import Document
from difftetvr.view.page.opening import Opening
from difftetvr.view.page.scene import Scene

ROOT = Path(__file__).resolve().parents[2]


class Unpacked:
    """Header and columns of a scene, read as the script reads them."""

    def __init__(self, text: str) -> None:
        content = zlib.decompress(base64.b64decode(text))
        length = int.from_bytes(content[:4], "little")
        self.header = json.loads(content[4 : 4 + length])
        self.entries, self.columns = {}, {}
        offset = 4 + length
        for entry in self.header["arrays"]:
            size = entry["rows"] * entry["columns"] * entry["width"]
            raw = np.frombuffer(content, np.uint8, size, offset).astype(np.int64)
            planes = raw.reshape(entry["columns"], entry["width"], entry["rows"])
            values = sum(planes[:, byte] << (8 * byte) for byte in range(entry["width"]))
            if entry["differences"]:
                values = np.where(values & 1, -((values >> 1) + 1), values >> 1).cumsum(axis=1)
            self.entries[entry["name"]], self.columns[entry["name"]] = entry, values.T
            offset += size
        assert offset == len(content)

    def positions(self) -> np.ndarray:
        """(V, 3) in the world."""
        steps, box = self.columns["positions"], self.header["box"]
        unit = 2.0 ** self.entries["positions"]["bits"] - 1
        return (steps - 0.5 * steps.max(axis=0)) / unit * box["size"] + np.array(box["center"])

    def cells(self) -> np.ndarray:
        """(T, 4), positive."""
        steps = self.columns["cells"].copy()
        cells = np.empty_like(steps)
        for cell, row in enumerate(steps):
            above = cells[cell - 1] if cell else np.zeros(4, dtype=np.int64)
            cells[cell, 0] = above[0] + row[0]
            cells[cell, 1] = row[1] + (above[1] if cell and row[0] == 0 else cells[cell, 0])
            cells[cell, 2:] = cells[cell, 1] + row[2:].cumsum()
        odd = np.unpackbits(self.columns["odd"][:, 0].astype(np.uint8), bitorder="little")[: len(cells)].astype(bool)
        cells[odd] = cells[odd][:, [0, 1, 3, 2]]
        return cells

    def halves(self, name: str) -> np.ndarray:
        bits = self.columns[name] << self.entries[name]["dropped"]
        return bits.astype(np.uint16).view(np.float16).astype(float)


def ball(count: int = 5) -> TetMesh:
    mesh = TetMesh.grid((count, count, count), (2.0, -1.0, 0.0), (4.0, 0.0, 1.0))
    return mesh.with_vertices(mesh.vertices + 0.03 * torch.rand(mesh.vertices.shape))


def set_of(cells: np.ndarray, positions: np.ndarray) -> set:
    """Cells by the places of their corners, rounded, in an order that tells their orientation."""
    corners = np.round(positions, 3)[cells]
    found = set()
    for cell in corners:
        order = np.lexsort(cell.T[::-1])
        inversions = sum(order[i] > order[j] for i in range(4) for j in range(i + 1, 4))
        found.add((tuple(map(tuple, cell[order])), inversions % 2))
    return found


def test_a_field_is_what_it_was():
    torch.manual_seed(0)
    mesh = ball()
    color, density = torch.rand(mesh.num_vertices, 3) * 3 - 0.5, torch.rand(mesh.num_vertices) * 1000
    harmonics = torch.randn(mesh.num_vertices, 8, 3) * torch.linspace(0, 1, 24).reshape(8, 3)
    found = Unpacked(Scene.of(mesh, Field(color, density, harmonics=harmonics)).pack.text())
    assert found.header["kind"] == "color" and found.header["location"] == "vertex"
    positions, truth = found.positions(), mesh.positions.numpy()
    distances, nearest = torch.cdist(torch.tensor(positions), torch.tensor(truth)).min(dim=1)
    assert float(distances.max()) < 2.2 / 65535 and len(set(nearest.tolist())) == mesh.num_vertices
    assert set_of(found.cells(), truth[nearest]) == set_of(mesh.tets.numpy(), truth)
    # The halves of a mantissa of 8 and 10 bits; of harmonics, half of a step of 1/127.
    scale = found.header["box"]["size"]
    np.testing.assert_allclose(found.halves("color"), color[nearest], rtol=1.01 * 2**-9 + 2**-11, atol=1e-7)
    np.testing.assert_allclose(found.halves("density")[:, 0], density[nearest] * scale, rtol=1.01 * 2**-11)
    steps = np.array(found.entries["harmonics"]["scale"])
    difference = (found.columns["harmonics"] - 128) * steps - harmonics[nearest].flatten(1).numpy()
    assert (abs(difference) <= 0.5001 * steps + 1e-12).all()


def test_scalars_of_cells():
    mesh = ball()
    scalar = mesh.positions[mesh.tets.long()].mean(1)[:, 0]
    function = TransferFunction([0.0, 0.5, 0.5, 1.0], [0.0, 0.2, 0.9, 1.0], torch.rand(4, 3))
    field = ScalarField(scalar, function, 10.0, (2.5, 3.5), "cell")
    found = Unpacked(Scene.of(mesh, field).pack.text())
    entry = found.entries["scalar"]
    values = found.columns["scalar"][:, 0] * entry["step"] + entry["low"]
    centers = found.positions()[found.cells()].mean(axis=1)[:, 0]
    np.testing.assert_allclose(values, centers - 2.5, atol=1e-4)
    transfer = found.header["transfer"]
    assert transfer["density"] == pytest.approx(10.0 * found.header["box"]["size"])
    assert transfer["scalar"] == [0.0, 0.5, 0.5, 1.0] and transfer["range"] == [2.5, 3.5]


def thin_cell(height: float, dtype: torch.dtype = torch.float64) -> TetMesh:
    vertices = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, height]], dtype=dtype)
    return TetMesh(vertices, torch.tensor([[0, 1, 2, 3]]))


def test_thin_cells_get_finer_positions_and_flat_ones_are_counted():
    field = Field(torch.ones(4, 3), torch.ones(4))
    bits = []
    for height in (0.1, 1e-6, 1e-9):
        scene = Scene.of(thin_cell(height), field)
        bits.append((Unpacked(scene.pack.text()).entries["positions"]["bits"], scene.inverted))
    assert bits == [(16, 0), (24, 0), (24, 1)]


def test_scalars_far_wider_than_what_is_looked_at_get_finer_steps():
    mesh = ball(2)
    scalar = torch.linspace(-500.0, 500.0, mesh.num_vertices)
    field = ScalarField(scalar, TransferFunction.default(), 1.0, (0.0, 1.0))
    found = Unpacked(Scene.of(mesh, field).pack.text())
    assert found.entries["scalar"]["step"] < 1000 / 2**23


def test_colours_beyond_halves_and_none_at_all():
    mesh = ball(2)
    color, density = torch.zeros(mesh.num_vertices, 3), torch.zeros(mesh.num_vertices)
    color[0], density[0] = 1e30, 1e30
    found = Unpacked(Scene.of(mesh, Field(color, density)).pack.text())
    assert np.isfinite(found.halves("color")).all() and found.halves("color").max() > 65000
    assert sorted(found.halves("density")[:, 0])[:-1] == [0.0] * (mesh.num_vertices - 1)


def test_what_a_page_cannot_show():
    mesh = ball(2)
    count, tets = mesh.num_vertices, mesh.tets
    loose = TetMesh(mesh.vertices, tets, conforming=False)
    field = Field(torch.rand(count, 3), torch.rand(count))
    with pytest.raises(MeshError, match="do not meet face to face"):
        dtv.view.show(loose, field)
    with pytest.raises(MeshError, match="4 channels for each vertex"):
        dtv.view.show(mesh, Field(torch.rand(count, 4), torch.rand(count)))
    with pytest.raises(DiffTetError, match=r"field is .*pass a difftetvr\.Field"):
        dtv.view.show(mesh, "density")
    with pytest.raises(DiffTetError, match="height of the frame is 3 pixels"):
        dtv.view.show(mesh, field, height=3)
    with pytest.raises(DiffTetError, match="background of the page is"):
        dtv.view.PageOptions(background=(0.0, 0.0, 2.0))
    with pytest.raises(DiffTetError, match="title of the page is 3"):
        dtv.view.PageOptions(title=3)
    with pytest.raises(CameraError, match="camera of the page is"):
        dtv.view.PageOptions(camera="front.json")


def test_a_page_is_one_file_that_nothing_is_left_of_where_it_fails(tmp_path, monkeypatch):
    mesh = ball(2)
    field = Field(torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices))
    page = dtv.view.save_page(tmp_path / "a.html", mesh, field, dtv.view.PageOptions("<b>&"))
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert text == page.text and "<title>&lt;b&gt;&amp;</title>" in text and page.inverted == 0
    assert not re.search(r"(src|href)=[\"'](?!data:)", text.replace("srcdoc", ""))
    with pytest.raises(MeshError, match="Cannot write"):
        dtv.view.save_page(tmp_path / "none" / "a.html", mesh, field)
    assert [file.name for file in tmp_path.iterdir()] == ["a.html"]


class _Frames(HTMLParser):
    pages: tuple[str, ...] = ()

    def handle_starttag(self, tag, attrs):
        assert tag == "iframe"
        self.pages += (dict(attrs)["srcdoc"],)


def test_notebooks_get_the_page_in_a_frame():
    mesh = ball(2)
    field = Field(torch.rand(mesh.num_vertices, 3), torch.rand(mesh.num_vertices))
    frames = _Frames()
    frames.feed(dtv.view.show(mesh, field, height=300)._repr_html_())
    assert frames.pages == (Document.of(mesh, field).text,)
    assert html.unescape(frames.pages[0]).count("</script>") == 2


def test_a_page_opens_with_a_camera():
    center, extent = torch.tensor([1.0, 2.0, 3.0]).double(), torch.tensor([4.0, 2.0, 1.0]).double()
    camera = Camera.look_at((1.0, -6.0, 4.0), (1.0, 2.0, 3.0), fov_y=0.5, width=90, height=60)
    opening = Opening.of(center, extent, camera)
    again = opening.camera(center, 4.0, 60)
    torch.testing.assert_close(again.world_to_camera, camera.world_to_camera, atol=1e-5, rtol=1e-5)
    assert again.fy == pytest.approx(camera.fy)
    whole = Opening.of(center, extent).camera(center, 4.0, 100)
    corners = center + 0.5 * extent * torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * 3)
    pixels = whole.project(corners)[0]
    assert float(pixels.min()) > 0 and float(pixels.max()) < 100


def test_the_script_is_built_of_the_sources():
    sources = ROOT / "web" / "src"
    if not sources.is_dir():
        pytest.skip("no sources of the script here")
    digest = hashlib.sha256()
    for path in sorted(file.relative_to(sources).as_posix() for file in sources.rglob("*") if file.is_file()):
        digest.update(f"{path}\n".encode() + (sources / path).read_bytes())
    script = (ROOT / "src" / "difftetvr" / "view" / "page" / "page.js").read_text(encoding="utf-8")
    assert f"sources {digest.hexdigest()} */" in script.splitlines()[0], "run `make page`"
    assert "</script" not in script


def test_versions_of_the_tools_are_pinned_and_come_from_nowhere_in_particular():
    folder = ROOT / "web"
    if not folder.is_dir():
        pytest.skip("no sources of the script here")
    wanted = json.loads((folder / "package.json").read_text())["devDependencies"]
    assert set(wanted) == {"@webgpu/types", "esbuild", "typescript"}
    assert all(re.fullmatch(r"[\d.]+", version) for version in wanted.values())
    locked = (folder / "package-lock.json").read_text()
    assert "resolved" not in locked and "http" not in re.sub(r'"funding":.*?}', "", locked, flags=re.DOTALL)


def test_lengths_of_the_sources():
    files = [file for file in (ROOT / "web" / "src").rglob("*") if file.is_file()]
    assert all(len(file.read_text(encoding="utf-8").splitlines()) < 400 for file in files)
