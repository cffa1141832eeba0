"""Where the driver's library is, by the names that the loader knows."""

import os

import pytest

from difftetvr import libcuda


@pytest.fixture(autouse=True)
def _before_drjit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(libcuda.sys.modules, "drjit", raising=False)
    monkeypatch.setattr(libcuda.sys, "platform", "linux")
    monkeypatch.setenv(libcuda.PATH_VARIABLE, "")


@pytest.mark.parametrize(
    ("present", "expected"),
    [
        (set(), None),
        ({"libcuda.so"}, None),
        ({"libcuda.so", "libcuda.so.1"}, None),
        ({"libcuda.so.1"}, "libcuda.so.1"),
    ],
)
def test_the_driver_is_named_where_only_its_own_name_loads(present: set[str], expected: str | None) -> None:
    assert libcuda.tell_drjit(present.__contains__) == expected
    assert os.environ[libcuda.PATH_VARIABLE] == (expected or "")


def test_what_the_user_names_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(libcuda.PATH_VARIABLE, "/opt/libcuda.so.570")
    assert libcuda.tell_drjit({"libcuda.so.1"}.__contains__) is None
    assert os.environ[libcuda.PATH_VARIABLE] == "/opt/libcuda.so.570"


def test_without_a_driver_there_is_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libcuda, "_loads", lambda name: False)
    assert libcuda.count_gpus.__wrapped__() == 0


def test_other_systems_have_other_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libcuda.sys, "platform", "darwin")
    assert libcuda.tell_drjit({"libcuda.so.1"}.__contains__) is None
