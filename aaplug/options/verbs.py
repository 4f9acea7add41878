"""Options of each verb: first the classes that several share, then one for each."""

import math
import os
import re
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from aaplug.core.colours import Background
from aaplug.core.conventions import CONVENTIONS, MIN_SEEN_SHARE, SpzAxes
from aaplug.core.passes import PASSES, NormalAxes
from aaplug.io import MOST_FPS, StreamName
from aaplug.io.atomic import AnyPath
from aaplug.io.image_formats import COLOURS, IMAGE_FORMATS
from aaplug.methods import QUALITIES, RateReference, SplatOrder
from aaplug.options.base import PYTHON_ONLY, Group, Options, as_path, flag, names, number
from aaplug.system.contracts import LazyType
from aaplug.system.errors import MAX_VALUE_CHARACTERS, RESUME_OR_OVERWRITE, UsageError, listing
from aaplug.system.registry import names_of, spelt

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

CAMERAS = Group("camera", "How the camera files are read, and which of the scene's Gaussians they must see.")
ORBIT = Group("orbit", "Views on an orbit around the scene and, without cameras, the training that is assumed.")
LENS = Group("lens", "The lens to draw through, instead of that of the camera files.")
FILES = Group("file", "Contents and format of image files.")
DRAWING = Group("drawing", "How images are drawn: programs, memory and machines.")
FILM = Group("film", "Aperture and shutter, for defocus and motion blur.")
REPORT = Group("report", "Files beside the figures.")
TUNING = Group("tuning", "The optimization; its defaults were chosen by measurement.")

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

ALL = "all"  # instead of recipes' names: every recipe that the scene suits
COMPARED_SCALES = (2.0, 1.0, 0.5, 0.25)
METRICS = flag("|".join(map(spelt, names_of("metric"))) + " ...", count=None)
USUAL_METHOD = "consistency"  # of fine-tuning
LEVEL_STEPS = 1000  # for a level of 1/4 of the training rate and above; a smaller one takes more, of smaller images
SINGLE_FILE_FACTOR = 2  # times as many steps for one scene, whose count is met, and for a tree, which is for all sizes
LOSS_WEIGHTS = {0.5: 1.0, 0.25: 2.0, 0.125: 1.0}  # by scale; measured, as are the two below
ANCHOR_WEIGHT = 3.0  # of the loss at the training size, beside those of the scales
TUNED_PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "dc", "rest")
RECEDING_PATHS = ("zoom", "dolly")  # on which things become small
BUILT_IN_PATHS = (*RECEDING_PATHS, "orbit")
Source = Literal["auto", "self", "photographs"]  # of the truth
Layout = Literal["plain", "inria"]
MOST_FIRST_FRAME = 10**9
SHOWN_VIEWS = flag("N|NAME,...")

_PLACE = number(-MAX_COORDINATE, MAX_COORDINATE, several=True, metavar="X Y Z", length=3)

OneRecipe = Annotated[str | Recipe, names(kind="recipe", metavar=RECIPE_METAVAR)]
OneViewer = Annotated[str | Viewer | None, names(kind="viewer", metavar="VIEWER", also=("--for",))]
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


class ImageOptions(RecipeOptions):
    """Images by one recipe at one size, through an aperture, a shutter and a lens."""

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
    lens: Annotated[str | None, names("pinhole", "fisheye", "equisolid", "equirect", "vr180", "ortho"), LENS] = None
    """Draw through another lens (default: that of the camera); equirect is 360x180 degrees, vr180 a pair of eyes."""
    lens_angle: Annotated[float, number(1, 360, metavar="DEGREES"), LENS] = HALF_TURN
    """Angle that fisheye and equisolid show along the image's shorter side."""
    eye_distance: Annotated[float | None, number(0, MAX_COORDINATE, metavar="UNITS"), LENS] = None
    """Distance between the eyes of vr180, in the scene's units."""

    def _rules(self) -> None:
        self.need(self.resolution is None, "sets the size, as `resolution` does; give one", "scale")
        self.need(self.focus_at is None, "sets the focus, as `focus_at` does; give one", "focus_distance")
        focused = self.focus_distance is not None or self.focus_at is not None
        self.need(focused, "is an aperture without focus; give `focus_distance` or `focus_at`", "f_stop")
        of_aperture = ("sensor", "focus_distance", "focus_at", "blades")
        self.need(self.f_stop is not None, "belongs to `f_stop`", *of_aperture)
        self.need(self.samples != 0, "is ignored by `samples` of 0; give one of the two", "f_stop", "shutter")
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

    def _rules(self) -> None:
        self.need(self.train_rate is None, "sets the training rate, as `train_rate` does; give one", "train_view")
        self.need(self.eye is None, "moves the camera along an orbit, and `eye` is one place", "orbit", "elevation")


class WritingOptions(Options):
    """A scene file to write."""

    spz_axes: Annotated[SpzAxes, PYTHON_ONLY] = "auto"
    """Axes of a .spz to write; see `read_scene`."""
    overwrite: bool = False
    """Replace existing outputs."""


class RenderOptions(ImageOptions):
    """Rendering."""

    path: Annotated[AnyPath | None, flag("FILE", read=as_path)] = None
    """Instead of --views: the cameras of a path file; `aaplug guide film-camera` lists the kinds."""
    camera_to: Annotated[str | None, flag("VIEW"), FILM] = None
    """For one view: the view that the camera reaches while the shutter is open."""

    def _rules(self) -> None:
        self.need(self.path is None, "are replaced by `path`; give one of the two", "views")
        self.need(self.samples != 0, "opens a shutter, which `samples` of 0 ignores; give one of the two", "camera_to")


class VideoOptions(ImageOptions):
    """Rendering, and the camera path."""

    scale: Annotated[float | None, SCALE] = None
    """Size relative to the training size, or to that of a path file (default: 1)."""
    path: Annotated[AnyPath, flag("zoom|dolly|orbit|FILE", read=as_path)] = "zoom"
    """zoom (focal length), dolly (distance) or orbit from the first of --views, or a path file as of render."""
    beside: Annotated[str | Recipe | None, names("none", kind="recipe", metavar=f"none|{RECIPE_METAVAR}")] = "classic"
    """Recipe to show on the left of a video; none shows --recipe alone, as a frame sequence always does."""
    start: Annotated[float, SCALE] = 1.0
    """Sampling rate at the start of a zoom or dolly, relative to training."""
    end: Annotated[float, SCALE] = 0.125
    """Sampling rate, relative to training, where a zoom or dolly turns back."""
    seconds: Annotated[float, number(0.01, 3600)] = 6.0
    """Length in seconds of a zoom, dolly or orbit."""
    fps: Annotated[float | None, number(0.1, MOST_FPS)] = None
    """Frames per second (default: the path file's, or 30); frames that a path file lists play at this rate."""
    resume: Annotated[bool, FILES] = False
    """Continue an interrupted frame sequence; finished frames are not drawn again."""
    first_frame: Annotated[int, number(0, MOST_FIRST_FRAME, whole=True, metavar="N"), FILES] = 1
    """Number of a frame sequence's first frame, such as 1001."""

    def _rules(self) -> None:
        for paths, of_them in ((RECEDING_PATHS, ("start", "end")), (BUILT_IN_PATHS, ("seconds", "views"))):
            self.need(str(self.path) in paths, f"is for the paths {listing(paths)}, not for {self.path}", *of_them)
        self.need(not self.overwrite, RESUME_OR_OVERWRITE, "resume")
        is_right = str(self.path) != "zoom" or self.lens in ("pinhole", "ortho")
        self.need(
            is_right, f"{self.lens} sets its own angle, which zoom would change; give `path` dolly or orbit", "lens"
        )


class EvaluateOptions(RecipeOptions):
    """Recipes, scales, truth and metrics."""

    name: Annotated[str | None, PYTHON_ONLY] = None
    """The scene's name in the results; None for its file's."""
    protocol: OneProtocol = "default"
    """Scales, truth, downscaling and flavours of metrics, by name."""
    recipe: Annotated[
        str | Sequence[str | Recipe], names(ALL, kind="recipe", metavar=f"{ALL}|{RECIPE_METAVAR} ...", count=None)
    ] = ("classic", "mip", "matched", "auto")
    """One or more of `aaplug recipes`; all takes every one that the scene suits."""
    scale: Annotated[Sequence[float] | None, SCALES] = None
    """One or more sizes relative to the training size (default: the protocol's)."""
    truth: Source = "auto"
    """Compare with photographs, or with the scene's own supersampled look; auto leaves it to the protocol."""
    poses: Annotated[bool, REPORT] = False
    """Refine the poses of the views on their photographs first: what PSNR gains was the cameras' error."""
    metric: Annotated[str | Sequence[str] | None, METRICS] = None
    """Metrics, with flavours ssim:wang|3dgs, lpips:3dgs|vgg|alex (default: psnr ssim consistency energy-drift)."""
    lpips: Annotated[tuple[AnyPath, AnyPath] | None, flag("TRUNK HEADS", count=2, read=as_path), REPORT] = None
    """Weights of LPIPS, which is then measured: torchvision's VGG16 (AlexNet), and the lpips package's heads for it."""
    report: bool = False
    """Write report.html, one page with pictures side by side, tables and curves, and its plots."""
    show: Annotated[str, SHOWN_VIEWS, REPORT] = "3"
    """Views in the report's viewer: how many, or which."""
    layout: Annotated[Layout, REPORT] = "plain"
    """inria stores every render and its truth in test/METHOD/{renders,gt}, where other metric scripts look."""
    resume: bool = False
    """Continue an interrupted evaluation; finished views are not measured again."""
    overwrite: bool = False
    """Replace existing results."""

    def _rules(self) -> None:
        self.need(self.report, "selects views of the report; give `report`, too", "show")


class CompareOptions(RecipeOptions):
    """Sizes, metrics and how the scenes are shown."""

    recipe: OneRecipe = "auto"
    """How to draw every scene, each by the convention that it was trained with."""
    viewer: OneViewer = None
    """Draw the scenes as spark or another of `aaplug guide viewers` does; the truth stays the first by --recipe."""
    scale: Annotated[Sequence[float], SCALES] = COMPARED_SCALES
    """One or more sizes relative to the training size."""
    metric: Annotated[str | Sequence[str], METRICS] = ("psnr", "ssim", "flicker")
    """Metrics (default: psnr ssim flicker)."""
    show: Annotated[str, SHOWN_VIEWS, REPORT] = "3"
    """Views in the report's viewer: how many, or which."""
    any_frame: Annotated[bool, DRAWING] = False
    """Compare scenes that lie in different frames too."""
    resume: bool = False
    """Continue an interrupted comparison; finished views are not measured again."""
    overwrite: bool = False
    """Replace existing results."""

    def _rules(self) -> None:
        self.need(self.viewer is None, "is set by `viewer`; give one of the two", "recipe")


class ConvertOptions(WritingOptions, ViewOptions):
    """The filter to fuse, and how to measure the result."""

    views: Annotated[str, VIEWS] = "train"
    """Views that --for is measured on, by name or split."""
    viewer: OneViewer = None
    """Fit the scene to spark, playcanvas or another of `aaplug guide viewers`, and print the remaining error."""
    steps: Annotated[int | None, STEPS] = None
    """With --for: steps of the fit, 0 for none (default: 300, or 0 if the viewer draws as training did)."""
    form: Annotated[str | None, names("matched-energy", "mip-splatting")] = None
    """Without --for: keep training's energy (matched-energy, the default), or smooth as Mip-Splatting does."""
    variance: Annotated[float | None, number(0.001, 100)] = None
    """Without --for: variance to fuse, in px² at the training rate (default: 0.2)."""

    def _rules(self) -> None:
        self.need(self.viewer is None, "is set by `viewer`; give one of the two", "form", "variance")
        self.need(self.viewer is not None, "belongs to the fit to a viewer; name one with `viewer`", "steps")


IN_TIME = (RenderOptions, VideoOptions, EvaluateOptions, ConvertOptions)  # of the verbs that take a scene in time


class MergeOptions(WritingOptions, FrameOptions):
    """Where each scene goes, and by which rule the file is to be drawn."""

    into: Annotated[str | None, names(*CONVENTIONS)] = None
    """Convention to convert all scenes to (default: theirs if they agree, else mip)."""
    move: Annotated[Sequence[float] | None, number(-1e9, 1e9, several=True, metavar="X,Y,Z ...")] = None
    """For each scene: move in world units, after the turn; 0,0,0 for none."""
    turn: Annotated[Sequence[float] | None, number(-1e9, 1e9, several=True, metavar="X,Y,Z ...")] = None
    """For each scene: degrees about x, then y, then z (0,0,0: none); or for each a quaternion w,x,y,z."""
    scale: Annotated[Sequence[float] | None, number(1e-6, 1e6, several=True, metavar="FACTOR ...")] = None
    """For each scene: factor on its size, about the origin of its file; 1 for none."""


class LodOptions(WritingOptions, ViewOptions):
    """How light, and how to tune."""

    views: Annotated[str, VIEWS] = "train"
    """Views, with free cameras between them, that levels are tuned on and that tell which Gaussians are hidden."""

    simplify: Annotated[float | None, number(1e-6, 1e9, metavar="SHARE|COUNT")] = None
    """Write one scene with this share of the Gaussians or, above 1, this number of them."""
    budget: Annotated[float | None, number(0.001, 1e6, metavar="MB")] = None
    """Write one scene with as many Gaussians as fit into a .ply of this size (in 10^6 bytes)."""
    levels: Annotated[int | None, number(1, 12, whole=True)] = None
    """Write a folder of levels, each for half the size of the one before, as light as the image allows (default: 4)."""
    merge_below: Annotated[float, number(0, 10)] = 0.0
    """With levels: merge all Gaussians up to this many px of the level; faster to draw, and less exact."""
    scale: Annotated[float | None, number(0.001, 1)] = None
    """With --simplify or --budget: size of the images that the scene is meant for (default: root of the share)."""
    viewer: OneViewer = None
    """Tune each file for spark, playcanvas or another of `aaplug guide viewers`, instead of for aaplug."""
    to: Annotated[StreamName | None, names("sog", "3dtiles", "rad")] = None
    """With levels: stream them by sog (PlayCanvas), 3dtiles (CesiumJS) or rad (Spark), tuned for that viewer's rule."""
    page: Annotated[AnyPath | None, flag("NODE_MODULES", read=as_path)] = None
    """With --to: add a page that opens the result, and the viewer's program from this folder of npm packages."""
    refine: bool = True
    """Merge alone, without the tuning, which takes minutes."""
    steps: Annotated[int | None, STEPS] = None
    """Steps of tuning for each level, more for small ones (default: 1000, or 2000 for one scene or a .rad)."""
    resume: bool = False
    """Keep the levels that are there, if they were made of the same scene, cameras and options."""

    def _rules(self) -> None:
        given = [name for name in ("simplify", "budget", "levels") if getattr(self, name) is not None]
        if len(given) > 1:
            raise UsageError(given[1], f"cannot be combined with `{given[0]}`: each asks for other files")
        self.need(self.single, "belongs to `simplify` and `budget`", "scale")
        if self.simplify is not None and self.simplify > 1 and self.simplify % 1:
            raise UsageError("simplify", f"above 1 is a count: expected a whole number, got {self.simplify:g}")
        self.need(not self.single, "belongs to levels", "merge_below", "to")
        self.need(self.to is not None, "belongs to `to`", "page")
        resumable = not self.single and (self.viewer is None or self.to is not None)
        self.need(resumable, "belongs to levels for aaplug, and to `to`", "resume")
        self.need(self.tuning > 0, "is what the result is tuned for: leave out `refine`, and `steps` of 0", "viewer")
        self.need(self.refine, "are of tuning, which `refine` leaves out", "steps")

    @property
    def single(self) -> bool:
        """True if one file is asked for, not a folder."""
        return self.simplify is not None or self.budget is not None

    @property
    def tuning(self) -> int:
        """Steps of tuning for one file, or for a rate of 1/4 and above; 0 for none."""
        usual = SINGLE_FILE_FACTOR * LEVEL_STEPS if self.single or self.to == "rad" else LEVEL_STEPS
        return (usual if self.steps is None else self.steps) if self.refine else 0


class FinetuneOptions(WritingOptions, ViewOptions):
    """The optimization."""

    viewer: Annotated[str | Viewer | None, names("fast", kind="viewer", metavar="fast|VIEWER", also=("--for",))] = None
    """Viewer that will show the scene: fast (aaplug's matched, the default) or one of `aaplug guide viewers`."""
    views: Annotated[str, VIEWS] = "test"
    """Views to measure the result on, by name or split; it is tuned on training views."""
    method: Annotated[str, names(kind="method")] = USUAL_METHOD
    """consistency: one model for all scales; group-training: the same, 60 % at a time; mipmap-gs: one scale."""
    learn_filters: bool = False
    """Learn a filter for each Gaussian at 1/2 to 1/16 and --scale, for `--recipe learned`; the Gaussians stay."""
    scale: Annotated[Sequence[float], SCALES] = tuple(LOSS_WEIGHTS)
    """Sizes relative to the training size to tune for, beside the training size itself."""
    steps: Annotated[int | None, STEPS] = None
    """Number of steps (default: 1000)."""
    loss: Annotated[str, names(kind="loss"), TUNING] = "l2"
    """l2, or for comparison 3DGS's 0.8 L1 + 0.2 D-SSIM."""
    anchor: Annotated[float, number(0, 1_000_000, metavar="WEIGHT"), TUNING] = ANCHOR_WEIGHT
    """Weight of the training size in every step, against 2 for 1/4 and 1 for other scales."""
    move: Annotated[Sequence[str], names(*TUNED_PARAMETERS, count=None), TUNING] = TUNED_PARAMETERS
    """Parameters that move."""
    learning_rate: Annotated[float, number(1e-6, 100), TUNING] = 1.0
    """Factor on the method's learning rates."""
    truth: Source = "auto"
    """Images to match at the training size: self is the scene's own render; auto takes photographs if all exist."""
    poses: Annotated[bool, TUNING] = False
    """Refine the poses of all cameras on their photographs first, for cameras that are slightly off."""
    upsampler: Annotated[str | None, flag("bicubic|lanczos|FILE"), TUNING] = None
    """For scales above the photographs': an interpolation or a network (.onnx, .pt2, .pb); default: own render."""
    seed: Annotated[int, number(0, 2**31 - 1, whole=True, metavar="N"), TUNING] = 0
    """Seed of the views and scales that the steps draw."""
    checkpoint_every: Annotated[int, number(1, 1_000_000, whole=True, metavar="N"), TUNING] = 100
    """Steps between checkpoints."""
    resume: bool = False
    """Continue an interrupted run from its checkpoint."""

    def _rules(self) -> None:
        self.need(self.method == USUAL_METHOD, f"is a method of its own, beside {self.method}", "learn_filters")


class PoseOptions(ViewOptions):
    """Whose poses to refine."""

    views: Annotated[str, VIEWS] = "all"
    """Views with photographs, by name or split."""


class LiveOptions(ViewOptions):
    """The page, and how the scene is drawn."""

    host: Annotated[str, flag("ADDRESS")] = "127.0.0.1"
    """Address to listen on; any but this machine's own asks for the token in the printed address."""
    port: Annotated[int, number(0, 65_535, whole=True)] = 8080
    """Port to listen on; 0 takes any free one."""
    no_browser: bool = False
    """Print the address, and open no browser."""
    words: Annotated[Sequence[str], PYTHON_ONLY] = ()
    """Words of a command line that name the scene and its cameras, for the page to show."""


class ConformOptions(Options):
    """The expected pictures."""

    viewer: OneViewer = None
    """Viewer whose rule to expect, such as mip or spark: `aaplug guide viewers` (default: the one that fits best)."""
    overwrite: bool = False
    """Replace existing outputs."""


class BenchOptions(Options):
    """The scenes and sizes to time."""

    gaussians: Annotated[Sequence[int], number(1, 100_000_000, whole=True, several=True, metavar="N ...")] = (
        10_000,
        100_000,
        1_000_000,
    )
    """Sizes of the synthetic scenes."""
    resolution: Annotated[Sequence[str] | None, flag("WxH ...", parsed=size_of, count=None)] = None
    """Image sizes; only the middle scene takes all, others the first (default: the view's or 800x800 1600x1060)."""
    rasterizer: Literal["all", "compiled", "eager"] = "all"
    """Which to time; all: compiled, if `aaplug warmup` has run, and eager."""
    repeats: Annotated[int, number(1, 1000, whole=True)] = 5
    """Runs per median."""
    threads: Annotated[int | None, THREADS] = None
    """Processor threads (default: all)."""
