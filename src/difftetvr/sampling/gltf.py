"""Surfaces in binary glTF (.glb).

Source: glTF 2.0, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

from __future__ import annotations

import json
import struct
from typing import Any, BinaryIO

import numpy as np

from difftetvr._version import __version__
from difftetvr.errors import MeshError

_MAGIC, _VERSION, _JSON, _BINARY = b"glTF", 2, b"JSON", b"BIN\0"
_ALIGNMENT = 4
_FLOAT, _UNSIGNED_INT = 5126, 5125
_OF_VERTICES, _OF_INDICES = 34962, 34963
_LONGEST = 2**32 - 1
_MOST_ROUNDED = 1e-3  # of a surface's size
_Z_TO_Y = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # quaternion x y z w: a quarter of a turn around x


def write_glb(
    file: BinaryIO, places: np.ndarray, triangles: np.ndarray, normals: np.ndarray, colors: np.ndarray | None
) -> None:
    """Writes a surface.

    Places are float32 and count from the surface's centre, so that they are not rounded more where it is far from the
    origin; a node brings them there, and its parent turns z, which is up in the world, to y, which is so in glTF.

    Args:
        file: Where to.
        places: (P, 3) vertices.
        triangles: (M, 3) vertices of triangles, counter-clockwise seen from outside.
        normals: (P, 3) unit vectors.
        colors: (P, 3) linear RGB in [0, 1], or None.

    Raises:
        MeshError: It takes more than the 4 GiB that such a file can have, or its size is beyond float32.
    """
    center = 0.5 * (places.min(axis=0).astype(np.float64) + places.max(axis=0))
    local = rounded_places(places - center, ".glb")
    attributes = {"POSITION": local, "NORMAL": normals.astype("<f4")}
    if colors is not None:
        attributes["COLOR_0"] = colors.astype("<f4")
    indices = triangles.astype("<u4").reshape(-1)
    # All numbers have four bytes, so every part begins where it may.
    parts = [*attributes.values(), indices]
    accessors: list[dict[str, Any]] = [
        {"bufferView": view, "componentType": _FLOAT, "count": len(values), "type": "VEC3"}
        for view, values in enumerate(attributes.values())
    ]
    accessors[0] |= {"min": local.min(axis=0).tolist(), "max": local.max(axis=0).tolist()}
    accessors.append(
        {"bufferView": len(attributes), "componentType": _UNSIGNED_INT, "count": len(indices), "type": "SCALAR"}
    )
    primitive = {"attributes": {name: index for index, name in enumerate(attributes)}, "indices": len(attributes)}
    content = {
        "asset": {"version": "2.0", "generator": f"difftetvr {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"rotation": _Z_TO_Y, "children": [1]}, {"mesh": 0, "translation": center.tolist()}],
        "meshes": [{"primitives": [{**primitive, "material": 0}]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.6}}],
        "accessors": accessors,
        "bufferViews": _views(parts),
        "buffers": [{"byteLength": sum(part.nbytes for part in parts)}],
    }
    _write_chunks(file, content, parts)


def rounded_places(places: np.ndarray, suffix: str) -> np.ndarray:
    """Places as float32, little-endian.

    Args:
        places: (..., 3) places.
        suffix: Of the format that has no other numbers, for the sentence.

    Raises:
        MeshError: Too little would be left of the surface: it is too large or too small, or too far from where it is
            counted from.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        single = places.astype("<f4")
        rounding = np.abs(places - single).max()
    span = float(np.ptp(places.reshape(-1, 3), axis=0).max())
    if not rounding <= _MOST_ROUNDED * span:
        raise MeshError(
            f"A {suffix} has float32 only, which would round places by {rounding:.3g} on a surface that is {span:.3g} "
            "across; write a .ply."
        )
    return single


def _views(parts: list[np.ndarray]) -> list[dict[str, int]]:
    """Where in the buffer parts lie, of which the last holds the indices."""
    begins = np.cumsum([0, *(part.nbytes for part in parts)]).tolist()
    targets = [_OF_VERTICES] * (len(parts) - 1) + [_OF_INDICES]
    return [
        {"buffer": 0, "byteOffset": begin, "byteLength": part.nbytes, "target": target}
        for begin, part, target in zip(begins, parts, targets)
    ]


def _write_chunks(file: BinaryIO, content: dict[str, Any], parts: list[np.ndarray]) -> None:
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    size = sum(part.nbytes for part in parts)
    length = 12 + 8 + len(text) + 8 + size
    if length > _LONGEST:
        raise MeshError(f"The surface takes {length / 2**30:.3g} GiB, where a .glb holds 4; write a .ply.")
    file.write(_MAGIC + struct.pack("<II", _VERSION, length))
    file.write(struct.pack("<I", len(text)) + _JSON + text)
    file.write(struct.pack("<I", size) + _BINARY)
    for part in parts:
        file.write(np.ascontiguousarray(part).data)
