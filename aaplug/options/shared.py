"""Options that several verbs share."""

import math
import os
import re
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from aaplug.core.colours import Background
from aaplug.core.conventions import MIN_SEEN_SHARE
from aaplug.core.passes import PASSES, NormalAxes
from aaplug.io.image_formats import COLOURS, IMAGE_FORMATS
from aaplug.methods import QUALITIES, RateReference, SplatOrder
from aaplug.options.base import CAMERAS, DRAWING, FILES, FILM, LENS, ORBIT, Options, flag, names, number
from aaplug.system.contracts import LazyType
from aaplug.system.errors import MAX_VALUE_CHARACTERS, UsageError
from aaplug.system.registry import names_of

if TYPE_CHECKING:  # the modules of these types import torch
    from aaplug.core.interfaces import Rasterizer
    from aaplug.evaluation.protocols import Protocol
    from aaplug.methods.recipe import Recipe
    from aaplug.methods.viewers import Viewer
    from aaplug.system.executors import Executor
else:
    Rasterizer = Annotated[Any, LazyType("aaplug.core.interfaces:Rasterizer")]
    Protocol = Annotated[Any, LazyType("aaplug.evaluation.protocols:Protocol")]
    Recipe = Annotated[Any, LazyType("aaplug.methods.recipe:Recipe")]
    Viewer = Annotated[Any, LazyType("aaplug.methods.viewers:Viewer")]
    Executor = Annotated[Any, LazyType("aaplug.system.executors:Executor")]

SCALE = number(0.001, 64)  # sizes of images against the training size
SCALES = number(0.001, 64, several=True)
STEPS = number(0, 1_000_000, whole=True, metavar="N")
THREADS = number(1, max(8, os.cpu_count() or 1), whole=True)  # more gain nothing, and can exhaust the machine
VIEWS = flag("NAME,...|test|train|all")
RECIPE_NAMES = names_of("recipe", comparisons=False)
RECIPE_METAVAR = "|".join([*RECIPE_NAMES, "..."])  # in `--help`
HALF_TURN = 180.0  # degrees: what a fisheye shows, unless another angle is given
MAX_SIDE = 16384  # px
MAX_COORDINATE = 1e7  # world units
DEFAULT_FOV = 50.0  # degrees
DEFAULT_SENSOR = 0.036  # scene units: 36 mm, the width of full frame, where a scene unit is a metre

_PLACE = number(-MAX_COORDINATE, MAX_COORDINATE, several=True, metavar="X Y Z", length=3)

OneRecipe = Annotated[str | Recipe, names(kind="recipe", metavar=RECIPE_METAVAR)]
OneViewer = Annotated[str | Viewer | None, names(kind="viewer", metavar="VIEWER", flags=("--for",))]
OneProtocol = Annotated[str | Protocol, names(kind="protocol")]


def size_of(text: str, where: str = "resolution", shape: tuple[int, int] | None = None) -> tuple[int, int]:
    """Width and height of "400x300", in px.

    where: the option that it is of.  shape: width and height whose aspect -1 on one side keeps.

    Raises UsageError if it is no size, or a side is above `MAX_SIDE`.
    """
    free = r"|-1" if shape else ""
    match = re.fullmatch(rf"([1-9]\d{{0,8}}{free})x([1-9]\d{{0,8}}{free})", text, re.ASCII)
    if match is None or match[1] == match[2] == "-1":
        raise UsageError(where, f"takes sizes such as 400x400, got {text[:MAX_VALUE_CHARACTERS]}")
    width, height = int(match[1]), int(match[2])
    if shape is not None and width < 0:
        width = max(1, round(shape[0] * height / shape[1]))
    elif shape is not None and height < 0:
        height = max(1, round(shape[1] * width / shape[0]))
    check_side(where, width, height)
    return width, height


def check_side(where: str, width: int, height: int) -> None:
    """Refuse an image with a side above `MAX_SIDE`; raises UsageError."""
    if max(width, height) > MAX_SIDE:
        raise UsageError(where, f"would be {width}x{height} px; the limit is {MAX_SIDE} a side")


def _check_colour(text: str, where: str) -> None:
    """Refuse what is no colour; the module that knows colours imports torch, so it waits for one to be given."""
    if text == "transparent":
        raise UsageError(where, "takes auto or an opaque colour; for none, render and video have `transparent`")
    if text != "auto":
        import_module("aaplug.io.images").colour_of(text, where)


class FrameOptions(Options):
    """Check that scene and cameras belong together."""

    min_seen: Annotated[float, number(0, 1), CAMERAS] = MIN_SEEN_SHARE
    """Stop if the cameras see less than this share of the Gaussians, or seem of another capture; 0 never stops."""


class ViewOptions(FrameOptions):
    """Views, background and rasterizer."""

    views: Annotated[str, VIEWS] = "test"
    """Views, by name or split."""
    background: Annotated[Background, flag("auto|COLOUR", parsed=_check_colour)] = "auto"
    """Colour behind the scene in CSS, such as white or "#ff8000"; auto is that of training."""
    threads: Annotated[int | None, THREADS] = None
    """Processor threads (default: all)."""
    rasterizer: Annotated[str | Rasterizer, names("auto", "compiled", kind="rasterizer"), DRAWING] = "auto"
    """auto: compiled if `aaplug warmup` has run, else eager.  reference: slow, exact, float64."""
    memory: Annotated[float | None, number(0.01, 1024, metavar="GB"), DRAWING] = None
    """Memory for drawing a frame, beside scene and image (default: 1)."""
    cull_margin: Annotated[float, number(0, math.inf, metavar="SHARE"), CAMERAS] = math.inf
    """Leave out Gaussians centred outside the image by more than this share of its longer side, if training did."""


class RecipeOptions(ViewOptions):
    """Samples of a recipe, the rate it compares with, and the workers that draw."""

    quality: Annotated[str, names(*QUALITIES)] = "balanced"
    """How finely recipe auto samples: fast reaches a quarter of the training rate, balanced half, best all of it."""
    rate_reference: Annotated[str | None, names(*get_args(RateReference)), DRAWING] = None
    """Sampling rate that matched and auto compare with (default: pose: global, interval for free cameras)."""
    order: Annotated[SplatOrder, DRAWING] = "depth"
    """Order of splats: by depth of their centres, or per tile, by depth along its ray, so that colours pop less."""
    scheduler: Annotated[str | Executor | None, flag("local|tcp://HOST:PORT"), DRAWING] = None
    """Draw views on a Dask cluster: --threads processes of this machine, or the cluster at an address."""

    @property
    def choices(self) -> dict[str, str]:
        """The options that decide on images, as results tell them."""
        return {"quality": self.quality, "rate_reference": self.rate_reference or "pose", "order": self.order}


class ImageOptions(Options):
    """Images by one recipe at one size."""

    recipe: OneRecipe = "auto"
    """How to render; `aaplug recipes` lists them all."""
    scale: Annotated[float | None, SCALE] = None
    """Size relative to the training size (default: 1)."""
    resolution: Annotated[str | None, flag("WxH", parsed=partial(size_of, shape=(1, 1)))] = None
    """Size in px, such as 400x400; -1 on one side keeps the aspect (-1x720)."""
    overwrite: bool = False
    """Replace existing outputs."""
    format: Annotated[str | None, names(*IMAGE_FORMATS), FILES] = None
    """Format of image files (default: that of the output's name, or png)."""
    passes: Annotated[str | Sequence[str], names(*PASSES, metavar="rgb,depth,...", count=None), FILES] = ("rgb",)
    """Layers of image files: rgb, alpha, depth, depth-median, depth-nearest, normal, position, id, samples, bound."""
    normal_axes: Annotated[NormalAxes, FILES] = "camera"
    """Axes of normals: those of the world, or of the camera: right, up, towards the viewer."""
    transparent: Annotated[bool, FILES] = False
    """Store alpha and no background: straight in .png and .webp, premultiplied in .exr and .npz."""
    colour: Annotated[str | None, names(*COLOURS), FILES] = None
    """Values of colours: srgb, as a display takes them, or linear in light (default: srgb; .exr: linear)."""
    bit_depth: Annotated[Literal[8, 16, 32] | None, names(8, 16, 32), FILES] = None
    """Bits per channel (default: 8; .exr: 16, half precision, but 32 where a pass needs it; .npz: 32)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(self.resolution is None, "sets the size, as `resolution` does; give one", "scale")


class FilmOptions(RecipeOptions):
    """Aperture and shutter."""

    f_stop: Annotated[float | None, number(0.01, 1000), FILM] = None
    """Focal length over the aperture's diameter, such as 2.8; a smaller one defocuses more."""
    sensor: Annotated[float | None, number(1e-9, 1e9, metavar="WIDTH"), FILM] = None
    """Width of the sensor in scene units, which sets the focal length of --f-stop (default: 0.036)."""
    focus_distance: Annotated[float | None, number(1e-9, 1e9, metavar="DISTANCE"), FILM] = None
    """Depth of the plane that is sharp, in scene units from the camera."""
    focus_at: Annotated[Sequence[float] | None, _PLACE, FILM] = None
    """Instead, a place in that plane, X Y Z: the focus follows it along a path."""
    blades: Annotated[int | None, number(3, 64, whole=True), FILM] = None
    """Corners of the aperture (default: a disc)."""
    shutter: Annotated[float | None, number(0.001, 1), FILM] = None
    """Time that the shutter is open, as a share of the time between frames; 0.5 is usual in film."""
    samples: Annotated[int | None, number(0, 4096, whole=True, metavar="N"), FILM] = None
    """Frames averaged to one (default: 16, or 5 with --quality fast); 0 ignores a path file's aperture and shutter."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(self.focus_at is None, "sets the focus, as `focus_at` does; give one", "focus_distance")
        focused = self.focus_distance is not None or self.focus_at is not None
        self.need(focused, "is an aperture without focus; give `focus_distance` or `focus_at`", "f_stop")
        of_aperture = ("sensor", "focus_distance", "focus_at", "blades")
        self.need(self.f_stop is not None, "belongs to `f_stop`", *of_aperture)
        self.need(self.samples != 0, "is ignored by `samples` of 0; give one of the two", "f_stop", "shutter")


class LensOptions(Options):
    """The lens."""

    lens: Annotated[str | None, names("pinhole", "fisheye", "equisolid", "equirect", "vr180", "ortho"), LENS] = None
    """Draw through another lens (default: that of the camera); equirect is 360x180 degrees, vr180 a pair of eyes."""
    lens_angle: Annotated[float, number(1, 360, metavar="DEGREES"), LENS] = HALF_TURN
    """Angle that fisheye and equisolid show along the image's shorter side."""
    eye_distance: Annotated[float | None, number(0, MAX_COORDINATE, metavar="UNITS"), LENS] = None
    """Distance between the eyes of vr180, in the scene's units."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.eye_distance is None) == (self.lens == "vr180"):
            raise UsageError("eye_distance", "belongs to lens vr180, which needs it: about 0.064 m in scene units")
        has_angle = self.lens in ("fisheye", "equisolid")
        self.need(has_angle, "belongs to lenses fisheye and equisolid; name one as `lens`", "lens_angle")


class Orbit(Options):
    """Views on an orbit around the scene and, without cameras, the training that is assumed."""

    orbit: Annotated[int | None, number(1, 10_000, whole=True), ORBIT] = None
    """Number of views around the scene (default: 8, or 1 for a single picture)."""
    elevation: Annotated[float | None, number(-89, 89), ORBIT] = None
    """Degrees of the orbit above the horizon (default: 20)."""
    fov: Annotated[float, number(1, 170), ORBIT] = DEFAULT_FOV
    """Field of view in degrees, along the image's shorter side."""
    look_at: Annotated[Sequence[float] | None, _PLACE, ORBIT] = None
    """Place to look at, X Y Z (default: the middle of the scene)."""
    eye: Annotated[Sequence[float] | None, _PLACE, ORBIT] = None
    """Place to look from, X Y Z, instead of an orbit."""
    up: Annotated[Sequence[float] | None, _PLACE, ORBIT] = None
    """Direction that points up, X Y Z (default: 0 -1 0, or what file and colours say)."""
    train_view: Annotated[str | None, flag("WxH", parsed=size_of), ORBIT] = None
    """Assumed size in px of the training images, which show what the orbit shows (default: 1600x1066)."""
    train_rate: Annotated[float | None, number(1e-6, 1e9, metavar="RATE"), ORBIT] = None
    """Instead, training's px per world unit in the middle of the scene."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(self.train_rate is None, "sets the training rate, as `train_rate` does; give one", "train_view")
        self.need(self.eye is None, "moves the camera along an orbit, and `eye` is one place", "orbit", "elevation")
