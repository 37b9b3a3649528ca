"""A person as a GLB file, as programs export them: names of Mixamo, centimetres, z up, a T pose, and a skin that blends at the joints."""

from __future__ import annotations

import json
import math
import struct

# Name, parent, place in centimetres with y up and the left hand at +x, radius.
JOINTS = [
    ("Hips", None, (0, 95, 0), 13), ("Spine", "Hips", (0, 105, 0), 13), ("Spine1", "Spine", (0, 117, 0), 14), ("Spine2", "Spine1", (0, 130, 0), 14),
    ("Neck", "Spine2", (0, 148, 0), 6), ("Head", "Neck", (0, 158, 0), 10), ("HeadTop_End", "Head", (0, 176, 0), 9),
]
for side, sign in (("Left", 1), ("Right", -1)):
    JOINTS += [
        (f"{side}Shoulder", "Spine2", (6 * sign, 143, 0), 7), (f"{side}Arm", f"{side}Shoulder", (18 * sign, 143, 0), 6),
        (f"{side}ForeArm", f"{side}Arm", (46 * sign, 143, 0), 5), (f"{side}Hand", f"{side}ForeArm", (71 * sign, 143, 0), 4),
        (f"{side}HandMiddle4", f"{side}Hand", (88 * sign, 143, 0), 3),
        (f"{side}UpLeg", "Hips", (9 * sign, 90, 0), 9), (f"{side}Leg", f"{side}UpLeg", (9 * sign, 50, 0), 6),
        (f"{side}Foot", f"{side}Leg", (9 * sign, 8, 0), 5), (f"{side}ToeBase", f"{side}Foot", (9 * sign, 2, 13), 4), (f"{side}Toe_End", f"{side}ToeBase", (9 * sign, 2, 20), 3),
    ]  # fmt: skip
NAMES = [name for name, *_ in JOINTS]
PLACES = [place for _, _, place, _ in JOINTS]
AROUND, ALONG = 12, 8


def tube(at: int) -> tuple[list[list[float]], list[list[float]], list[list[int]], list[list[float]]]:
    """Places, normals, joints and weights around a bone."""
    name, above, end, thick = JOINTS[at]
    parent = NAMES.index(str(above))
    start, first = PLACES[parent], JOINTS[parent][3]
    way = [b - a for a, b in zip(start, end)]
    long = math.hypot(*way) or 1.0
    way = [value / long for value in way]
    side = (0.0, 0.0, 1.0) if abs(way[2]) < 0.9 else (1.0, 0.0, 0.0)
    u = cross(way, side)
    u = [value / math.hypot(*u) for value in u]
    v = cross(way, u)
    places, normals, joints, weights = [], [], [], []
    for row in range(ALONG + 1):
        part = row / ALONG
        radius = min(first, thick) * (1 - part) + thick * part
        # What is near the end of a bone moves with the next one too.
        share = max(0.0, part - 0.8) * 2.5
        for turn in range(AROUND):
            angle = 2 * math.pi * turn / AROUND
            normal = [math.cos(angle) * a + math.sin(angle) * b for a, b in zip(u, v)]
            places.append([a + part * long * w + radius * n for a, w, n in zip(start, way, normal)])
            normals.append(normal)
            joints.append([parent, at, 0, 0])
            weights.append([1 - share, share, 0, 0])
    return places, normals, joints, weights


def cross(a: list[float] | tuple[float, ...], b: list[float] | tuple[float, ...]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def glb(names: str = "mixamorig:") -> bytes:
    """The file. The armature turns z up to y up and centimetres to metres."""
    places: list[list[float]] = []
    normals: list[list[float]] = []
    joints: list[list[int]] = []
    weights: list[list[float]] = []
    index: list[int] = []
    for at in range(1, len(JOINTS)):
        begin = len(places)
        for into, more in zip((places, normals, joints, weights), tube(at)):
            into.extend(more)  # type: ignore[arg-type]
        for row in range(ALONG):
            for turn in range(AROUND):
                a, b = begin + row * AROUND + turn, begin + row * AROUND + (turn + 1) % AROUND
                index += [a, b, a + AROUND, b, b + AROUND, a + AROUND]
    z_up = lambda p: [p[0], -p[2], p[1]]  # noqa: E731
    binds = [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, *(-value for value in z_up(place)), 1] for place in PLACES]
    chunks, views, accessors = b"", [], []
    for values, form, kind, wide, code in (
        ([z_up(p) for p in places], "f", "VEC3", 3, 5126), ([z_up(n) for n in normals], "f", "VEC3", 3, 5126), (joints, "B", "VEC4", 4, 5121),
        (weights, "f", "VEC4", 4, 5126), ([[i] for i in index], "I", "SCALAR", 1, 5125), (binds, "f", "MAT4", 16, 5126),
    ):  # fmt: skip
        data = b"".join(struct.pack(f"<{wide}{form}", *row) for row in values)
        views.append({"buffer": 0, "byteOffset": len(chunks), "byteLength": len(data)})
        accessors.append({"bufferView": len(views) - 1, "componentType": code, "count": len(values), "type": kind})
        chunks += data + b"\0" * (-len(data) % 4)
    nodes = []
    for name, above, place, _ in JOINTS:
        base = PLACES[NAMES.index(above)] if above else (0, 0, 0)
        children = [at for at, other in enumerate(JOINTS) if other[1] == name]
        nodes.append({"name": names + name, "translation": z_up([a - b for a, b in zip(place, base)]), **({"children": children} if children else {})})
    half = math.sqrt(0.5)
    nodes += [{"name": "Body", "mesh": 0, "skin": 0}, {"name": "Armature", "rotation": [-half, 0, 0, half], "scale": [0.01] * 3, "children": [0, len(nodes)]}]
    tree = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [len(nodes) - 1]}], "nodes": nodes, "buffers": [{"byteLength": len(chunks)}],
        "bufferViews": views, "accessors": accessors, "skins": [{"joints": list(range(len(JOINTS))), "inverseBindMatrices": 5}],
        "materials": [{"pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.3, 0.1, 1]}}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "JOINTS_0": 2, "WEIGHTS_0": 3}, "indices": 4, "material": 0}]}],
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<III", 0x46546C67, 2, 28 + len(text) + len(chunks)) + struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(chunks), 0x4E4942) + chunks
