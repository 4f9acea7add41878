"""Run in Blender's Python: exports an animated camera by the add-on, and where Blender itself sees 100 points.

python blender_scene.py ADD-ON FOLDER [PROGRAM SPLATS CAMERAS]
"""

import importlib.util
import json
import random
import sys
from pathlib import Path

import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Matrix, Vector

spec = importlib.util.spec_from_file_location("aaplug_camera", sys.argv[1])
addon = importlib.util.module_from_spec(spec)
spec.loader.exec_module(addon)
folder = Path(sys.argv[2])

addon.register()
scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 1280, 534, 50
scene.render.fps, scene.frame_start, scene.frame_end = 25, 3, 7
scene.render.use_motion_blur, scene.render.motion_blur_shutter = True, 0.4
camera = scene.camera
camera.scale = (1.5, 1.5, 1.5)
for frame, lens, x, y in ((3, 35, 0.1, -0.05), (7, 80, -0.2, 0.15)):
    camera.data.lens, camera.data.shift_x, camera.data.shift_y = lens, x, y
    camera.location.x += frame
    for path in ("lens", "shift_x", "shift_y"):
        camera.data.keyframe_insert(path, frame=frame)
    camera.keyframe_insert("location", frame=frame)
camera.data.dof.use_dof, camera.data.dof.aperture_fstop, camera.data.dof.aperture_blades = True, 2.0, 6
camera.data.dof.focus_distance = 7.0
frames = addon.frames_of(scene)
addon.write_path(scene, folder / "camera_path.json", frames)

draws, seen = random.Random(0), []
for frame in frames:
    scene.frame_set(frame)
    inside = camera.matrix_world.normalized()
    points = [inside @ Vector((draws.uniform(-1, 1), draws.uniform(-1, 1), -draws.uniform(2, 9))) for _ in range(100)]
    views = [world_to_camera_view(scene, camera, point) for point in points]
    seen.append([[*point, view.x, view.y] for point, view in zip(points, views, strict=True)])

origin = bpy.data.objects.new("splats", None)
origin.matrix_world = Matrix.LocRotScale(Vector((1, 2, 3)), Matrix.Rotation(0.5, 3, "X"), Vector((2, 2, 2)))
scene.collection.objects.link(origin)
bpy.context.view_layer.update()
scene.aaplug.frame = origin
moved = addon.camera_path(scene, frames[:1])
local = [[*(origin.matrix_world.inverted() @ Vector(row[:3])), *row[3:]] for row in seen[0]]
(folder / "moved.json").write_text(json.dumps(moved))
scene.aaplug.frame = None
scene.frame_set(frames[0], subframe=0.5)
camera.data.dof.focus_object = behind = bpy.data.objects.new("behind", None)
scene.collection.objects.link(behind)


def aperture():
    bpy.context.view_layer.update()
    try:
        return addon.camera_path(scene, frames[:1])["camera_path"][0]["aperture"]
    except ValueError as error:
        return str(error)


scene.frame_set(frames[0])
inside = camera.matrix_world.normalized()
scene.frame_set(frames[0], subframe=0.5)
behind.location = inside @ Vector((1, 0, 4))
result = {"seen": seen, "local": local, "behind": aperture()}
behind.location = inside.translation
result |= {"in the lens": aperture(), "subframe": scene.frame_subframe}
skeleton = bpy.data.objects.new("skeleton", bpy.data.armatures.new("skeleton"))
scene.collection.objects.link(skeleton)
bpy.context.view_layer.objects.active = skeleton
bpy.ops.object.mode_set(mode="EDIT")
bone = skeleton.data.edit_bones.new("eye")
bone.head, bone.tail = inside @ Vector((0, 0, -5)), inside @ Vector((0, 1, -5))
bpy.ops.object.mode_set(mode="OBJECT")
camera.data.dof.focus_object, camera.data.dof.focus_subtarget = skeleton, "eye"
result["bone"] = aperture()
camera.data.dof.focus_object = None

if len(sys.argv) > 3:
    scene.aaplug.program, scene.aaplug.splats, scene.aaplug.cameras = sys.argv[3:]
    scene.aaplug.folder, scene.aaplug.options = str(folder / "out"), "--samples 1 --min-seen 0 --threads 1"
    scene.aaplug.goal = "BACKGROUND"
    result["draw"] = list(bpy.ops.aaplug.draw(whole=True))
    background = camera.data.background_images[0]
    result["background"] = [*background.image.size, background.image.source, background.image_user.frame_duration]
    scene.aaplug.goal = "NODE"
    scene.aaplug.options += ' --background "#ff8000" --format webp'
    result["draw again"] = list(bpy.ops.aaplug.draw())
    tree = getattr(scene, "compositing_node_group", None) or scene.node_tree
    image = tree.nodes["aaplug"].image
    result["node"] = [image.name, Path(image.filepath).name, *(round(x * 255) for x in image.pixels[:3])]

    def refused(**settings):
        for name, value in settings.items():
            setattr(scene.aaplug, name, value)
        try:
            return list(bpy.ops.aaplug.draw())
        except RuntimeError as error:
            return str(error)

    result["no scene"] = refused(splats="nothing.ply")
    result["silent"] = refused(program="false")
    result["no program"] = refused(program="no-such-program")
    result["not saved"] = refused(folder="//aaplug")
    result["no splats"] = refused(splats="")
    scene.render.use_border = True  # whose whole frame lies where Blender's does
    result["region"] = addon.camera_path(scene, frames[:1])["render_width"]
    scene.render.use_crop_to_border = True
    result["cropped"] = refused(splats="a.ply", folder=str(folder))
    scene.render.use_border = False
    origin.scale, scene.aaplug.frame = (1, 2, 2), origin
    bpy.context.view_layer.update()
    result["stretched"] = refused(splats="a.ply", folder=str(folder))
addon.unregister()
(folder / "result.json").write_text(json.dumps(result))
