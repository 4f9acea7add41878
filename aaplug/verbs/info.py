"""Facts of a scene: its convention and why, what is fused, what is odd."""

import math
from typing import Any

from aaplug.core.cameras import CameraSet
from aaplug.core.training import TrainingViews
from aaplug.evaluation.coverage import above_nyquist, aliasing_begins, check_frame_of, problems, survey
from aaplug.evaluation.results import scale_name
from aaplug.io.scenes import SceneLike, scene_of
from aaplug.io.scenes.ply import Document
from aaplug.methods.conversion import described_fusions
from aaplug.options.verbs import FrameOptions, Orbit
from aaplug.rendering.assumed import PROBE_ROWS, TRAINING_RATE, frame_around, rate_of, up_evidence
from aaplug.rendering.job import CamerasLike, Job
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError
from aaplug.verbs.verb import looks

PICTURE_SIDES = (3840, 1920, 1280, 640, 320)  # px: longer sides of pictures of the whole scene
SPECTRUM_ROWS = 20  # Gaussians read at each place of the file, of which the splats' energy is taken
SPECTRUM_RECIPES, SPECTRUM_SCALES = ("classic", "matched", "auto"), (1.0, 1 / 2, 1 / 4, 1 / 8)


@looks(FrameOptions)
def info(scene: SceneLike | None, cameras: CamerasLike, options: FrameOptions) -> dict[str, Any]:
    """Describe a scene's file: its convention and why, what is fused, what is odd.

    The file is read in parts, so it can be larger than memory.

    Args:
        scene: see `render`.
        cameras: training cameras, their file or folder, to tell also how finely they sample the scene; None for
            its own.  Where it has none: what can be told without, under the assumption of an `Orbit`.

    Returns:
        JSON-ready facts by name; "problems" lists what is odd, each with what to do.

    Raises:
        AaplugError: a file cannot be read, or the cameras see little of the scene.
    """
    if scene is None:
        raise UsageError("scene", "name one")
    opened = scene_of(scene)
    orbit = (opened.cameras or Orbit()) if cameras is None else cameras
    if isinstance(orbit, Orbit) and not len(opened.sample(PROBE_ROWS)):
        orbit = CameraSet((), (), assumed=True)  # the file has no usable Gaussian
    job = Job.of(opened, orbit, options)
    opened, train = job.scene, job.cameras.train
    if not job.cameras.assumed:
        check_frame_of(opened, train, options.min_seen)
    with job.monitor.progress("reading", "Gaussians") as tell:
        statistics = survey(opened, train, tell)
    comments = opened.document.header.comments if isinstance(opened.document, Document) else []
    facts = {
        "file": opened.name,
        "format": opened.format,
        "bytes": opened.bytes,
        "gaussians": opened.count,
        "unusable_gaussians": opened.count - statistics.count,
        "sh_degree": opened.sh_degree,
        "convention": opened.convention.name,
        "evidence": opened.evidence,
        "kernel_px2": opened.convention.kernel,
        "compensated": opened.convention.compensated,
        "two_dimensional": opened.flat,
        "stored_filter_3d": statistics.filtered,
        "fused": [{"method": f.method, **f.settings} for f in opened.fused],
        "fused_text": described_fusions(opened.fused),
        "notes": list(opened.notes),
        "comments": comments,
        "low_corner": statistics.low.tolist() if statistics.count else None,
        "high_corner": statistics.high.tolist() if statistics.count else None,
        "needle_share": statistics.needles / max(1, statistics.count),
    }
    if isinstance(orbit, Orbit) and job.cameras.assumed:
        frame, side = frame_around(opened, orbit), max(train[0].hw)
        shares = {size: statistics.multiples.share_below(math.log(side / size)) for size in PICTURE_SIDES}
        facts |= {
            "training_rate": job.cameras.notes[0].removeprefix(TRAINING_RATE),
            "assumed_rate_px_per_unit": rate_of(job.cameras, frame),
            "centre": frame.centre.tolist(),
            "radius": frame.radius,
            "up": frame.up.tolist(),
            "up_evidence": up_evidence(opened, orbit, frame),
            "surroundings_and_floaters_share": frame.outside,
            "below_a_pixel_share": {str(size): share for size, share in shares.items() if share is not None},
        }
    elif train:
        rate, multiple = statistics.rates.quantile(0.5), statistics.multiples.quantile(0.5)
        kernel, some = opened.convention.kernel, opened.sample(SPECTRUM_ROWS)
        above = dict[str, dict[str, float | None]]()
        for name in SPECTRUM_RECIPES:
            renderer = Renderer.of(some, TrainingViews.of(some, train), name)
            shares = {f"at {scale_name(scale)}": above_nyquist(renderer, train, scale) for scale in SPECTRUM_SCALES}
            above |= {} if None in shares.values() else {name: shares}
        facts |= {
            "training_cameras": len(train),
            "seen_share": statistics.seen / max(1, statistics.count),
            "median_rate_px_per_unit": None if rate is None else math.exp(rate),
            "under_sampling_bound_share": statistics.under / max(1, statistics.seen),
            "aliasing_begins_at_scale": None if multiple is None else aliasing_begins(math.exp(multiple), kernel),
            "cameras": list(job.cameras.notes),
            "energy_above_nyquist_share": above,
        }
    return facts | {"problems": list(problems(opened, statistics))}
