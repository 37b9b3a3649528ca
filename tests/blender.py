"""Opens .glb and .bvh files in Blender and compares every joint in every frame with the positions of the .npy beside them.

By hand, in a virtual environment of Python 3.11 with `pip install bpy`:

    cargo run -p mocap --example motions -- out
    python tests/blender.py out/walk out/crawl

A millimetre is the most that a joint may be off.
"""

import sys

import bpy
import numpy as np
from mathutils import Vector

NAMES = (
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot neck "
    "left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist"
).split()


def farthest(base, ending):
    """The largest distance in metres, over frames and joints."""
    expected = np.load(base + ".npy")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = 20
    if ending == "glb":
        bpy.ops.import_scene.gltf(filepath=base + ".glb")
        assert any(len(thing.data.vertices) > 100 for thing in bpy.data.objects if thing.type == "MESH"), "no figure"
    else:
        # Centimetres, y points up.
        bpy.ops.import_anim.bvh(filepath=base + ".bvh", global_scale=0.01, axis_forward="-Z", axis_up="Y", frame_start=0)
    armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
    first, last = (round(frame) for frame in armature.animation_data.action.frame_range)
    assert last - first + 1 == len(expected), f"{last - first + 1} frames, not {len(expected)}"
    worst = 0.0
    for t, pose in enumerate(expected):
        scene.frame_set(first + t)
        moved = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        for name, joint in zip(NAMES, pose):
            x, y, z = moved.matrix_world @ moved.pose.bones[name].head
            worst = max(worst, (Vector((x, z, -y)) - Vector(joint.tolist())).length)
    return worst


failed = False
for base in sys.argv[1:]:
    for ending in ("glb", "bvh"):
        worst = farthest(base, ending)
        failed |= worst > 1e-3
        print(f"Blender {bpy.app.version_string}: {base}.{ending} is at most {1e3 * worst:.3f} mm off")
sys.exit(failed)
