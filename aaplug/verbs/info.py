"""What a scene is."""

import math
from collections.abc import Iterator
from typing import Any

from aaplug.core.cameras import CameraSet
from aaplug.core.monitor import SILENT, Monitor
from aaplug.inspection.coverage import aliasing_begins
from aaplug.inspection.survey import Survey, check_frame_of, survey
from aaplug.io.scenes.ply import Document
from aaplug.io.scenes.scene_file import SceneFile
from aaplug.methods.viewers import describe
from aaplug.verbs.inputs import AnyPath, CamerasLike, cameras_of, opened_of
from aaplug.verbs.options import FrameOptions

EXPONENTIATED = 20.0  # larger log-scales are taken for scales
FEW_STEPS = 1e4  # float32 steps across the scene's extent: with fewer, positions are coarse
ULP = 2.0**-23  # of float32, relative


@FrameOptions.shown
def info(
    scene: SceneFile | AnyPath, cameras: CamerasLike = None, *, monitor: Monitor = SILENT, **options: Any
) -> dict[str, Any]:
    """Describe a scene's file: its convention and why, what is fused, what is odd.

    The file is read in parts, so it can be larger than memory.

    Args:
        scene: a scene's file, opened or not, or a model folder.
        cameras: training cameras, their file or folder, to tell also how finely they sample the scene.
        options: fields of `FrameOptions`.

    Returns:
        JSON-ready facts by name; "problems" lists what is odd, each with what to do.

    Raises:
        AaplugError: a file cannot be read, or the cameras see little of the scene.
    """
    o = FrameOptions.of(options)
    known = None if cameras is None else cameras_of(cameras, scene)
    train = () if known is None else known.train
    opened = opened_of(scene, known, monitor)
    if known is not None:
        check_frame_of(opened, train, o.min_seen)
    with monitor.progress("reading", "Gaussians") as tell:
        found = survey(opened, train, tell)
    sampling = {} if known is None else _sampling_facts(found, known, opened.convention.kernel)
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
