"""Blender add-on: exports the animated camera for aaplug, has it draw the frames, and loads them behind the scene.

Install this file in Edit > Preferences > Add-ons > Install from Disk.  The panel is in Properties > Output > aaplug.
It writes nerfstudio's camera_path.json with each frame's exact lens, in px, and its aperture.  Blender 4.2 and above.
"""

import json
import math
import shlex
import subprocess
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, PointerProperty, StringProperty
from mathutils import Vector

bl_info = {
    "name": "aaplug camera",
    "author": "The aaplug authors",
    "version": (1, 0, 0),
    "blender": (4, 2, 0),
    "location": "Properties > Output > aaplug",
    "description": "Draw 3D Gaussian Splatting behind the scene with the scene's own camera",
    "category": "Import-Export",
}
MILLIMETRE = 1e-3  # in Blender's units, which Cycles takes for metres
EVEN = 1e-3  # relative difference between scales that counts as rounding
NAME = "aaplug"  # of the image, its background and its node


def camera_path(scene, frames):
    """The path file's content for these frame numbers; the scene keeps its current frame.

    Raises ValueError for a camera that has no perspective lens or no distance in focus, for a Frame that stretches or
    mirrors, and for images that Blender crops.
    """
    render, current, subframe = scene.render, scene.frame_current, scene.frame_subframe
    if render.use_border and render.use_crop_to_border:
        raise ValueError("Crop to Render Region: aaplug draws the whole frame; switch it off")
    scale = render.resolution_percentage / 100
    size = max(1, int(render.resolution_x * scale)), max(1, int(render.resolution_y * scale))
    try:
        poses = []
        for frame in frames:
            scene.frame_set(frame)
            poses.append(_camera(scene, size))
    finally:
        scene.frame_set(current, subframe=subframe)
    path = {
        "camera_type": "perspective",
        "render_width": size[0],
        "render_height": size[1],
        "fps": render.fps / render.fps_base,
        "camera_path": poses,
    }
    if render.use_motion_blur and render.motion_blur_shutter > 0 and len(poses) > 1:
        path["shutter"] = min(1.0, render.motion_blur_shutter)
    return path


def _camera(scene, size):
    """One frame: pose in the splats' frame, lens in px, aperture in the splats' units."""
    camera = scene.camera
    if camera is None or camera.data.type != "PERSP":
        raise ValueError(f"frame {scene.frame_current} has no perspective camera")
    width, height = size
    corners = camera.data.view_frame(scene=scene)
    depth = -corners[0].z
    left, right = min(c.x for c in corners), max(c.x for c in corners)
    bottom, top = min(c.y for c in corners), max(c.y for c in corners)
    fy = height * depth / (top - bottom)
    pose, unit = camera.matrix_world.normalized(), 1.0
    if scene.aaplug.frame is not None:
        splats = scene.aaplug.frame.matrix_world
        sizes = splats.to_scale()
        if not 0 < max(sizes) <= (1 + EVEN) * min(sizes):
            raise ValueError(f"Frame: its scale should be the same along all axes and above 0, not {tuple(sizes)}")
        unit = sum(sizes) / 3
        pose = splats.normalized().inverted() @ pose
        pose.translation /= unit
    frame = {
        "camera_to_world": [x for row in pose for x in row],
        "fov": math.degrees(2 * math.atan(height / 2 / fy)),
        "fl_x": width * depth / (right - left),
        "fl_y": fy,
        "cx": -left / (right - left) * width,
        "cy": top / (top - bottom) * height,
    }
    dof = camera.data.dof
    if dof.use_dof:
        focus = dof.focus_distance
        if dof.focus_object is not None:
            bone = dof.focus_object.pose.bones.get(dof.focus_subtarget) if dof.focus_object.pose else None
            place = dof.focus_object.matrix_world @ (bone.head if bone else Vector())
            offset = place - camera.matrix_world.translation
            focus = abs(offset.dot(camera.matrix_world.normalized().col[2].to_3d()))  # as Blender takes one behind
        if not focus > 0:
            raise ValueError(f"frame {scene.frame_current} has a focus distance of 0")
        radius = camera.data.lens * MILLIMETRE / 2 / dof.aperture_fstop
        blades = dof.aperture_blades if dof.aperture_blades >= 3 else 0
        frame["aperture"] = {"radius": radius / unit, "focus": focus / unit, "blades": blades}
    return frame


def write_path(scene, file, frames):
    """Write the path file of these frames."""
    text = json.dumps(camera_path(scene, frames), indent=1)
    Path(file).write_text(text)


def draw(scene, frames, folder):
    """Have aaplug draw these frames into a folder; returns the images in order.

    Raises ValueError with what is missing, or what aaplug says where it fails.
    """
    settings = scene.aaplug
    if not settings.splats:
        raise ValueError("Splats: choose a scene to draw")
    if folder.startswith("//") and not bpy.data.filepath:
        raise ValueError("Folder: save the .blend file first, beside which it lies, or choose another")
    folder = Path(bpy.path.abspath(folder))
    folder.mkdir(parents=True, exist_ok=True)
    write_path(scene, folder / "camera_path.json", frames)
    images = folder / "frames"
    words = [bpy.path.abspath(settings.program), "render", bpy.path.abspath(settings.splats), "--json"]
    if settings.cameras:
        words += ["--cameras", bpy.path.abspath(settings.cameras)]
    words += ["--path", str(folder / "camera_path.json"), "-o", str(images), "--overwrite"]
    words += shlex.split(settings.options)
    try:
        done = subprocess.run(words, capture_output=True, text=True)
    except OSError as error:
        raise ValueError(f"Program: {settings.program} cannot be started: {error.strerror}") from error
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines()[-1:]
        raise ValueError(
            "".join(said).removeprefix("error: ") or f"{settings.program} ended with status {done.returncode}"
        )
    return [image["file"] for image in json.loads(done.stdout)["images"]]


def load(scene, files, first):
    """The images as one still or sequence that begins at a frame, behind the camera or as a node of the compositor."""
    image = bpy.data.images.get(NAME)
    if image is not None:
        bpy.data.images.remove(image)
    image = bpy.data.images.load(files[0])
    image.name = NAME
    image.source = "SEQUENCE" if len(files) > 1 else "FILE"
    user = _node(scene, image) if scene.aaplug.goal == "NODE" else _background(scene, image)
    user.frame_start, user.frame_duration, user.frame_offset = first, len(files), -1  # the first file has number 0
    return image


def _background(scene, image):
    """The camera's background with this image; returns what plays it."""
    data = scene.camera.data
    data.show_background_images = True
    old = [each for each in data.background_images if each.image is None or each.image.name == NAME]
    for each in old:
        data.background_images.remove(each)
    background = data.background_images.new()
    background.image, background.alpha, background.display_depth = image, 1.0, "BACK"
    return background.image_user


def _node(scene, image):
    """The compositor's image node of our name with this image; returns what plays it."""
    if hasattr(scene, "compositing_node_group"):  # Blender 5
        if scene.compositing_node_group is None:
            scene.compositing_node_group = bpy.data.node_groups.new("Compositing", "CompositorNodeTree")
        tree = scene.compositing_node_group
    else:
        scene.use_nodes = True
        tree = scene.node_tree
    node = tree.nodes.get(NAME) or tree.nodes.new("CompositorNodeImage")
    node.name = node.label = NAME
    node.image = image
    return node


class Settings(bpy.types.PropertyGroup):
    """What is drawn, and where it goes."""

    splats: StringProperty(name="Splats", description="Scene to draw, such as a .ply", subtype="FILE_PATH")
    cameras: StringProperty(
        name="Cameras", description="Training cameras, which make it sharper; may be empty", subtype="FILE_PATH"
    )
    frame: PointerProperty(
        name="Frame", description="Object that stands for the splats' origin and axes", type=bpy.types.Object
    )
    program: StringProperty(name="Program", description="aaplug's command", default="aaplug", subtype="FILE_PATH")
    folder: StringProperty(name="Folder", description="For path and images", default="//aaplug", subtype="DIR_PATH")
    options: StringProperty(name="Options", description="Further options of aaplug render")
    goal: EnumProperty(
        name="Load as",
        items=[("BACKGROUND", "Background", "Behind the camera"), ("NODE", "Compositor", "As an image node")],
    )


class ExportPath(bpy.types.Operator):
    """Write the camera of the frame range as camera_path.json"""

    bl_idname, bl_label = "aaplug.export_path", "Export Camera"
    filepath: StringProperty(subtype="FILE_PATH", default="camera_path.json")

    def invoke(self, context, event):
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        try:
            write_path(context.scene, bpy.path.abspath(self.filepath), frames_of(context.scene))
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class Draw(bpy.types.Operator):
    """Draw the current frame or the frame range by aaplug and load it"""

    bl_idname, bl_label = "aaplug.draw", "Draw"
    whole: BoolProperty(name="Frame Range", default=False)

    def execute(self, context):
        scene = context.scene
        frames = frames_of(scene) if self.whole else [scene.frame_current]
        try:
            load(scene, draw(scene, frames, scene.aaplug.folder), frames[0])
        except (ValueError, OSError, RuntimeError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


def frames_of(scene):
    """The frame numbers of the scene's range, each: images of a sequence have one number a frame."""
    return list(range(scene.frame_start, scene.frame_end + 1))


class Panel(bpy.types.Panel):
    """The add-on's panel."""

    bl_idname, bl_label = "OUTPUT_PT_aaplug", "aaplug"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "output"

    def draw(self, context):
        for name in Settings.__annotations__:
            self.layout.prop(context.scene.aaplug, name)
        self.layout.operator(ExportPath.bl_idname)
        self.layout.operator(Draw.bl_idname, text="Draw Frame")
        self.layout.operator(Draw.bl_idname, text="Draw Range").whole = True


CLASSES = (Settings, ExportPath, Draw, Panel)


def register():
    """Add the classes and the scene's settings."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.aaplug = PointerProperty(type=Settings)


def unregister():
    """Take them away again."""
    del bpy.types.Scene.aaplug
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
