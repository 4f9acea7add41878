"""Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes.

Read `aaplug.pipeline` first: it holds the whole flow on one page.
"""

from aaplug.cameras import Camera, CameraSet, look_at
from aaplug.conversion import FORMS, VIEWERS, convert, convert_for
from aaplug.errors import AaplugError
from aaplug.evaluation import Task, evaluate
from aaplug.gaussians import ANTIALIASED, CLASSIC, MIP, Convention, Gaussians
from aaplug.interfaces import Training
from aaplug.io.cameras import read_cameras
from aaplug.io.images import read_image, write_png
from aaplug.io.scenes import read_scene, write_scene
from aaplug.pipeline import learn, render, smooth
from aaplug.protocols import PROTOCOLS, Protocol, find_protocol
from aaplug.recipes import RECIPES, Recipe, find_recipe
from aaplug.sampling import SamplingBounds, check_frame, sampling_bounds
from aaplug.splats import Render

__all__ = [
    "ANTIALIASED",
    "CLASSIC",
    "FORMS",
    "MIP",
    "PROTOCOLS",
    "RECIPES",
    "VIEWERS",
    "AaplugError",
    "Camera",
    "CameraSet",
    "Convention",
    "Gaussians",
    "Protocol",
    "Recipe",
    "Render",
    "SamplingBounds",
    "Task",
    "Training",
    "check_frame",
    "convert",
    "convert_for",
    "evaluate",
    "find_protocol",
    "find_recipe",
    "learn",
    "look_at",
    "read_cameras",
    "read_image",
    "read_scene",
    "render",
    "sampling_bounds",
    "smooth",
    "write_png",
    "write_scene",
]
