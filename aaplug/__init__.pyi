"""The public API, on one page."""

# read and write
from .io.cameras import read_cameras as read_cameras
from .io.images import read_image as read_image, write_png as write_png
from .io.scenes import read_scene as read_scene, write_scene as write_scene
from .io.scenes.scene_file import Scene as Scene

# nouns
from .core.cameras import Camera as Camera, CameraSet as CameraSet, look_at as look_at
from .system.errors import AaplugError as AaplugError
from .core.conventions import Convention as Convention
from .core.gaussians import Gaussians as Gaussians
from .system.monitor import Monitor as Monitor
from .core.pyramids import Pyramid as Pyramid
from .core.splats import Render as Render
from .core.training import TrainingViews as TrainingViews

# prepare and render
from .methods.recipe import Recipe as Recipe
from .methods.recipes import find_recipe as find_recipe
from .rendering.renderer import Renderer as Renderer

# the command line's verbs, each as one call
from .options.shared import Orbit as Orbit
from .verbs.batch import batch as batch
from .verbs.bench import bench as bench
from .verbs.check_plugin import check_plugin as check_plugin
from .verbs.compare import compare as compare
from .verbs.convert import convert as convert
from .verbs.demo import demo as demo
from .verbs.evaluate import evaluate as evaluate
from .verbs.finetune import finetune as finetune
from .verbs.info import info as info
from .verbs.lod import lod as lod
from .verbs.render import render as render
from .verbs.video import video as video
from .verbs.view import serving as serving, view as view
from .verbs.warmup import warmup as warmup

# what can be chosen by name
from .evaluation import METRICS as METRICS
from .evaluation import PROTOCOLS as PROTOCOLS
from .methods import SCREEN_FILTERS as SCREEN_FILTERS, WORLD_FILTERS as WORLD_FILTERS
from .methods import PIXEL_KERNELS as PIXEL_KERNELS
from .methods import RECIPES as RECIPES
from .methods.viewers import VIEWERS as VIEWERS
from .rasterizers import RASTERIZERS as RASTERIZERS
