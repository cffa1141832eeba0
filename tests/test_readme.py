"""What the README shows works as shown."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("code", blocks("python"))
def test_python_examples_run(code, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    check = "\nassert color.grad.abs().sum() > 0 and density.grad.abs().sum() > 0\n" if "backward" in code else ""
    command = [sys.executable, "-W", "error::DeprecationWarning:__main__", "-c", code + check]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not re.search(r'save\("(.+?)"', code) or any(tmp_path.iterdir())


def test_there_is_a_python_example():
    assert blocks("python")


def test_make_targets_exist():
    targets = set(re.findall(r"^make (\w+)", "".join(blocks("sh")), re.MULTILINE))
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert {"demo", "test"} <= targets <= set(re.findall(r"^(\w+):", makefile, re.MULTILINE))


def test_continuous_integration_runs_the_readmes_test_command():
    assert re.search(r"^exec make test$", (ROOT / ".ci" / "run").read_text(encoding="utf-8"), re.MULTILINE)


def test_commands_exist():
    shown = set(re.findall(r"^difftetvr (\w+)", "".join(blocks("sh")), re.MULTILINE))
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "COLUMNS": "200"}
    command = [sys.executable, "-c", "import sys; from difftetvr.cli import main; sys.exit(main(['--help']))"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert shown and all(re.search(rf"\b{name}\b", done.stdout) for name in shown)


def test_extras_exist():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    extras = re.search(r"extras: (.*)", README)[1]
    for name in re.findall(r"(\w+) \(", extras):
        assert re.search(rf"^{name} = \[", project, re.MULTILINE), name


def test_no_placeholder_is_left_in_the_documents():
    documents = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]
    assert not [document for document in documents if "@@" in document.read_text(encoding="utf-8")]


def test_pictures_of_the_manual_exist():
    for document in (ROOT / "docs").glob("*.md"):
        pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", document.read_text(encoding="utf-8"))
        assert not [picture for picture in pictures if not (document.parent / picture).exists()], document
