"""scripts/setup.sh with stand-ins for Python and every package manager: what it calls, says and leaves."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(os.name != "posix", reason="setup.sh and its stand-ins need a POSIX shell")

ROOT = Path(__file__).parents[1]
TOOLS = [
    "awk",
    "cat",
    "chmod",
    "cksum",
    "cp",
    "dirname",
    "env",
    "grep",
    "mkdir",
    "mv",
    "rm",
    "sed",
    "sh",
    "sort",
    "tail",
    "touch",
    "true",
]

# Stands for a Python: its version and modules come from the environment, and a venv is a copy of itself.
PYTHON = r"""#!/bin/sh
echo "python $*" >>"$CALLS"
case "$*" in
*version_info\ \<*) [ "${FAKE_VERSION:-3.11}" != 3.9 ] ;;
*"import venv, ensurepip"*) [ -e "$FAKE/venv" ] ;;
*print*version_info*) echo 3.11 ;;
--version) echo "Python 3.11.2" ;;
"-m venv --clear .venv")
    rm -rf .venv
    mkdir -p .venv/bin
    cp "$0" .venv/bin/python
    echo "VIRTUAL_ENV=$(pwd -P)/.venv" >.venv/bin/activate
    ;;
"-m pip --version") ;;
"-m pip install"*) [ ! -e "$FAKE/no-network" ] || exit 1; [ ! -e "$FAKE/killed" ] || kill -9 $PPID ;;
*probe_llvm.py) [ ! -e "$FAKE/no-drjit" ] || exit 1; [ -e "$FAKE/llvm" ] || exit 3 ;;
*) exit 99 ;;
esac
"""

# Stands for a package manager that can install what was asked for.
INSTALLER = """#!/bin/sh
echo "{name} $*" >>"$CALLS"
[ ! -e "$FAKE/{name}-fails" ] || exit 1
case "$*" in
*llvm*) touch "$FAKE/llvm" ;;
*venv*) touch "$FAKE/venv" ;;
update) touch "$FAKE/updated" ;;
esac
"""

APT_CACHE = """#!/bin/sh
[ -e "$FAKE/updated" ] || exit 0
printf '%s\\n' 'libllvm14 - a' 'libllvm9 - b' 'libllvm17t64 - c' 'libllvm16 - d'
"""

SUDO = """#!/bin/sh
[ ! -e "$FAKE/sudo-asks" ] || exit 1
shift
echo "sudo $*" >>"$CALLS"
exec "$@"
"""


class Machine:
    """A clone of the project, in a folder with spaces, on a machine that has only the given commands."""

    def __init__(self, folder: Path):
        self.clone = folder / "my clone's folder"
        self.commands = folder / "bin"
        self.state = folder / "state"
        self.log = folder / "calls"
        for path in ("scripts", "requirements", "pyproject.toml"):
            destination = self.clone / path
            destination.parent.mkdir(parents=True, exist_ok=True)
            copy = shutil.copytree if (ROOT / path).is_dir() else shutil.copy
            copy(ROOT / path, destination)
        self.commands.mkdir()
        self.state.mkdir()
        for tool in TOOLS:
            (self.commands / tool).symlink_to(shutil.which(tool))
        self.command("id", "#!/bin/sh\necho ${FAKE_UID:-0}\n")
        self.command("uname", "#!/bin/sh\necho ${FAKE_SYSTEM:-Linux}\n")
        self.command("python3.11", PYTHON)
        self.has("venv")

    def command(self, name: str, script: str) -> None:
        (self.commands / name).write_text(script)
        (self.commands / name).chmod(0o755)

    def installers(self, *names: str) -> None:
        for name in names:
            self.command(name, INSTALLER.format(name=name))
        if "apt-get" in names:
            self.command("apt-cache", APT_CACHE)

    def has(self, *states: str) -> None:
        for state in states:
            (self.state / state).touch()

    def lacks(self, *states: str) -> None:
        for state in states:
            (self.state / state).unlink()

    def setup(self, *what: str, **environment: str) -> subprocess.CompletedProcess:
        self.log.write_text("")
        environment = {
            "PATH": str(self.commands),
            "CALLS": str(self.log),
            "FAKE": str(self.state),
            "HOME": "",
        } | environment
        script = self.clone / "scripts" / "setup.sh"
        return subprocess.run(["/bin/sh", script, *what], env=environment, capture_output=True, text=True, cwd="/")

    @property
    def calls(self) -> list[str]:
        return self.log.read_text().splitlines()

    def calls_of(self, name: str) -> list[str]:
        return [call for call in self.calls if call.startswith(f"{name} ")]

    @property
    def is_set_up(self) -> bool:
        return (self.clone / ".venv" / "setup-complete").exists()


@pytest.fixture
def machine(tmp_path):
    return Machine(tmp_path)


def test_with_libllvm_nothing_is_asked_of_the_system(machine):
    machine.has("llvm")
    machine.installers("apt-get", "dnf", "brew", "conda")
    done = machine.setup()
    assert done.returncode == 0 and machine.is_set_up, done.stderr
    assert done.stdout.endswith("setup: ready\n")
    assert not any(machine.calls_of(name) for name in ("apt-get", "dnf", "brew", "conda"))
    installs = [call for call in machine.calls if "pip install" in call]
    assert len(installs) == 2 and all("-c requirements/lock.txt" in call for call in installs)


def test_a_second_run_does_nothing(machine):
    machine.has("llvm")
    machine.setup()
    machine.has("no-network")
    again = machine.setup()
    assert (again.returncode, again.stdout, again.stderr, machine.calls) == (0, "", "", [])


def test_the_manual_is_set_up_only_where_it_is_asked_for(machine):
    machine.has("llvm")
    assert machine.setup().returncode == 0
    assert not any("[docs]" in call for call in machine.calls)
    assert machine.setup("docs").returncode == 0
    installs = [call for call in machine.calls if "pip install" in call]
    assert any(".[docs]" in call for call in installs) and not any(".[dev]" in call for call in installs)
    machine.has("no-network")
    again = machine.setup("docs")
    assert (again.returncode, again.stdout, again.stderr, machine.calls) == (0, "", "", [])


def test_from_scratch_the_manual_is_set_up_after_all_else(machine):
    machine.has("llvm")
    assert machine.setup("docs").returncode == 0 and machine.is_set_up
    extras = [call[-6:] for call in machine.calls if "-e ." in call]
    assert extras == [".[dev]", "[docs]"]
    with (machine.clone / "pyproject.toml").open("a") as file:
        file.write("# changed\n")
    assert machine.setup().returncode == 0
    assert machine.setup("docs").returncode == 0 and any("[docs]" in call for call in machine.calls)


def test_only_what_there_is_can_be_set_up(machine):
    done = machine.setup("dcos")
    assert done.returncode != 0 and "there is no 'dcos'" in done.stderr and not machine.calls


@pytest.mark.parametrize("changed", ["pyproject.toml", "requirements/lock.txt"])
def test_changed_requirements_are_installed_into_the_same_environment(machine, changed):
    machine.has("llvm")
    machine.setup()
    with (machine.clone / changed).open("a") as file:
        file.write("# changed\n")
    assert machine.setup().returncode == 0
    assert not any("-m venv" in call for call in machine.calls)
    assert any("pip install" in call for call in machine.calls)


def test_a_moved_clone_is_set_up_anew(machine):
    machine.has("llvm")
    machine.setup()
    machine.clone = machine.clone.rename(machine.clone.with_name("moved"))
    assert machine.setup().returncode == 0
    assert any("-m venv --clear" in call for call in machine.calls)


def test_a_set_up_that_was_killed_starts_over(machine):
    machine.has("llvm", "killed")
    assert machine.setup().returncode < 0
    assert not machine.is_set_up
    machine.lacks("killed")
    assert machine.setup().returncode == 0 and machine.is_set_up
    assert any("-m venv --clear" in call for call in machine.calls)


def test_no_network_is_said_in_one_sentence(machine):
    machine.has("llvm", "no-network")
    done = machine.setup()
    assert done.returncode != 0 and not machine.is_set_up
    assert done.stderr.count("\n") == 1 and "pip could not install the packages" in done.stderr


def test_a_broken_drjit_is_not_taken_for_a_missing_libllvm(machine):
    machine.has("no-drjit")
    machine.installers("apt-get")
    done = machine.setup()
    assert done.returncode != 0 and "Dr.Jit cannot be imported" in done.stderr
    assert not machine.calls_of("apt-get")


def test_apt_takes_the_newest_libllvm_after_an_update_where_the_lists_are_empty(machine):
    machine.installers("apt-get", "brew")
    done = machine.setup()
    assert done.returncode == 0 and machine.is_set_up, done.stderr
    assert machine.calls_of("apt-get") == [
        "apt-get update",
        "apt-get install -y --no-install-recommends libllvm17t64",
    ]
    assert not machine.calls_of("brew") and not machine.calls_of("sudo")


def test_apt_through_sudo_where_it_asks_for_no_password(machine):
    machine.installers("apt-get")
    machine.command("sudo", SUDO)
    machine.has("updated")
    assert machine.setup(FAKE_UID="1000").returncode == 0
    assert machine.calls_of("apt-get") == ["apt-get install -y --no-install-recommends libllvm17t64"]
    assert any("apt-get install" in call for call in machine.calls_of("sudo"))


@pytest.mark.parametrize("sudo", [False, True])
def test_without_root_the_command_to_run_is_said(machine, sudo):
    machine.installers("apt-get")
    machine.has("updated", "sudo-asks")
    if sudo:
        machine.command("sudo", SUDO)
    done = machine.setup(FAKE_UID="1000")
    assert done.returncode != 0 and not machine.is_set_up
    assert not machine.calls_of("apt-get")
    assert (
        done.stderr.count("\n") == 1 and "run 'sudo apt-get install libllvm17t64', then run make again." in done.stderr
    )


def test_after_the_advice_was_followed_only_the_rest_is_done(machine):
    machine.installers("apt-get")
    machine.setup(FAKE_UID="1000")
    machine.has("llvm")
    assert machine.setup(FAKE_UID="1000").returncode == 0 and machine.is_set_up
    assert not any("-m venv" in call for call in machine.calls)


@pytest.mark.parametrize(
    ("installer", "environment", "call"),
    [
        ("dnf", {}, "dnf install -y llvm-libs"),
        ("brew", {"FAKE_UID": "501", "FAKE_SYSTEM": "Darwin"}, "brew install llvm"),
        (
            "conda",
            {"FAKE_UID": "1000"},
            "conda create -y -q -p .venv/llvm --override-channels -c conda-forge libllvm19",
        ),
        ("micromamba", {"FAKE_UID": "1000"}, "micromamba create -y -q -p .venv/llvm"),
    ],
)
def test_other_package_managers(machine, installer, environment, call):
    machine.installers(installer)
    done = machine.setup(**environment)
    assert done.returncode == 0 and machine.is_set_up, done.stderr
    assert len(machine.calls_of(installer)) == 1 and machine.calls_of(installer)[0].startswith(call)


def test_when_one_fails_the_next_is_tried(machine):
    machine.installers("apt-get", "brew", "conda")
    machine.has("apt-get-fails", "brew-fails")
    assert machine.setup().returncode == 0
    assert machine.calls_of("apt-get") and machine.calls_of("brew") and machine.calls_of("conda")


@pytest.mark.parametrize(("system", "advice"), [("Linux", "DRJIT_LIBLLVM_PATH"), ("Darwin", "run 'brew install llvm'")])
def test_with_no_package_manager_at_all(machine, system, advice):
    done = machine.setup(FAKE_SYSTEM=system)
    assert done.returncode != 0 and not machine.is_set_up
    assert done.stderr.count("\n") == 1 and advice in done.stderr


def test_debian_without_the_module_venv(machine):
    machine.lacks("venv")
    machine.has("llvm")
    machine.installers("apt-get")
    refused = machine.setup(FAKE_UID="1000")
    assert refused.returncode != 0 and not machine.calls_of("apt-get")
    assert refused.stderr.count("\n") == 1 and "run 'sudo apt-get install python3.11-venv'" in refused.stderr
    assert machine.setup().returncode == 0
    assert machine.calls_of("apt-get") == ["apt-get install -y --no-install-recommends python3.11-venv"]


def test_no_python(machine):
    (machine.commands / "python3.11").unlink()
    done = machine.setup()
    assert done.returncode != 0 and "found no Python 3.10 or newer" in done.stderr
    machine.command("python3", PYTHON)
    assert "found no Python 3.10" in machine.setup(FAKE_VERSION="3.9").stderr
    assert "PYTHON=nope is no Python" in machine.setup(PYTHON="nope").stderr


def test_the_shell_finds_no_mistake():
    assert subprocess.run(["sh", "-n", ROOT / "scripts" / "setup.sh"]).returncode == 0
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
