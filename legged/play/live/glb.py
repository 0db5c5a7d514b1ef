"""Triangles with colours as a binary glTF 2.0 file (Khronos Group, "glTF 2.0 specification"), which browsers read."""

import json
import struct

import numpy as np

MAGIC, VERSION, JSON, BINARY = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT, UNSIGNED_INT = 5126, 5125
VERTICES, FACES = 34962, 34963
"""What a buffer is bound to."""
MATT = {"metallicFactor": 0.0, "roughnessFactor": 0.85}


def glb(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> bytes:
    """Return a file with one mesh: `vertices` (V, 3) [m], `faces` (F, 3) of them, and `colors` (V, 3), 0 to 255, as they are
    seen (sRGB). Surfaces are smooth where triangles share vertices.
    """
    arrays = [
        np.ascontiguousarray(vertices, dtype="<f4"),
        np.ascontiguousarray(normals(vertices, faces), dtype="<f4"),
        np.ascontiguousarray(linear(colors), dtype="<f4"),
        np.ascontiguousarray(faces, dtype="<u4").reshape(-1),
    ]
    views, accessors, start = [], [], 0
    for i, array in enumerate(arrays):
        triangles = i == len(arrays) - 1
        views.append(
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes, "target": FACES if triangles else VERTICES}
        )
        accessors.append(
            {
                "bufferView": i,
                "componentType": UNSIGNED_INT if triangles else FLOAT,
                "count": len(array),
                "type": "SCALAR" if triangles else "VEC3",
            }
        )
        start += array.nbytes
    accessors[0] |= {"min": arrays[0].min(axis=0).tolist(), "max": arrays[0].max(axis=0).tolist()}
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}
    scene = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 3, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": MATT}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(array.tobytes() for array in arrays)
    length = 12 + 8 + len(text) + 8 + len(data)
    header = struct.pack("<III", MAGIC, VERSION, length)
    return header + struct.pack("<II", len(text), JSON) + text + struct.pack("<II", len(data), BINARY) + data


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (V, 3) unit normals: at each vertex the mean of those of its triangles, weighted by their area."""
    corners = vertices[faces]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(total, faces[:, corner], sides)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0.0, total / np.maximum(length, 1e-300), np.array([0.0, 0.0, 1.0]))


def linear(colors: np.ndarray) -> np.ndarray:
    """Return light intensities, 0 to 1, of colours as screens take them (sRGB, IEC 61966-2-1), 0 to 255."""
    value = np.asarray(colors, dtype=float) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
