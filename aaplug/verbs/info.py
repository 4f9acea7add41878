"""What a scene is."""

import math
from collections.abc import Iterator
from typing import Any

from aaplug.core.cameras import CameraSet
from aaplug.core.monitor import SILENT, Monitor
from aaplug.core.orbits import Frame
from aaplug.inspection.coverage import aliasing_begins
from aaplug.inspection.survey import Survey, check_frame_of, survey
from aaplug.io.scenes import open_scene
from aaplug.io.scenes.ply import Document
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.viewers import describe
from aaplug.options.objects import AnyPath
from aaplug.options.shared import FrameOptions
from aaplug.verbs.assumed import TRAINING_RATE, Orbit, probed, rate_of
from aaplug.verbs.inputs import CamerasLike, opened_and_seen

EXPONENTIATED = 20.0  # larger log-scales are taken for scales
FEW_STEPS = 1e4  # float32 steps across the scene's extent: with fewer, positions are coarse
SIZES = (3840, 1920, 1280, 640, 320)  # px: longer sides of pictures of the whole scene
NOWHERE = CameraSet((), (), assumed=True)  # of a file without a usable Gaussian
ULP = 2.0**-23  # of float32, relative


@FrameOptions.shown
def info(
    scene: SceneFile | AnyPath, cameras: CamerasLike = None, *, monitor: Monitor = SILENT, **options: Any
) -> dict[str, Any]:
    """Describe a scene's file: its convention and why, what is fused, what is odd.

    The file is read in parts, so it can be larger than memory.

    Args:
        scene: a scene's file, opened or not, or a model folder.
        cameras: training cameras, their file or folder, to tell also how finely they sample the scene.  None, or an
            `Orbit`: what can be told without, under its assumption.
        options: fields of `FrameOptions`.

    Returns:
        JSON-ready facts by name; "problems" lists what is odd, each with what to do.

    Raises:
        AaplugError: a file cannot be read, or the cameras see little of the scene.
    """
    o = FrameOptions.of(options)
    opened = scene if isinstance(scene, SceneFile) else open_scene(scene)
    around = Orbit() if cameras is None else cameras
    if isinstance(around, Orbit) and not len(probed(opened)):
        around = NOWHERE
    opened, known = opened_and_seen(opened, around, monitor)
    if not known.assumed:
        check_frame_of(opened, known.train, o.min_seen)
    with monitor.progress("reading", "Gaussians") as tell:
        found = survey(opened, known.train, tell)
    if isinstance(around, Orbit):
        sampling = _assumed_facts(found, known, around.frame(opened))
    else:
        sampling = _sampling_facts(found, known, opened.convention.kernel) if known.train else {}
    return _scene_facts(opened, found) | sampling | {"problems": list(_problems(opened, found))}


def _scene_facts(opened: SceneFile, found: Survey) -> dict[str, Any]:
    scale = found.scales.quantile(0.5)
    return {
        "file": str(opened.path),
        "format": opened.format,
        "bytes": opened.path.stat().st_size,
        "gaussians": opened.count,
        "unusable_gaussians": opened.count - found.count,
        "sh_degree": opened.sh_degree,
        "convention": opened.convention.name,
        "evidence": opened.evidence,
        "kernel_px2": opened.convention.kernel,
        "compensated": opened.convention.compensated,
        "two_dimensional": opened.flat,
        "stored_filter_3d": found.filtered,
        "fused": [{"method": f.method, **f.settings} for f in opened.fused],
        "fused_text": "; ".join(describe(f) for f in opened.fused) or "nothing",
        "notes": list(opened.notes),
        "comments": _comments(opened),
        "low_corner": found.low.tolist() if found.count else None,
        "high_corner": found.high.tolist() if found.count else None,
        "needle_share": found.needles / max(1, found.count),
        "median_opacity": found.opacities.quantile(0.5),
        "median_scale": None if scale is None else math.exp(scale),
    }


def _comments(opened: SceneFile) -> list[str]:
    return opened.document.header.comments if isinstance(opened.document, Document) else []


def _sampling_facts(found: Survey, cameras: CameraSet, kernel: float) -> dict[str, Any]:
    rate, multiple = found.rates.quantile(0.5), found.multiples.quantile(0.5)
    return {
        "training_cameras": len(cameras.train),
        "seen_share": found.seen / max(1, found.count),
        "median_rate_px_per_unit": None if rate is None else math.exp(rate),
        "under_sampling_bound_share": found.under / max(1, found.seen),
        "aliasing_begins_at_scale": None if multiple is None else aliasing_begins(math.exp(multiple), kernel),
        "cameras": list(cameras.notes),
    }


def _assumed_facts(found: Survey, cameras: CameraSet, frame: Frame) -> dict[str, Any]:
    """What can be told without cameras."""
    side = max(cameras.train[0].hw)
    shares = {size: found.multiples.share_below(math.log(side / size)) for size in SIZES}
    return {
        "training_rate": cameras.notes[0].removeprefix(TRAINING_RATE),
        "assumed_rate_px_per_unit": rate_of(cameras, frame),
        "centre": frame.centre.tolist(),
        "radius": frame.radius,
        "up": frame.up.tolist(),
        "surroundings_and_floaters_share": frame.outside,
        "below_a_pixel_share": {str(size): share for size, share in shares.items() if share is not None},
    }


def _problems(opened: SceneFile, found: Survey) -> Iterator[str]:
    """What is odd about the scene, each with what to do."""
    for text, number in found.faults.items():
        yield f"{number:,} Gaussians have {text}: --drop-bad leaves them out"
    if not opened.count:
        yield "the scene is empty: check that it is the right file"
    if not found.count:
        return
    if found.largest > EXPONENTIATED or found.above_zero == found.count:
        yield "scales look already exponentiated (they should be logarithms): export the scene again"
    elif found.activated == found.count:
        yield "opacities look already activated, all in [0, 1] (they should be logits): export the scene again"
    if found.filtered:
        yield "its filter_3D is not fused, and viewers ignore it: `aaplug convert` fuses it"
    if opened.flat:
        yield "2D Gaussians: recipe auto draws them as discs, as 2DGS does; they cannot be converted"
    farthest = max(found.low.abs().max().item(), found.high.abs().max().item())
    extent = (found.high - found.low).max().item()
    if 0 < extent < FEW_STEPS * ULP * farthest:
        yield f"lies {farthest:.3g} from the origin, where float32 is coarse: centre it before training"
    modes = [c for c in _comments(opened) if c.lower().startswith("splatrendermode")]
    if len({mode.lower() for mode in modes}) > 1:
        yield f"its comments contradict each other ({'; '.join(modes)}): the last one counts; --convention overrides it"
