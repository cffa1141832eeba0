"""What is done to intact files: to their bytes and numbers, to what formats are made of, and to the files as such.

All chance comes from the generator that is handed in, so that the same seed makes the same input anywhere.
"""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import os
import re
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
WORDS = [
    b"-1",
    b"0",
    b"1",
    b"7",
    b"255",
    b"65536",
    b"2147483647",
    b"4294967295",
    b"9223372036854775807",
    b"1e308",
    b"nan",
]
WORDS += [
    b"1000000",
    b"123456789012345678901234567890",
    b"inf",
    b"x",
    b"",
    b"-2147483648",
    b"0.5",
    b"18446744073709551615",
]
BINARY = [0, 1, 2, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1]

VALUES: list[Any] = [
    *(None, True, -1, 0, 1, 2**31, 2**63, 10**30, -(10**400), 1e308, -1e-308, float("nan"), float("inf")),
    *("", "x", "\0", "\x1b[31m", "5", "/etc/passwd", "../outside.png", "C:\\x", "a" * 10_000, "ä\ud800"),
    *([], {}, [[]], [[[[1]]]], {"a": []}, [1, "a", None]),
]
"""What stands in a JSON file instead of what should."""

_DEEP = 10**5
_BOMB_PIECE, _BOMB_PIECES = 2**26, 48


def mutate(rng: np.random.Generator, folder: Path, name: str) -> str:
    """Changes a file in a folder of its own, or replaces it; what was done, in a word."""
    path = folder / name
    content = path.read_bytes()
    draw = rng.random()
    if draw < 0.05:
        return _replace(rng, folder, path)
    if draw < 0.1:
        change = _wrap
    elif draw < 0.15:
        change = _encode
    elif draw < 0.55 and content[:2] == b"PK":
        change = _change_zip
    elif draw < 0.6 and content[:1] in (b"{", b"["):
        change = _change_json
    else:
        change = damage
    changed = change(rng, content)
    path.unlink()  # other names of the same file keep what they have
    path.write_bytes(changed)
    return change.__name__.strip("_").replace("_", " ")


def _replace(rng: np.random.Generator, folder: Path, path: Path) -> str:
    kind = ["link outside", "dangling link", "circle", "folder", "pipe", "link to a device", "nothing"][rng.integers(7)]
    content = path.read_bytes()
    path.unlink()
    if kind == "link outside":
        outside = folder.parent / "outside"
        outside.write_bytes(content)
        path.symlink_to(outside)
    elif kind == "dangling link":
        path.symlink_to("nowhere")
    elif kind == "circle":
        path.symlink_to(path.name)
    elif kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "link to a device":
        path.symlink_to("/dev/zero")
    return kind


def _wrap(rng: np.random.Generator, content: bytes) -> bytes:
    """Compressed, or compressed once more, cut off, or what unpacks to 3 GB."""
    pack = [lambda data: gzip.compress(data, mtime=0), lzma.compress, bz2.compress][rng.integers(3)]
    packed: bytes = pack(content)
    how = rng.integers(8)
    if how == 0:
        return packed[: int(rng.integers(len(packed)))]
    if how == 1:
        return gzip.compress(content, mtime=0) + _BOMB_PIECES * _bomb_piece()
    return pack(packed) if how == 2 else packed


@cache
def _bomb_piece() -> bytes:
    return gzip.compress(bytes(_BOMB_PIECE), mtime=0)


def _encode(rng: np.random.Generator, content: bytes) -> bytes:
    """As other programs and systems store text."""
    text = content.decode("latin-1")
    change = int(rng.integers(8))
    if change < 4:
        coded = [("utf-16", ""), ("utf-8", "\ufeff"), ("utf-8", "ä\u2028"), ("utf-32", "")][change]
        return (coded[1] + text).encode(coded[0])
    old, new = [(b"\n", b"\r\n"), (b"\n", b"\r"), (b" ", b"\0"), (b"\n", b"\n\0")][change - 4]
    return content.replace(old, new)


def _change_json(rng: np.random.Generator, content: bytes) -> bytes:
    """A value, key or list of a JSON file that is another, twice, deep, or gone."""
    try:
        tree = json.loads(content)
    except ValueError:
        return damage(rng, content)
    places = list(_places(tree))
    if not places:
        return damage(rng, content)
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        # Lists of numbers are most of such a file; what is near the root says more.
        last = len(places) if rng.random() < 0.5 else min(len(places), 30)
        owner, key = places[int(rng.integers(last))]
        change = int(rng.integers(8))
        if change == 0:
            nested = "[" * _DEEP + "]" * _DEEP if rng.random() < 0.5 else '{"a":' * _DEEP + "1" + "}" * _DEEP
            owner[key] = "@deep@"
            return json.dumps(tree).replace('"@deep@"', nested, 1).encode()
        _change_at(rng, owner, key, change)
        places = list(_places(tree))
        if not places:
            break
    text = json.dumps(tree)
    if change == 1 and text.startswith("{"):  # every key twice
        text = text[:-1] + ", " * (len(text) > 2) + text[1:]
    return text.encode()


def _change_at(rng: np.random.Generator, owner: Any, key: Any, change: int) -> None:
    if change == 2:
        del owner[key]
    elif change == 3 and isinstance(owner, list):
        owner.insert(key, owner[key])
    elif change == 4 and isinstance(owner, dict):
        owner[f"{key}_"] = owner.pop(key)
    elif change == 5 and isinstance(owner[key], list) and owner[key]:
        owner[key] = owner[key] * 50
    else:
        owner[key] = VALUES[int(rng.integers(len(VALUES)))]


def _places(tree: Any) -> Any:
    """Owner and key of all values, those near the root first."""
    level = [tree]
    while level:
        below = []
        for owner in level:
            for key in list(owner) if isinstance(owner, dict) else range(len(owner)):
                yield owner, key
                if isinstance(owner[key], dict | list):
                    below.append(owner[key])
        level = below


def _change_zip(rng: np.random.Generator, content: bytes) -> bytes:
    """An archive packed otherwise, with members that are damaged, no arrays, twice, or lie about their size."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    change = int(rng.integers(7))
    index = int(rng.integers(len(members)))
    name, data = members[index]
    if change == 0:
        members.pop(index)
    elif change == 1:
        members[index] = (name, damage(rng, data))
    elif change == 2:
        members[index] = (
            name,
            [b"", b"no array", b"\x93NUMPY", data[:60], gzip.compress(data, mtime=0)][rng.integers(5)],
        )
    elif change == 3:
        members.append(
            [("extra.npy", data), ("../outside.npy", data), ("text.txt", b"x"), (f"{name}x", b"")][rng.integers(4)]
        )
    elif change == 4:
        members[index] = (name, _other_header(rng, data))
    elif change == 5:
        members[index] = (name, data + bytes(_BOMB_PIECE))
    packing = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA][rng.integers(4)]
    output = io.BytesIO()
    with zipfile.ZipFile(output, "w") as archive:
        for member, stored in members:
            archive.writestr(zipfile.ZipInfo(member), stored, packing)  # which has no date of today
    return _with_lies(rng, output.getvalue()) if change == 6 else output.getvalue()


def _other_header(rng: np.random.Generator, data: bytes) -> bytes:
    """An array that says to be of another kind or shape."""
    found = re.search(rb"\{'descr': .*?\}", data[:256])
    if not found:
        return damage(rng, data)
    kind = [b"'|O'", b"'<f8'", b"'>i2'", b"'<U9'", b"[('a', '<f4')]", b"'|b1'", b"'<c16'", b"'<f2'", b"5"][
        rng.integers(9)
    ]
    shape = [b"()", b"(0,)", b"(-1, 4)", b"(10000000000,)", b"(3, 0, 3)", b"(1000000, 1000)", b"5", b"(2,)*9"][
        rng.integers(8)
    ]
    head = found[0]
    if rng.random() < 0.5:
        head = re.sub(rb"'descr': [^,]*", b"'descr': " + kind, head)
    else:
        head = re.sub(rb"'shape': \(.*?\)", b"'shape': " + shape, head)
    return data[: found.start()] + head + data[found.end() :]


def _with_lies(rng: np.random.Generator, content: bytes) -> bytes:
    """Other sizes in the archive's directory."""
    changed = bytearray(content)
    entries = [found.start() for found in re.finditer(rb"PK\x01\x02", content)]
    place = entries[int(rng.integers(len(entries)))] + int(rng.choice([10, 16, 20, 24, 42]))
    changed[place : place + 4] = (BINARY[int(rng.integers(len(BINARY)))] % 2**32).to_bytes(4, "little")
    return bytes(changed)


def damage(rng: np.random.Generator, content: bytes) -> bytes:
    """A few random changes to a file's content."""
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        content = [_cut, _flip, _overwrite, _number, _number, _integer, _integer, _copy, _delete][rng.integers(9)](
            rng, bytearray(content)
        )
    return bytes(content)


def _place(rng, content):
    return int(rng.integers(0, len(content) + 1))


def _cut(rng, content):
    return content[: _place(rng, content)]


def _flip(rng, content):
    for _ in range(rng.integers(1, 9)):
        if content:
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    return content


def _overwrite(rng, content):
    place = _place(rng, content)
    content[place : place + 16] = rng.bytes(int(rng.integers(0, 17)))
    return content


def _number(rng, content):
    # Counts stand at the beginning of sections; the head of the file has most of them.
    found = list(NUMBER.finditer(bytes(content)))
    if not found:
        return content
    last = len(found) if rng.random() < 0.5 else min(len(found), 24)
    chosen = found[int(rng.integers(last))]
    content[chosen.start() : chosen.end()] = WORDS[int(rng.integers(len(WORDS)))]
    return content


def _integer(rng, content):
    size = int(rng.choice([1, 4, 8]))
    place = _place(rng, content) if rng.random() < 0.5 else min(4 * int(rng.integers(16)), len(content))
    value = BINARY[int(rng.integers(len(BINARY)))] % 256**size
    content[place : place + size] = value.to_bytes(size, "little" if rng.random() < 0.7 else "big")
    return content


def _copy(rng, content):
    start, place = _place(rng, content), _place(rng, content)
    return content[:place] + content[start : start + int(rng.integers(64))] + content[place:]


def _delete(rng, content):
    place = _place(rng, content)
    del content[place : place + int(rng.integers(1, 64))]
    return content
