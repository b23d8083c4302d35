"""The add-on for Blender, in Blender as a module: what it checks, what it moves, and what it leaves alone."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ADDON = Path(__file__).parents[2] / "examples" / "blender" / "warp_bsc_addon.py"

pytestmark = pytest.mark.skipif(not importlib.util.find_spec("bpy"), reason="needs Blender as a module: bpy")

START = f"""
import sys
from types import SimpleNamespace
sys.path.append({str(ADDON.parent)!r})
import bpy, numpy as np, warp_bsc as bsc, warp_bsc_addon as addon
bpy.ops.wm.read_factory_settings(use_empty=True)
addon.register()
last = addon._last

def ball(name="Ball", x=0.0, scale=(1.0, 1.0, 1.0)):
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, location=(x, 0.0, 0.0), scale=scale)
    bpy.context.object.name = name
    return bpy.context.object

def two(x=1.9):
    "One object of two balls that cross."
    first, second = ball("First"), ball("Second", x)
    first.select_set(True)
    bpy.context.view_layer.objects.active = first
    bpy.ops.object.join()
    return first

def co(obj, world=False):
    if obj.mode == "EDIT":
        obj.update_from_editmode()
    x = np.array([v.co for v in obj.data.vertices], np.float32)
    place = np.array(obj.matrix_world, float)
    return x @ place[:3, :3].T + place[:3, 3] if world else x

def faces(obj):
    obj.data.calc_loop_triangles()
    return np.array([t.vertices for t in obj.data.loop_triangles])

def crossing(*objects):
    starts = np.cumsum([0, *(len(o.data.vertices) for o in objects)])
    f = np.concatenate([faces(o) + at for o, at in zip(objects, starts)])
    found = bsc.check(f, np.concatenate([co(o, len(objects) > 1) for o in objects]), device="cpu")
    return len(found.crossings) + len(found.touching)

def fails(text, operator, **options):
    try:
        operator(**options)
    except RuntimeError as error:
        assert text in str(error) and last.said[0] == "ERROR", error
    else:
        raise AssertionError(last.said)

check, following, repair = bpy.ops.warp_bsc.check, bpy.ops.warp_bsc.next, bpy.ops.warp_bsc.repair
"""


def run(code, start=START, **environment):
    command, environment = [sys.executable, "-c", start + code], os.environ | environment
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, f"{found.stdout}\n{found.stderr}"


def test_check_and_the_next_finding():
    run("""
obj = two()
assert check() == {"FINISHED"} and last.said[0] == "WARNING"
count = crossing(obj)
assert last.said[1] == f"edge through a face: {count}" and count == len(last.findings) > 10
first = None
for number in range(count + 1):
    assert following() == {"FINISHED"} and bpy.context.mode == "EDIT_MESH"
    assert last.said[1] == f"{number % count + 1} of {count}: edge through a face, of First"
    obj.update_from_editmode()
    selected = {v.index for v in obj.data.vertices if v.select}
    assert selected == set(last.findings[number % count][1]["First"]) and 3 <= len(selected) <= 5
shown = []
layout = SimpleNamespace(operator=shown.append, label=lambda text: shown.append(text))
addon.WARP_BSC_PT_panel.draw(SimpleNamespace(layout=layout), None)
assert shown == ["warp_bsc.check", "warp_bsc.next", "warp_bsc.repair", f"1 of {count}: edge through a face, of First"]
bpy.ops.mesh.delete(type="VERT")
bpy.ops.mesh.select_all(action="SELECT")
bpy.ops.mesh.delete(type="VERT")
fails("First has changed", following)
""")


def test_an_object_is_repaired_and_the_repair_undone():
    run("""
obj = two()
before = co(obj)
bpy.ops.ed.undo_push(message="before")
assert repair() == {"FINISHED"} and last.said[0] == "INFO", last.said
after = co(obj)
moved = (before != after).any(axis=1).sum()
assert crossing(obj) == 0 < moved < 60 and f"{moved} vertices moved" in last.said[1] and " 0 remain" in last.said[1]
assert repair() == {"CANCELLED"} and last.said == ("INFO", "nothing crosses") and (co(obj) == after).all()
bpy.ops.ed.undo_push(message="after")
bpy.ops.ed.undo()
assert (co(bpy.data.objects["First"]) == before).all()
""")


def test_in_edit_mode_selected_vertices_alone_move():
    run("""
obj = two()
before = co(obj)
half = len(before) // 2
for elements in (obj.data.vertices, obj.data.edges, obj.data.polygons):
    elements.foreach_set("select", np.zeros(len(elements), bool))
bpy.ops.object.mode_set(mode="EDIT")
fails("select the vertices that may move", repair)
bpy.ops.object.mode_set(mode="OBJECT")
obj.data.vertices.foreach_set("select", np.arange(2 * half) < half)
bpy.ops.object.mode_set(mode="EDIT")
assert repair() == {"FINISHED"} and bpy.context.mode == "EDIT_MESH"
bpy.ops.object.mode_set(mode="OBJECT")
after = co(obj)
assert crossing(obj) == 0 and (after[half:] == before[half:]).all() and (after[:half] != before[:half]).any()
""")


def test_what_remains_where_nothing_may_move_there_is_a_warning():
    run("""
obj = two()
before = co(obj)
far = before[:, 0] < -0.9
bpy.ops.object.mode_set(mode="OBJECT")
for elements in (obj.data.edges, obj.data.polygons):
    elements.foreach_set("select", np.zeros(len(elements), bool))
obj.data.vertices.foreach_set("select", far)
bpy.ops.object.mode_set(mode="EDIT")
repair()
assert last.said[0] == "WARNING" and f"{crossing(obj)} remain" in last.said[1], last.said
""")


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (0.5, 2.0, 1.0), (-1.0, 1.0, 1.0)])
def test_other_selected_objects_are_obstacles_in_the_world(scale):
    """Objects with a place, a turn and a scale; obstacles may cross each other."""
    run(f"""
body, other, coat = ball("Body"), ball("Other", 0.5), ball("Coat", 1.7, {scale})
coat.rotation_euler = (0.3, 0.0, 1.0)
for obj in (body, other, coat):
    obj.select_set(True)
bpy.context.view_layer.objects.active = coat
bpy.context.view_layer.update()
places = [co(obj) for obj in (body, other)]
assert crossing(body, coat) + crossing(other, coat) > 0 < crossing(body, other)
assert repair() == {{"FINISHED"}} and last.said[0] == "INFO", last.said
assert crossing(body, coat) == crossing(other, coat) == 0 < crossing(body, other)
assert all((co(obj) == x).all() for obj, x in zip((body, other), places))
coat.scale = (0.0, 1.0, 1.0)
bpy.context.view_layer.update()
before = co(coat)
fails("Singular matrix", repair)
assert (co(coat) == before).all()
""")


@pytest.mark.parametrize("mode", ["OBJECT", "EDIT"])
@pytest.mark.parametrize("base", [True, False])
def test_of_shape_keys_the_active_one_moves_and_others_keep_what_they_add(base, mode):
    run(f"""
obj = two()
obj.shape_key_add(name="Basis")
wide = obj.shape_key_add(name="Wide")
for point in wide.data:
    point.co.y *= 1.5
obj.active_shape_key_index = 0 if {base} else 1
keys = obj.data.shape_keys.key_blocks
data = lambda: [np.array([p.co for p in keys[n].data], np.float32) for n in (0, 1)]
before = data()
bpy.ops.object.mode_set(mode="{mode}")
bpy.ops.mesh.select_all(action="SELECT") if "{mode}" == "EDIT" else None
assert repair() == {{"FINISHED"}} and "shape key " + ("Basis" if {base} else "Wide") in last.said[1], last.said
bpy.ops.object.mode_set(mode="OBJECT")
after = data()
own, other = (0, 1) if {base} else (1, 0)
assert len(bsc.check(faces(obj), after[own], device="cpu").crossings) == 0 and (after[own] != before[own]).any()
if {base}:
    assert np.allclose(after[1] - after[0], before[1] - before[0], atol=1e-6)
    assert (co(obj) == after[0]).all()
else:
    assert (after[0] == before[0]).all() and (co(obj) == after[0]).all()
""")


def test_faces_of_many_corners_modifiers_and_meshes_without_faces():
    run("""
bpy.ops.mesh.primitive_circle_add(vertices=9, fill_type="NGON")
disc = bpy.context.object
disc.modifiers.new("Thick", "SOLIDIFY")
needle = ball("Needle", 0.0, (0.2, 0.2, 1.0))
needle.location.z = 0.05
empty = bpy.data.objects.new("Empty", bpy.data.meshes.new("Empty"))
bpy.context.collection.objects.link(empty)
bpy.ops.object.camera_add()
for obj in (disc, needle, empty, bpy.context.object):
    obj.select_set(True)
assert check() == {"FINISHED"} and "modifiers of Circle are not applied" in last.said[1]
assert f"edge through a face: {crossing(disc, needle)}" in last.said[1]
assert {name for kind, places in last.findings for name in places} == {"Circle", "Needle"}
assert following() == {"FINISHED"} and {o.name for o in bpy.context.objects_in_mode} == {"Circle", "Needle"}
""")


def test_nothing_to_check_is_an_error_that_says_so():
    run("""
fails("select a mesh", check)
fails("select a mesh", repair)
fails("check first", following)
bpy.ops.object.camera_add()
fails("select a mesh", check)
empty = bpy.data.objects.new("Empty", bpy.data.meshes.new("Empty"))
bpy.context.collection.objects.link(empty)
empty.select_set(True)
fails("have no faces", check)
obj = ball()
twin = obj.copy()
bpy.context.collection.objects.link(twin)
twin.location.x = 1.0
twin.select_set(True)
bpy.context.view_layer.update()
fails("shares its mesh", repair)
bpy.ops.object.mode_set(mode="SCULPT")
fails("object mode and in edit mode", repair)
bpy.ops.object.mode_set(mode="OBJECT")
obj.data.vertices[0].co.x = float("nan")
fails("finite", check)
obj.data.vertices[0].co.x = 0.0
sys.modules["warp_bsc"] = None
fails("warp-bsc is missing in Blender's Python", check)
addon.unregister()
assert not hasattr(bpy.types, "WARP_BSC_OT_check")
""")


def test_blender_installs_it(tmp_path):
    run(
        f"""
import bpy
bpy.ops.preferences.addon_install(filepath={str(ADDON)!r})
assert bpy.ops.preferences.addon_enable(module="warp_bsc_addon") == {{"FINISHED"}}
assert bpy.types.WARP_BSC_PT_panel.bl_category == "warp-bsc"
assert bpy.ops.preferences.addon_disable(module="warp_bsc_addon") == {{"FINISHED"}}
assert not hasattr(bpy.types, "WARP_BSC_PT_panel")
""",
        start="",
        BLENDER_USER_SCRIPTS=str(tmp_path / "scripts"),
        BLENDER_USER_CONFIG=str(tmp_path / "config"),
    )
    assert list(tmp_path.rglob("warp_bsc_addon.py"))
