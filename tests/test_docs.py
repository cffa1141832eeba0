"""The manual: its code and commands work, its names exist, its links lead somewhere, and nothing public is left out."""

import importlib
import inspect
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if not {"_build", "gallery"} & set(page.relative_to(DOCS).parts))
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
TEXTS = {str(document.relative_to(ROOT)): document.read_text(encoding="utf-8") for document in DOCUMENTS}
API = "".join(text for name, text in TEXTS.items() if name.startswith("docs/api"))
PUBLIC = ("", ".mesh", ".mesh.io", ".optics", ".rendering", ".sampling", ".capture", ".fitting", ".inverse", ".view")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}

# What a page takes for granted: here a folder of photographs called garden.
TAKEN_FOR_GRANTED = {
    "docs/captures.md": """
import json, pathlib
import difftetvr as dtv
views = dtv.VolumeCapture(views=9, width=16, height=16).build()
folder = pathlib.Path("garden")
folder.mkdir()
cameras = []
for index, camera in enumerate(views.cameras):
    dtv.view.save_png(folder / f"{index}.png", views.images[index])
    intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    cameras.append({"image": f"{index}.png", "world_to_camera": camera.world_to_camera.tolist(), **intrinsics})
(folder / "cameras.json").write_text(json.dumps({"format": "difftetvr-cameras", "cameras": cameras}))
"""
}


def blocks(language: str, *, without: str | None = None) -> list:
    """Code of all documents, each with the document's name."""
    found = []
    for name, text in TEXTS.items():
        codes = re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL) if name != without else []
        found += [pytest.param(name, code, id=f"{name}-{index}") for index, code in enumerate(codes)]
    return found


@pytest.mark.parametrize(("page", "code"), blocks("python", without="README.md"))  # those are in test_readme.py
def test_code_runs(page, code, tmp_path, monkeypatch):
    """In this process, which has imported PyTorch and compiled kernels; those of the README run in their own."""
    monkeypatch.chdir(tmp_path)
    exec(compile(TAKEN_FOR_GRANTED.get(page, "") + code, page, "exec"), {"__name__": "__main__"})


def shown_commands() -> list:
    """Command lines of the program, in blocks of shell and in prose; such with "..." or without any argument aside."""
    found = []
    for name, text in TEXTS.items():
        scripts = re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        lines = [line for script in scripts for line in script.replace("\\\n", " ").splitlines()]
        lines += [" ".join(code.split()) for code in re.findall(r"(?<!`)`(difftetvr [a-z-]+ [^`]+)`(?!`)", text)]
        for line in lines:
            words = shlex.split(line, comments=True)
            if words[:1] == ["difftetvr"] and "..." not in words:
                found.append(pytest.param(words[1:], id=f"{name}: {' '.join(words[1:])}"))
    return found


@pytest.mark.parametrize("words", shown_commands())
def test_commands_can_be_given_as_shown(words, tmp_path, monkeypatch, capsys):
    from difftetvr.cli import command_type, parse_command

    monkeypatch.chdir(tmp_path)
    if "--config" in words:
        config = Path(words[words.index("--config") + 1])
        config.parent.mkdir(parents=True)
        config.write_text(json.dumps({"capture": "tooth"}))
    try:
        command = parse_command(words)
    except SystemExit:
        pytest.fail(capsys.readouterr().err)
    kind = command_type(words[0])
    assert isinstance(command, kind.variant(words[1:]) if hasattr(kind, "variant") else kind)


def test_every_command_is_in_the_table_of_commands():
    from difftetvr.cli import COMMANDS

    assert set(COMMANDS) == set(re.findall(r"^\| `(\w[\w-]*)[ `]", TEXTS["docs/command-line.md"], re.MULTILINE))


def test_every_name_can_be_reached_from_the_package():
    """In a process of its own: no test must have imported a module that a reader has not."""
    names = {name for text in TEXTS.values() for name in re.findall(r"\b(?:dtv|difftetvr)(?:\.[A-Za-z_]\w*)+", text)}
    assert len(names) > 50
    code = """
import sys, difftetvr as dtv
for name in sys.argv[1:]:
    item = dtv
    for part in name.split(".")[1:]:
        item = getattr(item, part, None)
    if item is None:
        print(name)
"""
    done = subprocess.run([sys.executable, "-c", code, *names], env=ENVIRONMENT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def described() -> list[str]:
    """Full names of what the reference describes."""
    return re.findall(r"^\.\. auto(?:class|function|exception):: ([\w.]+)", API, re.MULTILINE)


def resolve(name: str) -> object:
    item: object = importlib.import_module("difftetvr")
    for part in name.split(".")[1:]:
        item = getattr(item, part)
    return item


@pytest.mark.parametrize("package", PUBLIC)
def test_the_reference_describes_everything_public(package):
    module = importlib.import_module(f"difftetvr{package}")
    public = {name: getattr(module, name) for name in module.__all__}
    items = {name: item for name, item in public.items() if inspect.isclass(item) or inspect.isfunction(item)}
    known = {id(resolve(name)) for name in described()}
    assert items and not [name for name, item in items.items() if id(item) not in known]


def test_the_reference_describes_nothing_twice_and_lists_what_it_describes():
    names = described()
    assert len(names) == len(set(names)) == len({id(resolve(name)) for name in names})
    assert sorted(re.findall(r"^   ~([\w.]+)$", API, re.MULTILINE)) == sorted(names)


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", TEXTS)
def test_links_lead_somewhere(name):
    text, folder = TEXTS[name], (ROOT / name).parent
    targets = re.findall(r"\]\((?!https?:)([^)\s]+)\)|^:target: (\S+)", text, re.MULTILINE)
    for target in (one or other for one, other in targets):
        path, _, anchor = target.partition("#")
        file = folder / path.replace(".html", ".md") if path else ROOT / name
        assert file.exists(), target
        assert not anchor or anchor in anchors(file.read_text(encoding="utf-8")), target
    for picture in re.findall(r"^:+\{figure\} (\S+)", text, re.MULTILINE):
        assert (folder / picture).exists(), picture


def test_every_page_is_in_the_table_of_contents():
    reached, queue = set(), [DOCS / "index.md"]
    while queue:
        page = queue.pop()
        reached.add(page)
        for tree in re.findall(
            r"^```\{toctree\}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
        ):
            entries = [line for line in tree.splitlines() if line and not line.startswith(":")]
            queue += [page.parent / f"{entry}.md" for entry in entries if entry != "gallery/index"]
    assert reached == set(PAGES)


@pytest.mark.slow
def test_the_manual_builds_without_warnings(tmp_path):
    pytest.importorskip("sphinx_gallery", reason="`make docs` installs what the manual is made with")
    options = ["-W", "--keep-going", "-n", "-q", "-b", "html", "-d", str(tmp_path / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *options, str(DOCS), str(tmp_path / "html")]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    pages = {page.relative_to(DOCS).with_suffix(".html") for page in PAGES}
    assert all((tmp_path / "html" / page).exists() for page in pages)
    commands = (tmp_path / "html" / "command-line.html").read_text(encoding="utf-8")
    assert "--iterations" in commands and "--free-space" in commands
