"""Packages whose names load when they are first used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lazy_loader


def attach(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """What a package is to have as ``__getattr__``, ``__dir__`` and ``__all__``, by the stub beside its ``__init__``.

    Modules can be reached as attributes, but ``import *`` binds only what is defined in them: a module ``io`` or
    ``field`` would hide names of the one who imports.

    Args:
        package: Name of the package.
        file: Its ``__init__.py``.
    """
    get, names_of, names = lazy_loader.attach_stub(package, file)
    folder = Path(file).parent
    modules = {name for name in names if (folder / name).is_dir() or (folder / f"{name}.py").is_file()}
    return get, names_of, [name for name in names if name not in modules]
