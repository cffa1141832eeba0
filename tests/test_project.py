"""The house's rules: which part may import which, how long a file may be, what the package says of itself."""

import ast
import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "difftetvr"
SOURCES = sorted(PACKAGE.rglob("*.py"))

GROUND = {
    *("_lazy", "_version", "archive", "declared", "errors", "files", "inputs", "interrupts", "libcuda", "libllvm"),
    "memory",
    "srgb",
    "trust",
    "vtk_xml",
}
"""Modules that import nothing of this package but each other."""

ALLOWED = {
    "backend": GROUND,
    "recording": GROUND | {"backend"},
    "terminal": GROUND,
    "mesh": GROUND | {"backend", "recording"},
    "optics": GROUND | {"backend"},
    "rendering": GROUND | {"backend", "recording", "mesh", "optics"},
    "sampling": GROUND | {"backend", "mesh", "rendering"},
    "capture": GROUND | {"backend", "mesh", "optics", "rendering"},
    "fitting": GROUND | {"backend", "recording", "terminal", "mesh", "optics", "rendering", "capture"},
    "inverse": GROUND
    | {"backend", "recording", "terminal", "mesh", "optics", "rendering", "sampling", "capture", "fitting"},
    "view": GROUND | {"backend", "mesh", "optics", "rendering", "sampling", "capture", "fitting", "inverse"},
}
"""Parts, each with the parts it may import besides itself. `cli` and the package's surface may import all.

`view` and `fitting` are one storey; of the two, the one that shows results may know what a result is, never the other.
"""

MAY_TOUCH_DRJIT = {"backend", "recording", "mesh", "optics", "rendering", "sampling", "capture", "fitting", "inverse"}
"""Parts that hold kernels, or torch functions around them."""


def part_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module_of(file: Path) -> list[str]:
    parts = ["difftetvr", *file.relative_to(PACKAGE).with_suffix("").parts]
    return parts[:-1] if parts[-1] == "__init__" else parts


def imported_modules(file: Path, module: list[str], top_level_only: bool = False) -> set[str]:
    """Full names of everything a file imports: relative imports included, and lazy ones unless told otherwise."""
    package = module if file.name == "__init__.py" else module[:-1]
    names = set()
    tree = ast.parse(file.read_text(encoding="utf-8"))
    inside = {n for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for n in ast.walk(f)}
    for node in ast.walk(tree):
        if top_level_only and node in inside:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def imported_parts(file: Path) -> set[str]:
    own = [name.split(".") for name in imported_modules(file, module_of(file)) if name.split(".")[0] == "difftetvr"]
    return {name[1] if len(name) > 1 else "__init__" for name in own}


def test_imports_run_downwards_only():
    wrong = []
    for file in SOURCES:
        part = part_of(file)
        if part in ("__init__", "__main__", "cli"):
            continue
        allowed = GROUND if part in GROUND else ALLOWED.get(part)
        assert allowed is not None, f"{file}: say in this test what the new part '{part}' may import"
        wrong += [f"{file.relative_to(ROOT)} imports {name}" for name in imported_parts(file) - allowed - {part}]
    assert not wrong, "\n".join(wrong)


def test_the_layering_test_sees_every_kind_of_import(tmp_path):
    file = tmp_path / "module.py"
    file.write_text(
        "import difftetvr.fitting.losses as x\nfrom difftetvr import rendering\nfrom ..mesh import TetMesh\n"
        "def f():\n    from difftetvr.capture.orbit import g\n    from . import kernels\n"
    )
    assert imported_modules(file, ["difftetvr", "optics", "module"]) == {
        "difftetvr.fitting.losses",
        "difftetvr.rendering",
        "difftetvr.mesh.TetMesh",
        "difftetvr.capture.orbit.g",
        "difftetvr.optics.kernels",
    }


def names_by_module() -> dict[str, set[str]]:
    """Modules of the package, each with those it imports while it is itself imported, or for its types."""
    files = {".".join(module_of(file)): file for file in SOURCES}
    home = {}  # of names that a package hands on lazily, as its stub says
    for stub in PACKAGE.rglob("__init__.pyi"):
        package = module_of(stub.with_suffix(".py"))
        for name in imported_modules(stub, [*package, "__init__"]):
            home[".".join([*package, name.rpartition(".")[2]])] = name
    return {
        name: {
            module
            for imported in imported_modules(file, module_of(file), top_level_only=True)
            for module in (imported, home.get(imported, imported).rpartition(".")[0])
            if module in files and module != name
        }
        for name, file in files.items()
    }


def test_no_modules_import_each_other_in_a_circle():
    left = names_by_module()
    while free := {name for name, imported in left.items() if not imported & left.keys()}:
        left = {name: imported for name, imported in left.items() if name not in free}
    assert not left, f"a circle runs through some of {sorted(left)}"


def test_rooms_are_small_and_say_what_they_answer():
    for room in {file.parent for file in SOURCES} - {PACKAGE}:
        files = list(room.glob("*.py"))
        assert (room / "__init__.py") in files, f"{room} has no __init__.py"
        assert len(files) <= 13, f"{room} holds {len(files) - 1} files besides its __init__; make an inner room"
        assert ast.get_docstring(ast.parse((room / "__init__.py").read_text())), f"{room} does not say what it answers"


def test_the_table_of_changes_names_files_that_are_there():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [\w ]+ \| (`.+) \| (.+) \|$", text, re.MULTILINE)
    assert len(rows) >= 6
    for place, other in rows:
        assert re.search(r"`\w+/", place)
        for folder, name in re.findall(r"`((?:\w+/)+)([\w.]+\.pyi?)`", place + other):
            file = PACKAGE / folder / name
            assert file.exists() or (file.name.startswith("...") and file.parent.is_dir()), file


def test_only_kernels_and_their_wrappers_touch_drjit():
    users = {
        part_of(file)
        for file in SOURCES
        if any(name.split(".")[0] == "drjit" for name in imported_modules(file, module_of(file)))
    }
    assert users <= MAY_TOUCH_DRJIT


def test_no_test_module_is_imported():
    """What several need stands beside them: as part of another module, tests would run where they are not meant to."""
    for file in (ROOT / "tests").rglob("*.py"):
        found = imported_modules(file, ["tests", file.stem])
        parts = {part for name in found for part in name.split(".")}
        modules = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
        assert not parts & modules, f"{file} imports {sorted(parts & modules)}"


def test_files_stay_short():
    scripts = [*(ROOT / "scripts").iterdir(), *(ROOT / "examples").glob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    tools = [file for kind in ("py", "c", "cpp", "h") for file in (ROOT / "tools").rglob(f"*.{kind}")]
    files = [*SOURCES, *(ROOT / "tests").rglob("*.py"), *tools, *(file for file in scripts if file.is_file())]
    lengths = {file.relative_to(ROOT): len(file.read_text(encoding="utf-8").splitlines()) for file in files}
    assert not {file: length for file, length in lengths.items() if length >= 400}


def written_version() -> str:
    return re.search(r'^__version__ = "(.+)"$', (PACKAGE / "_version.py").read_text(encoding="utf-8"), re.MULTILINE)[1]


def test_versions_agree():
    import difftetvr

    version = written_version()
    assert difftetvr.__version__ == version
    try:
        assert metadata.version("difftetvr") == version
    except metadata.PackageNotFoundError:
        pytest.skip("difftetvr is not installed")


def test_every_dependency_is_pinned():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    lists = re.findall(r"^(?:dependencies|dev|docs|requires) = \[(.*?)\]$", project, re.MULTILINE | re.DOTALL)
    asked = {name.lower() for entries in lists for name in re.findall(r'"([A-Za-z0-9_-]+)[<>=]', entries)}
    pins = (ROOT / "requirements" / "lock.txt").read_text(encoding="utf-8").splitlines()
    lines = [line for line in pins if line and not line.startswith("#")]
    assert all(re.fullmatch(r'[a-z0-9-]+==[\w.]+(; python_version (>=|<) "3\.11")?', line) for line in lines)
    assert len(asked) > 10 and asked <= {line.split("==")[0] for line in lines}
    assert "torch==2.13.0" in lines


def test_the_package_says_that_it_is_typed_and_carries_its_data():
    assert (PACKAGE / "py.typed").is_file()
    assert {file.name for file in (PACKAGE / "data").iterdir()} >= {"CREDITS.md", "tooth3gauss.json"}


def test_importing_the_package_asks_for_no_optional_package():
    optional = ("viser", "tensorboard", "lpips", "pytetwild", "tetgen", "vtk", "matplotlib", "pytest")
    code = f"import sys, difftetvr; print([name for name in {optional} if name in sys.modules])"
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_fit_does_not_import_the_compiler():
    code = """
import sys, difftetvr as dtv
capture = dtv.load_capture("tooth", views=4, width=32, height=32, steps_per_unit=100.0)
dtv.fit(capture, dtv.FitConfig(cells=500, iterations=3))
print("torch._dynamo" in sys.modules)
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.strip().endswith("False"), done.stdout + done.stderr


def test_functions_hide_no_packages():
    import pydoc

    import difftetvr as dtv
    import difftetvr.fitting.loop as loop

    assert dtv.fit is loop.fit and dtv.rendering.render is dtv.render and callable(dtv.render)
    assert dtv.fitting.VertexOptimizer is dtv.fitting.positions.VertexOptimizer
    assert "Exchange" in dir(dtv.fitting.refinement)
    assert "refined" in pydoc.render_doc(dtv.fitting.refinement)


@pytest.mark.parametrize("order", ["0", "2", "4"])
def test_everything_can_be_imported_at_once(order):
    """Other packages ask for it in their tests, by a variable of the environment that all lazy packages heed.

    Which module comes first is then up to the hashes of their names.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "EAGER_IMPORT": "1", "PYTHONHASHSEED": order}
    code = "import difftetvr, sys; print('difftetvr.fitting.trainer' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "True", done.stderr


def test_importing_all_names_binds_no_modules():
    import difftetvr.mesh

    assert "TetMesh" in difftetvr.mesh.__all__ and not {"io", "field", "motion"} & set(difftetvr.mesh.__all__)
    assert difftetvr.mesh.io and "io" in dir(difftetvr.mesh)
