"""The public API, on one page."""

__version__: str

# read and write
from .io.cameras import read_camera_path as read_camera_path, read_cameras as read_cameras
from .io.images import read_image as read_image, write_png as write_png
from .io.scenes import read_scene as read_scene, write_scene as write_scene
from .io.scenes.scene import Scene as Scene

# nouns
from .core.cameras import Camera as Camera, CameraSet as CameraSet, look_at as look_at
from .core.cameras import Aperture as Aperture, Exposure as Exposure
from .core.lenses import Lens as Lens
from .system.errors import AaplugError as AaplugError, FormatError as FormatError, UsageError as UsageError
from .core.conventions import Convention as Convention
from .core.gaussians import Gaussians as Gaussians
from .system.monitor import Monitor as Monitor
from .core.pyramids import Pyramid as Pyramid
from .core.splats import Render as Render
from .core.training import TrainingViews as TrainingViews

# prepare and render
from .methods.recipe import Recipe as Recipe
from .methods.presets import find_recipe as find_recipe
from .rendering.renderer import Renderer as Renderer

# the command line's verbs, each as one call
from .options.verbs import Orbit as Orbit
from .rendering.assumed import cameras_around as cameras_around
from .verbs.batch import batch as batch
from .verbs.bench import bench as bench
from .verbs.check_plugin import check_plugin as check_plugin
from .verbs.compare import compare as compare
from .verbs.conform import conform as conform
from .verbs.convert import convert as convert
from .verbs.demo import demo as demo
from .verbs.evaluate import evaluate as evaluate
from .verbs.finetune import finetune as finetune
from .verbs.info import info as info
from .verbs.lod import lod as lod
from .verbs.merge import merge as merge
from .verbs.refine_poses import refine_poses as refine_poses
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

# what a plug-in implements
from .core.interfaces import Compositor as Compositor, PixelKernel as PixelKernel, Rasterizer as Rasterizer
from .core.interfaces import ScreenFilter as ScreenFilter, WorldFilter as WorldFilter
from .evaluation.metric import Metric as Metric
from .io.cameras import CameraFormat as CameraFormat
from .io.scenes import SceneFormat as SceneFormat, WritableFormat as WritableFormat

# what a plug-in works with
from .core.colours import Colour as Colour
from .core.convolution import smoothed_by as smoothed_by
from .core.ellipses import grown as grown, whitening as whitening, whitening_columns as whitening_columns
from .core.gaussians import Fusion as Fusion
from .core.imaging import over as over
from .core.interfaces import Limits as Limits, Pixels as Pixels
from .core.kernels import Kernels as Kernels
from .core.rules import RULES_3DGS as RULES_3DGS, Rules as Rules
from .core.spherical_harmonics import COLOUR_OFFSET as COLOUR_OFFSET, SH_C0 as SH_C0
from .core.spectra import frequency_response as frequency_response
from .core.splats import Splats2D as Splats2D
from .io.atomic import replacing as replacing
from .io.cameras.sets import CameraFileOptions as CameraFileOptions
from .io.scenes.packed import logit_of as logit_of, sh_of_colour as sh_of_colour
from .io.scenes.rows import SceneFileOptions as SceneFileOptions, check_count as check_count
from .io.scenes.rows import library_errors as library_errors
from .methods.pixel_kernels import raster_rows as raster_rows
