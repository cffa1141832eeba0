"""What a release depends on outside the package: workflows, pins, citation, changelog, recipe must say the same."""

import importlib.util
import re
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
STEPS = [*WORKFLOWS, *(ROOT / ".github" / "actions").glob("*/action.yml")]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
CONDA_NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}


def read_yaml(path: Path | str) -> Any:
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def jobs() -> dict[str, dict[str, Any]]:
    return {f"{path.stem}/{name}": job for path in WORKFLOWS for name, job in read_yaml(path)["jobs"].items()}


def project_list(name: str) -> list[str]:
    return re.findall(r'"([^"]+)"', re.search(rf"^{name} = \[(.*?)\]$", PROJECT, re.MULTILINE | re.DOTALL)[1])


def pins() -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    lines = (ROOT / "requirements" / "lock.txt").read_text(encoding="utf-8").splitlines()
    for name, version in (re.match(r"([a-z0-9-]+)==([\w.]+)", line).groups() for line in lines if "==" in line):
        found.setdefault(name, set()).add(version)
    return found


def supported_pythons() -> list[str]:
    return re.findall(r'"Programming Language :: Python :: (3\.\d+)"', PROJECT)


def version() -> str:
    text = (ROOT / "src" / "difftetvr" / "_version.py").read_text(encoding="utf-8")
    return re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE)[1]


@pytest.fixture(scope="module")
def release_notes() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release_notes", ROOT / "scripts" / "release_notes.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# ---- workflows


def test_the_workflows_are_there():
    assert {path.stem for path in WORKFLOWS} == {"tests", "packages", "docs", "nightly", "release"}


def test_actions_are_pinned_by_commit_and_say_which_version_that_is():
    pinned = r"uses: [\w.-]+/[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+"
    local = r"uses: \./\.github/(actions/\w+|workflows/\w+\.yml)"
    lines = [line.strip().removeprefix("- ") for path in STEPS for line in path.read_text("utf-8").splitlines()]
    uses = [line for line in lines if re.match(r"['\"]?uses\b", line)]
    assert len(uses) > 20
    assert not [line for line in uses if not re.fullmatch(rf"{pinned}|{local}", line)]
    assert all((ROOT / line.removeprefix("uses: ./")).exists() for line in uses if re.fullmatch(local, line))
    by_action: dict[str, set[str]] = {}
    for line in uses:
        by_action.setdefault(line.partition("@")[0], set()).add(line)
    assert not {action: found for action, found in by_action.items() if len(found) > 1}


def test_jobs_have_the_least_permissions_and_end():
    for path in WORKFLOWS:
        workflow = read_yaml(path)
        assert workflow["permissions"] == {}, path
        assert workflow["concurrency"]["group"].startswith(f"{path.stem}-"), f"{path} shares a group with its caller"
    writes = {
        name: {key for key, value in job["permissions"].items() if value == "write"} for name, job in jobs().items()
    }
    assert {name: keys for name, keys in writes.items() if keys} == {
        "docs/deploy": {"pages", "id-token"},
        "nightly/report": {"issues"},
        "release/pypi": {"id-token"},
        "release/github": {"contents", "id-token", "attestations"},
    }
    assert not [name for name, job in jobs().items() if "uses" not in job and "timeout-minutes" not in job]


def test_checkouts_keep_no_credentials():
    steps = [step for job in jobs().values() for step in job.get("steps", [])]
    checkouts = [step for step in steps if step.get("uses", "").startswith("actions/checkout@")]
    assert len(checkouts) > 5 and all(step["with"]["persist-credentials"] is False for step in checkouts)


def test_what_is_tested_is_what_is_said_to_be_supported():
    matrices = {
        name: job["strategy"]["matrix"] for name, job in jobs().items() if name in ("tests/test", "tests/windows")
    }
    assert len(matrices) == 2 and {tuple(matrix["python"]) for matrix in matrices.values()} == {
        tuple(supported_pythons())
    }
    assert re.search(r'^requires-python = ">=(.+)"$', PROJECT, re.MULTILINE)[1] == supported_pythons()[0]


def test_make_targets_of_the_workflows_exist():
    commands = [step["run"] for job in jobs().values() for step in job.get("steps", []) if "run" in step]
    used = {name for command in commands for name in re.findall(r"^\s*make ([\w-]+)", command, re.MULTILINE)}
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {"lint", "test", "test-all", "docs"} <= used <= set(targets)


def test_nothing_is_published_that_was_not_checked():
    release = read_yaml(ROOT / ".github" / "workflows" / "release.yml")
    assert release[True] == {"push": {"tags": ["v*"]}}  # YAML 1.1 reads `on` as true
    needs = {
        name: [job["needs"]] if isinstance(job.get("needs"), str) else job.get("needs", [])
        for name, job in release["jobs"].items()
    }
    assert needs == {
        "check": [],
        "tests": ["check"],
        "packages": ["check"],
        "pypi": ["tests", "packages"],
        "github": ["pypi"],
    }
    assert release["jobs"]["pypi"]["environment"]["name"] == "pypi"
    assert not any("if" in job for job in release["jobs"].values())


# ---- versions


def test_hooks_run_what_make_lint_runs():
    hooks = {hook["id"]: hook for repo in read_yaml(".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]}
    for name in ("ruff-check", "ruff-format"):
        assert [{pin.partition("==")[2]} for pin in hooks[name]["additional_dependencies"]] == [pins()["ruff"]]
    commands = [" ".join(hooks[name]["entry"].split()) for name in ("ruff-check", "ruff-format", "mypy")]
    recipe = re.search(r"^lint:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)[1]
    assert [f".venv/bin/{commands[0]}", f".venv/bin/{commands[1]}", commands[2]] == [
        line.strip().replace("$(BIN)", ".venv/bin").replace("format --check", "format") for line in recipe.splitlines()
    ]


def test_the_citation_names_this_version_and_the_article():
    citation = read_yaml("CITATION.cff")
    assert str(citation["version"]) == version()
    assert citation["license"] == re.search(r'^license = "(.+)"$', PROJECT, re.MULTILINE)[1]
    article = citation["references"][0]
    assert article["authors"] == [{"family-names": "Neuhauser", "given-names": "Christoph"}]
    readme = re.sub(r"[{}]", "", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert article["title"] in readme and article["url"] in readme


def test_the_recipe_asks_for_what_the_project_asks_for():
    recipe = read_yaml("packaging/conda-forge/recipe.yaml")
    assert recipe["context"] == {"version": version(), "python_min": supported_pythons()[0]}
    wanted = {}
    for requirement in project_list("dependencies"):
        name, versions = re.match(r"([\w-]+)(.*)", requirement).groups()
        wanted[CONDA_NAMES.get(name, name)] = versions
    run = dict(line.split(" ", 1) for line in recipe["requirements"]["run"])
    assert run.pop("python") == ">=${{ python_min }}"
    assert run == wanted
    assert f"hatchling {project_list('requires')[0].removeprefix('hatchling')}" in recipe["requirements"]["host"]
    script = re.search(r'^difftetvr = "(.+)"$', PROJECT, re.MULTILINE)[1]
    assert recipe["build"]["python"]["entry_points"] == [f"difftetvr = {script}"]
    files = [*recipe["about"]["license_file"], *recipe["tests"][1]["files"]["source"]]
    assert all((ROOT / file).is_file() for file in files)


# ---- changelog


def test_the_changelog_keeps_its_form():
    titles = re.findall(r"^## (.+)$", CHANGELOG, re.MULTILINE)
    assert CHANGELOG.startswith("# Changelog\n") and titles[0] == "[Unreleased]"
    releases = [re.fullmatch(r"\[(\d+)\.(\d+)\.(\d+)\] - \d{4}-\d\d-\d\d", title) for title in titles[1:]]
    assert all(releases), titles
    numbers = [tuple(map(int, release.groups())) for release in releases]
    assert numbers == sorted(set(numbers), reverse=True)
    kinds = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    for section in re.split(r"^## .+\n", CHANGELOG, flags=re.MULTILINE)[1:]:
        found = re.findall(r"^### (.+)$", section, re.MULTILINE)
        assert set(found) <= kinds and len(found) == len(set(found))
        assert all(
            re.search(r"^- ", part, re.MULTILINE) for part in re.split(r"^### .+\n", section, flags=re.MULTILINE)[1:]
        )


@pytest.fixture
def ready(tmp_path) -> Path:
    """The project as it is when 1.2.3 is to be released."""
    for file in ("src/difftetvr/_version.py", "CITATION.cff", "packaging/conda-forge/recipe.yaml"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
        replace(tmp_path / file, version(), "1.2.3")
    replace(tmp_path / "CITATION.cff", "version: 1.2.3\n", "version: 1.2.3\ndate-released: 2027-01-02\n")
    changelog = (
        "# Changelog\n\n## [Unreleased]\n\n## [1.2.3] - 2027-01-02\n\n### Fixed\n\n- Fog.\n\n## [1.2.2] - 2026-01-02\n"
    )
    (tmp_path / "CHANGELOG.md").write_text(changelog, encoding="utf-8")
    return tmp_path


def replace(file: Path, old: str, new: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")


def test_the_notes_of_a_release_are_its_section_of_the_changelog(release_notes, ready):
    assert release_notes.release_notes("v1.2.3", ready) == "### Fixed\n\n- Fog.\n"


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        ("src/difftetvr/_version.py", "1.2.3", "1.2.2", r"_version\.py says 1\.2\.2"),
        ("CITATION.cff", "version: 1.2.3", "version: 1.2.2", r"CITATION\.cff says 1\.2\.2"),
        ("packaging/conda-forge/recipe.yaml", "1.2.3", "1.2.2", r"recipe\.yaml says 1\.2\.2"),
        ("CHANGELOG.md", "[1.2.3] - 2027-01-02", "[1.2.4] - 2027-01-02", r"no section '## \[1\.2\.3\] - "),
        ("CHANGELOG.md", "## [1.2.3] - 2027-01-02", "## [1.2.3]", "no section"),
        ("CHANGELOG.md", "### Fixed\n\n- Fog.\n", "", "says nothing of 1"),
        ("CITATION.cff", "2027-01-02", "2027-01-03", r"on 2027-01-02, CITATION\.cff says 2027-01-03"),
    ],
)
def test_a_tag_that_the_project_does_not_agree_with_is_refused(release_notes, ready, file, old, new, sentence):
    replace(ready / file, old, new)
    with pytest.raises(ValueError, match=sentence):
        release_notes.release_notes("v1.2.3", ready)


@pytest.mark.parametrize("tag", ["1.2.3", "v1.2.4", "v1.2", "v1.2.3rc1"])
def test_other_tags_are_refused(release_notes, ready, tag):
    with pytest.raises(ValueError, match="tag"):
        release_notes.release_notes(tag, ready)
