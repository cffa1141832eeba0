"""Files appear whole or not at all."""

import errno
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from difftetvr.errors import CaptureError, DiffTetError, MeshError
from difftetvr.files import (
    UnlockedWarning,
    atomic_write,
    locked,
    remove_leftovers,
    require_writable,
    require_writable_folder,
    stem_of,
)

posix = pytest.mark.skipif(os.name != "posix", reason="permissions, limits and the words of errors are those of POSIX")


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_the_file_appears_only_when_the_body_ends(tmp_path):
    target = tmp_path / "model.vtu"
    with atomic_write(target) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".vtu" and temporary != target
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert names(tmp_path) == ["model.vtu"]


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, SystemExit, ValueError, MeshError("bad")])
def test_a_failing_body_leaves_the_old_file_and_nothing_else(tmp_path, interruption):
    target = tmp_path / "model.vtu"
    target.write_text("old")
    kind = interruption if isinstance(interruption, type) else type(interruption)
    with pytest.raises(kind), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise interruption
    assert target.read_text() == "old"
    assert names(tmp_path) == ["model.vtu"]


def test_a_body_may_replace_the_temporary_file_itself(tmp_path):
    target = tmp_path / "picture.png"
    with atomic_write(target, fsync=True) as temporary:
        temporary.unlink()
        temporary.write_bytes(b"new")
    assert target.read_bytes() == b"new"


def test_a_body_that_removes_its_file_is_an_error_and_keeps_the_old_one(tmp_path):
    target = tmp_path / "a.json"
    target.write_text("old")
    with pytest.raises(DiffTetError), atomic_write(target) as temporary:
        temporary.unlink()
    assert target.read_text() == "old"


@posix
def test_permissions_are_those_of_the_replaced_file_or_of_a_new_one(tmp_path):
    previous = os.umask(0o027)
    try:
        target = tmp_path / "metrics.json"
        with atomic_write(target) as temporary:
            temporary.write_text("1")
        assert stat.S_IMODE(target.stat().st_mode) == 0o640
        target.chmod(0o604)
        with atomic_write(target) as temporary:
            temporary.write_text("2")
        assert stat.S_IMODE(target.stat().st_mode) == 0o604
    finally:
        os.umask(previous)


def test_a_symbolic_link_stays_one(tmp_path):
    real, link = tmp_path / "real.json", tmp_path / "link.json"
    real.write_text("old")
    link.symlink_to(real)
    with atomic_write(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink() and real.read_text() == "new"


def fail_in_missing_folder(folder: Path) -> Path:
    return folder / "none" / "a.png"


def fail_on_folder(folder: Path) -> Path:
    return folder


def fail_below_file(folder: Path) -> Path:
    (folder / "file").write_text("")
    return folder / "file" / "a.png"


def fail_on_device(folder: Path) -> Path:
    return Path(os.devnull)


def fail_on_long_name(folder: Path) -> Path:
    return folder / ("x" * 300 + ".png")


@posix
@pytest.mark.parametrize(
    ("bad_target", "reason", "advice"),
    [
        (fail_in_missing_folder, "no such file or directory", "create the folder first"),
        (fail_on_folder, "is a directory", "choose the name of a file"),
        (fail_below_file, "not a directory", "does not run through a file"),
        (fail_on_device, "not a regular file", "choose the name of an ordinary file"),
        (fail_on_long_name, "file name too long", "choose a shorter name"),
    ],
)
def test_impossible_targets_give_one_sentence_of_the_given_kind(tmp_path, bad_target, reason, advice):
    target = bad_target(tmp_path)
    with pytest.raises(CaptureError) as raised, atomic_write(target, CaptureError):
        pytest.fail("the body must not run")
    sentence = str(raised.value)
    assert sentence.startswith(f"Cannot write {target}: {reason}; ")
    assert advice in sentence and sentence.endswith(".") and "\n" not in sentence
    assert os.path.exists(os.devnull) and not os.path.isfile(os.devnull)


@posix
@pytest.mark.parametrize(
    "bad_target", [fail_in_missing_folder, fail_on_folder, fail_below_file, fail_on_device, fail_on_long_name]
)
def test_impossible_targets_are_known_beforehand_by_the_same_sentence(tmp_path, bad_target):
    target = bad_target(tmp_path)
    before = names(tmp_path)
    with pytest.raises(CaptureError) as late, atomic_write(target, CaptureError):
        pytest.fail("the body must not run")
    with pytest.raises(CaptureError) as early:
        require_writable(target, CaptureError)
    assert str(early.value) == str(late.value)
    assert names(tmp_path) == before


def test_the_check_leaves_possible_targets_as_they_are(tmp_path):
    (tmp_path / "old.json").write_text("old")
    require_writable(tmp_path / "old.json")
    require_writable(tmp_path / "new.json")
    require_writable_folder(tmp_path)
    require_writable_folder(tmp_path / "new" / "folder")
    assert names(tmp_path) == ["old.json"]
    assert (tmp_path / "old.json").read_text() == "old"


@posix
def test_folders_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "a" / "b", Path("/proc/a/b")):
        with pytest.raises(MeshError, match=f"Cannot write {folder}: "):
            require_writable_folder(folder, MeshError)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_no_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(DiffTetError, match="choose a folder you may write to"), atomic_write(tmp_path / "a.png"):
        pytest.fail("the body must not run")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
def test_a_full_disk_met_in_the_body(tmp_path):
    sentence = r": no space left on device; free some space or choose another disk\.$"
    with pytest.raises(DiffTetError, match=sentence), atomic_write(tmp_path / "a.vtu"), open("/dev/full", "w") as file:
        file.write("x" * 100_000)
    assert names(tmp_path) == []


def test_a_limit_on_file_sizes_met_in_the_body(tmp_path):
    resource = pytest.importorskip("resource")
    target = tmp_path / "a.vtu"
    target.write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(MeshError, match="file too large"), atomic_write(target, MeshError) as temporary:
            temporary.write_bytes(bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert target.read_text() == "old"
    assert names(tmp_path) == ["a.vtu"]


SAVE_ON_FULL_DISK = """
import sys
from difftetvr.errors import MeshError
from difftetvr.files import atomic_write, require_writable, require_writable_folder
try:
    with atomic_write(sys.argv[1] + "/a.vtu", MeshError) as temporary:
        temporary.write_bytes(bytes(1_000_000))
except MeshError as error:
    print(error)
"""


def test_a_disk_that_is_really_full(tmp_path):
    script = 'mount -t tmpfs -o size=64k none "$1" && "$2" -c "$3" "$1" && ls -A "$1"'
    if not shutil.which("unshare") or subprocess.run(["unshare", "-m", "true"], capture_output=True).returncode:
        pytest.skip("no mount namespaces here")
    command = ["unshare", "-m", "sh", "-c", script, "sh", str(tmp_path), sys.executable, SAVE_ON_FULL_DISK]
    source = str(Path(__file__).parents[1] / "src")
    environment = {**os.environ, "PYTHONPATH": source}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if "mount" in done.stderr:
        pytest.skip("mounting is not allowed here")
    sentence = f"Cannot write {tmp_path}/a.vtu: no space left on device; free some space or choose another disk.\n"
    assert (done.stdout, done.stderr) == (sentence, "")


def test_a_body_that_does_not_know_why_it_failed(tmp_path):
    """numpy's tofile says how much it wrote of how much, but not what stopped it."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with (
            pytest.raises(MeshError, match="file too large; raise the limit"),
            atomic_write(tmp_path / "a.vtk", MeshError),
        ):
            raise OSError("4860 requested and 0 written")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with pytest.raises(MeshError, match="4860 requested and 0 written; check"), atomic_write(tmp_path / "a", MeshError):
        raise OSError("4860 requested and 0 written")
    assert names(tmp_path) == []


def in_another_process(code: str, *args: Path) -> subprocess.Popen:
    source = str(Path(__file__).parents[1] / "src")
    code = "import os, signal, sys\nfrom difftetvr.files import *\nfrom difftetvr.files import locked\n" + code
    command = [sys.executable, "-c", code, *map(str, args)]
    environment = {**os.environ, "PYTHONPATH": source}
    return subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


WRITES = """
with atomic_write(sys.argv[1]) as temporary:
    temporary.write_text("half")
    print("writing", flush=True)
    sys.stdin.readline()
"""
LOCKS = """
with locked(sys.argv[1], Exception, "busy"):
    print("in", flush=True)
    sys.stdin.readline()
"""


@posix
def test_what_killed_processes_left_is_swept_and_nothing_else(tmp_path):
    target = tmp_path / "checkpoint.bin"
    mine = [".checkpoint-notes.bin", ".checkpoint-0123456.bin", ".other-01234567.bin", "checkpoint-01234567.bin"]
    for name in mine:
        (tmp_path / name).write_text("mine")
    (tmp_path / ".checkpoint-00000000.bin").mkdir()
    dead, living = in_another_process(WRITES, target), in_another_process(WRITES, target)
    assert [process.stdout.readline() for process in (dead, living)] == ["writing\n"] * 2
    dead.kill()
    dead.wait()
    before = set(names(tmp_path))
    with atomic_write(target) as own:
        remove_leftovers(tmp_path, stem_of(target))
        assert own.exists()
        left = set(names(tmp_path))
    assert len(before - left) == 1 and left >= {*mine, ".checkpoint-00000000.bin"}
    living.communicate("\n")
    assert living.returncode == 0 and target.read_text() == "half"
    remove_leftovers(tmp_path / "none", ".*")


def test_one_at_a_time(tmp_path):
    target = tmp_path / "checkpoint.bin"
    with locked(target, MeshError, "It is in use."):
        with pytest.raises(MeshError, match="It is in use"), locked(target, MeshError, "It is in use."):
            pytest.fail("the body must not run")
        with locked(tmp_path / "other.bin", MeshError, "It is in use."):
            pass
    with locked(target, MeshError, "It is in use."):
        pass
    assert names(tmp_path) == []


def test_locks_of_dead_processes_are_taken_over_and_those_of_living_ones_are_not(tmp_path):
    target = tmp_path / "checkpoint.bin"
    other = in_another_process(LOCKS, target)
    assert other.stdout.readline() == "in\n"
    with pytest.raises(DiffTetError, match="busy"), locked(target, DiffTetError, "busy"):
        pytest.fail("the body must not run")
    other.kill()
    other.wait()
    assert names(tmp_path) == ["checkpoint.bin.lock"]
    with locked(target, DiffTetError, "busy"):
        pass
    assert names(tmp_path) == []


def test_locks_need_a_folder_and_make_none(tmp_path):
    with pytest.raises(MeshError, match="create the folder first"), locked(tmp_path / "a" / "b", MeshError, "busy"):
        pytest.fail("the body must not run")
    assert names(tmp_path) == []


@pytest.mark.parametrize("error", [OSError(errno.ENOLCK, "No locks available"), NotImplementedError("no flock")])
def test_disks_without_locks_are_used_with_a_warning(tmp_path, monkeypatch, error):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr("filelock.FileLock.acquire", fail)
    with pytest.warns(UnlockedWarning, match="has no locks"), locked(tmp_path / "a", MeshError, "busy"):
        (tmp_path / "a").write_text("written")
    assert (tmp_path / "a").read_text() == "written"
