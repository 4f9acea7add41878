"""Options of each verb."""

from collections.abc import Sequence
from typing import Annotated, Literal

from aaplug.core.conventions import CONVENTIONS, SpzAxes
from aaplug.io import MOST_FPS, StreamName
from aaplug.io.atomic import AnyPath
from aaplug.options.base import DRAWING, FILES, FILM, PYTHON_ONLY, REPORT, TUNING, Options, as_path, flag, names, number
from aaplug.options.shared import (
    RECIPE_METAVAR,
    SCALE,
    SCALES,
    STEPS,
    THREADS,
    VIEWS,
    FilmOptions,
    FrameOptions,
    ImageOptions,
    LensOptions,
    OneProtocol,
    OneRecipe,
    OneViewer,
    Recipe,
    RecipeOptions,
    Viewer,
    ViewOptions,
    size_of,
)
from aaplug.system.errors import UsageError, listing
from aaplug.system.registry import names_of, spelt

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


class WritingOptions(Options):
    """A scene file to write."""

    spz_axes: Annotated[SpzAxes, PYTHON_ONLY] = "auto"
    """Axes of a .spz to write; see `read_scene`."""
    overwrite: bool = False
    """Replace existing outputs."""


class RenderOptions(FilmOptions, ImageOptions, LensOptions):
    """Rendering."""

    path: Annotated[AnyPath | None, flag("FILE", read=as_path)] = None
    """Instead of --views: the cameras of a path file; `aaplug guide film-camera` lists the kinds."""
    camera_to: Annotated[str | None, flag("VIEW"), FILM] = None
    """For one view: the view that the camera reaches while the shutter is open."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need(self.path is None, "are replaced by `path`; give one of the two", "views")
        self.need(self.samples != 0, "opens a shutter, which `samples` of 0 ignores; give one of the two", "camera_to")


class VideoOptions(FilmOptions, ImageOptions, LensOptions):
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

    def __post_init__(self) -> None:
        super().__post_init__()
        for paths, of_them in ((RECEDING_PATHS, ("start", "end")), (BUILT_IN_PATHS, ("seconds", "views"))):
            self.need(str(self.path) in paths, f"is for the paths {listing(paths)}, not for {self.path}", *of_them)
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

    def __post_init__(self) -> None:
        super().__post_init__()
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

    def __post_init__(self) -> None:
        super().__post_init__()
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

    def __post_init__(self) -> None:
        super().__post_init__()
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

    def __post_init__(self) -> None:
        super().__post_init__()
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

    viewer: Annotated[str | Viewer | None, names("fast", kind="viewer", metavar="fast|VIEWER", flags=("--for",))] = None
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

    def __post_init__(self) -> None:
        super().__post_init__()
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
