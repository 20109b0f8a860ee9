"""Writes coloured triangle meshes as binary glTF, byte for byte the same for the same input."""

import json
import struct
from collections.abc import Sequence
from typing import Any

from robot_model.meshes import MATERIALS, Part

_ARRAY_BUFFER, _ELEMENT_BUFFER = 34962, 34963
_FLOAT, _UNSIGNED_SHORT = 5126, 5123


def to_glb(parts: Sequence[Part]) -> bytes:
    """A glTF file with one mesh for each part; a part has fewer than 65,536 vertices."""
    names = sorted({part.material for part in parts})
    blob = bytearray()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def add(array: Any, target: int, component: int, kind: str, **extra: Any) -> int:
        data = array.tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data), "target": target})
        blob.extend(data + b"\0" * (-len(data) % 4))
        count = array.size if kind == "SCALAR" else len(array)
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": count, "type": kind, **extra}
        )
        return len(accessors) - 1

    meshes = []
    for part in parts:
        vertices = part.vertices.astype("<f4")
        bounds = {"min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist()}
        position = add(vertices, _ARRAY_BUFFER, _FLOAT, "VEC3", **bounds)
        normal = add(part.normals.astype("<f4"), _ARRAY_BUFFER, _FLOAT, "VEC3")
        indices = add(part.faces.astype("<u2"), _ELEMENT_BUFFER, _UNSIGNED_SHORT, "SCALAR")
        attributes = {"POSITION": position, "NORMAL": normal}
        primitive = {"attributes": attributes, "indices": indices, "material": names.index(part.material)}
        meshes.append({"primitives": [primitive]})

    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(parts)))}],
        "nodes": [{"mesh": i, "name": f"{i}_{part.material}"} for i, part in enumerate(parts)],
        "meshes": meshes,
        "materials": [
            {
                "name": name,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*MATERIALS[name].color, 1.0],
                    "metallicFactor": MATERIALS[name].metallic,
                    "roughnessFactor": MATERIALS[name].roughness,
                },
            }
            for name in names
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(blob), b"BIN\0")
        + bytes(blob)
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
