"""Levels of detail, measured: python -m tests.bench.levels [SCENE ...], of those below, or cost.

For a scene it prints a pyramid, kept in a folder of the working directory, at sizes from 1/2 to 1/32, with and without
levels: PSNR in dB, SSIM and flicker against the scene's own look, PSNR against photographs, median milliseconds,
Gaussians projected and evaluations of a splat in a pixel.  Then it prints fades between two levels; a dolly, also as a
video; all levels in one scene by Multi-Scale 3DGS' rule; and lighter scenes beside splat-transform's `--decimate`.
For a scene of `MILLIONS`: what levels lose by the own look and what they save of the time, merged alone and tuned.
For cost: time against Gaussians and pixels on synthetic scenes.
"""

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Literal
from unittest.mock import patch

import torch

from aaplug.core.camera_paths import moved
from aaplug.core.cameras import Camera
from aaplug.core.gaussians import MIN_OPACITY, Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.pyramids import Pyramid, faded
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.protocols import median_depth
from aaplug.evaluation.results import Report, mean
from aaplug.evaluation.truth import Truth, ViewTruth, own_look
from aaplug.io.video import write_video
from aaplug.levels.pyramids import pyramid_of, read_pyramid
from aaplug.methods.recipes import find_recipe
from aaplug.rasterizers import find_rasterizer
from aaplug.rendering.benchmark import exponent, synthetic_camera
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.evaluate import evaluate
from aaplug.verbs.lod import lod
from tests.bench.away import decibels
from tests.bench.millions import MILLIONS, TRAINED, Opened, noise, trained

VIEWS = 5
SCALES = (1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 32)
BETWEEN = (0.24, 1 / 5, 1 / 6, 1 / 7, 0.11, 1 / 10, 0.07)  # sizes at which samples lie closer than half of training's
FADING = (0.5, 0.46, 0.44, 0.42, 0.4, 0.37)  # sizes from where level 1 is drawn alone to where level 2 is
LEVELS = 5
SHARES = {1 / 4: (1 / 4, 1 / 8), 1 / 16: (1 / 8,)}  # scales that lighter scenes are tuned for
RULES = ("matched", "classic")  # that lighter scenes are shown by
VIEWER = "classic"  # of other programs: by the second rule
DECIMATED = {  # at 1/2, 1/4 and 1/8 by each of these, with @playcanvas/splat-transform 3.7
    ("chair", 1 / 4): (31.85, 33.31, 33.28, 32.27, 28.40, 23.03),
    ("chair", 1 / 16): (27.27, 28.45, 30.08, 27.53, 28.45, 25.96),
    ("snowmiku", 1 / 4): (32.40, 32.88, 33.48, 32.39, 31.73, 28.62),
    ("snowmiku", 1 / 16): (25.93, 26.17, 26.68, 25.96, 26.24, 26.31),
}
COMPARED = ("psnr", "ssim", "flicker")
REPEATS = 5
OCTAVES, STEPS_EACH = 3, 20  # of the dolly, and frames in each octave
FPS = 20.0
COUNTS = (100_000, 1_000_000, 3_000_000)  # Gaussians of the synthetic scenes
SIZES = ((100, 75), (400, 300), (800, 600), (1600, 1200))
BELOW = 0.5  # px: levels of the synthetic scenes are merged to be fast


class Bench:
    """A scene, its look, and what test views should show."""

    def __init__(self, name: str, opened: Opened, rasterizer: Rasterizer):
        self.name = name
        self.scene, self.cameras, how = opened
        self.how = how
        self.training = TrainingViews.of(self.scene, self.cameras, how.cull_margin)
        self.look = own_look(self.scene, self.training, rasterizer, how.background)
        self.views = self.cameras.test[:: -(-len(self.cameras.test) // VIEWS)]
        self.own = [ViewTruth(Truth(self.look), view) for view in self.views]
        self.photographs = [ViewTruth(Truth(self.look, "photographs"), view) for view in self.views]

    def shown(self, scene: Gaussians | Pyramid, recipe: str, quality: str = "balanced") -> Renderer:
        """A renderer of a scene or of levels."""
        same = isinstance(scene, Pyramid)
        training = self.training if same else TrainingViews.of(scene, self.cameras, self.how.cull_margin)
        how = {"rasterizer": self.look.rasterizer, "background": self.look.background}
        return Renderer.of(scene, training, recipe, quality=quality, **how)

    def measured(self, scene: Gaussians | Pyramid, quality: str, truth: Literal["self", "photographs"]) -> Report:
        """Recipe auto at all sizes."""
        return evaluate(
            *(scene, self.cameras),
            **{"views": ",".join(view.name for view in self.views), "scale": SCALES, "recipe": "auto"},
            **{"quality": quality, "truth": truth, "metric": COMPARED if truth == "self" else ("psnr",)},
            **{"background": self.look.background, "cull_margin": self.how.cull_margin},
        )

    def built(self, folder: str, refine: bool = True) -> Pyramid:
        """Levels in a folder of the working directory; those that are there are kept."""
        how = {"cull_margin": self.how.cull_margin, "background": self.look.background, "refine": refine}
        started = time.perf_counter()
        lod(self.scene, self.cameras, folder, levels=LEVELS, resume=True, **how)
        print(f"\n{folder}: built or found in {time.perf_counter() - started:.0f} s")
        pyramid = read_pyramid(folder)
        print(f"levels: {', '.join(f'{size:,}' for size in pyramid.sizes)} Gaussians in {pyramid.count} chunks")
        return pyramid

    def drawn(self, shown: Renderer, scale: float) -> int:
        """Gaussians that a view at a scale projects."""
        fine, samples = shown.sampled(self.views[0].scaled(scale))
        return len(shown.scene) if shown.cutter is None else shown.cutter.count(fine, shown.coarsening(fine, samples))

    def light(self, share: float, scale: float, **options: object) -> Gaussians:
        """A lighter scene."""
        how = {"cull_margin": self.how.cull_margin, "background": self.look.background, **options}
        return lod(self.scene, self.cameras, simplify=share, scale=scale, **how)[0].scene


@torch.no_grad()
def psnr(shown: Renderer, truths: Sequence[ViewTruth], scale: float) -> float:
    """PSNR at a scale, mean of the views."""
    found = []
    for truth in truths:
        wanted = truth.compared(scale)
        assert wanted is not None
        found.append(decibels(shown(truth.view.scaled(scale)).rgb, wanted))
    return statistics.mean(found)


@torch.no_grad()
def milliseconds(*draws: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> list[float]:
    """Medians of several runs in turn, after one of each that does not count; clock: in seconds."""
    times: list[list[float]] = []
    for _ in range(1 + REPEATS):
        times.append([])
        for draw in draws:
            started = clock()
            draw()
            times[-1].append(1e3 * (clock() - started))
    return [statistics.median(own) for own in zip(*times[1:], strict=True)]


def row(*cells: object) -> None:
    """Print a row of a table."""
    print("| " + " | ".join(f"{c:.2f}" if isinstance(c, float) else str(c) for c in cells) + " |", flush=True)


def lighter(bench: Bench) -> None:
    """Lighter scenes, one sample per pixel."""
    sizes = [f"{rule} 1/{1 / scale:g}" for rule in RULES for scale in SCALES[:3]]
    print(f"\n{bench.name}\n\n| | Gaussians | {' | '.join(sizes)} |\n" + "|---" * 8 + "|")

    def shown(what: str, scene: Gaussians) -> None:
        found = [psnr(bench.shown(scene, rule), bench.own, scale) for rule in RULES for scale in SCALES[:3]]
        row(what, f"{len(scene):,}", *found)

    shown("the whole scene", bench.scene)
    for share, scales in SHARES.items():
        known = DECIMATED.get((bench.name, share))
        if known:
            row(f"`--decimate` {share:g}", "", *known)
        shown(f"`--simplify {share:g} --no-refine`", bench.light(share, share**0.5, refine=False))
        for scale in scales:
            shown(f"`--simplify {share:g} --scale {scale:g}`", bench.light(share, scale))
            shown(f"the same `--for {VIEWER}`", bench.light(share, scale, viewer=VIEWER))


@torch.no_grad()
def together(bench: Bench) -> None:
    """All levels in one scene by Multi-Scale 3DGS' rule, beside 3DGS."""
    (one,) = lod(bench.scene, bench.cameras, multi_scale=True, levels=LEVELS)
    print("\n| | " + " | ".join(f"1/{1 / scale:g}" for scale in (1.0, *SCALES)) + " |\n" + "|---" * 7 + "|")
    for recipe, scene in (("multi-scale", one.scene), ("classic", bench.scene)):
        shown = bench.shown(scene, recipe)
        row(f"`{recipe}`, PSNR", *(psnr(shown, bench.own, scale) for scale in (1.0, *SCALES)))
        row("splats", *(f"{len(shown.splats(bench.views[0].scaled(scale))):,}" for scale in (1.0, *SCALES)))


def levels(bench: Bench) -> Pyramid:
    """A pyramid against the scene."""
    pyramid = bench.built(f"{bench.name}-lod")
    print(
        "\n| | size | own look | SSIM | flicker | photographs | ms | Gaussians | evaluations, M |\n" + "|---" * 9 + "|"
    )
    for quality in ("fast", "balanced", "best"):
        for name, scene in (("levels", pyramid), ("the scene", bench.scene)):
            shown = bench.shown(scene, "auto", quality)
            own, photographs = (bench.measured(scene, quality, truth) for truth in ("self", "photographs"))
            for scale in SCALES:
                count = bench.drawn(shown, scale)
                views, real = own.select("auto", scale), mean(photographs.select("auto", scale), PSNR.name)
                took = round(1e3 * statistics.median(view.seconds for view in views))
                evaluations = statistics.mean(view.evaluations or 0 for view in views) / 1e6
                seen = [metric.text(mean(views, metric.name)) for metric in own.metrics]
                row(f"{name}, {quality}", f"1/{1 / scale:g}", *seen, real, took, f"{count:,}", evaluations)
    return pyramid


@torch.no_grad()
def fades(bench: Bench, pyramid: Pyramid) -> None:
    """Between levels 1 and 2, one sample per pixel, as levels fade and by optical depth."""
    print("\n| fade | " + " | ".join(f"{scale:g}" for scale in FADING) + " |\n" + "|---" * (1 + len(FADING)) + "|")
    shown = bench.shown(pyramid, "auto", "fast")
    for how, fade in (("energy", faded), ("optical depth", by_depth)):
        with patch("aaplug.rendering.renderer.faded", fade):
            row(how, *(psnr(shown, bench.own, scale) for scale in FADING))


def by_depth(splats: Splats2D, shares: torch.Tensor) -> Splats2D:
    """As `faded`, with a share of the optical depth at a splat's middle."""
    opacities = splats.opacities.clamp(max=1 - MIN_OPACITY)
    return replace(splats, opacities=-torch.expm1(shares * torch.log1p(-opacities)))


@torch.no_grad()
def million(bench: Bench) -> None:
    """Levels that are merged alone and tuned ones against a scene of so many Gaussians that these decide the time."""
    print(f"\n{bench.name}, {len(bench.scene):,} Gaussians\n")
    with torch.enable_grad():
        pyramids = {
            "merged": bench.built(f"{bench.name}-merged", refine=False),
            "tuned": bench.built(f"{bench.name}-lod"),
        }
    print(
        "\n| | size | own look | ms of processor | of the scene's | Gaussians in view | samples along a pixel |\n"
        + "|---" * 7
        + "|"
    )
    for quality in ("fast", "balanced"):
        shown = {"the scene": bench.shown(bench.scene, "auto", quality)}
        shown |= {f"levels, {how}": bench.shown(pyramid, "auto", quality) for how, pyramid in pyramids.items()}
        for scale in (*SCALES[1:], *BETWEEN):
            view = bench.views[0].scaled(scale)
            times = milliseconds(*(partial(renderer, view) for renderer in shown.values()), clock=time.process_time)
            for (name, renderer), took in zip(shown.items(), times, strict=True):
                cells = (
                    psnr(renderer, bench.own, scale),
                    round(took),
                    took / times[0],
                    f"{bench.drawn(renderer, scale):,}",
                )
                row(f"{name}, {quality}", f"1/{1 / scale:g}", *cells, renderer.samples(view))


@torch.no_grad()
def dolly(bench: Bench, pyramid: Pyramid) -> None:
    """Frame-to-frame changes of a view that moves away over three octaves, against those of the ceiling."""
    view = bench.views[0]
    depth = median_depth(bench.scene.means, view)
    frames = [moved(view, 2 ** (-step / STEPS_EACH), depth) for step in range(OCTAVES * STEPS_EACH + 1)]
    print("\n| dolly | change of a frame, median (RMS) | against the ceiling's at that frame, at most |\n|---|---|---|")
    shown = {
        "`best`, the ceiling": bench.shown(bench.scene, "auto", "best"),
        "levels, `balanced`": bench.shown(pyramid, "auto"),
        "levels, `fast`": bench.shown(pyramid, "auto", "fast"),
        "`matched`": bench.shown(bench.scene, "matched"),
    }
    ceiling: list[float] = []
    sides: list[list[torch.Tensor]] = []
    for name, renderer in shown.items():
        images = [renderer(frame).rgb.clamp(0, 1) for frame in frames]
        changes = [float((b - a).square().mean().sqrt()) for a, b in pairwise(images)]
        ceiling = ceiling or changes
        worst = max(own / best for own, best in zip(changes, ceiling, strict=True))
        row(name, f"{statistics.median(changes):.4f}", worst)
        sides = [*sides, [image.half() for image in images]][:2]
    together = (torch.cat(pair, dim=1).float() for pair in zip(*sides, strict=True))
    write_video(f"{bench.name}-dolly.webm", together, FPS, overwrite=True)


@torch.no_grad()
def cost(rasterizer: Rasterizer) -> None:
    """Time of a frame against Gaussians and pixels, by levels that are merged alone."""
    camera: Camera = synthetic_camera(TRAINED, TRAINED).as_trained()
    print("\n| Gaussians | levels | s | size | levels, ms | Gaussians projected | without, ms |\n" + "|---" * 7 + "|")
    by_size: dict[tuple[int, int], list[float]] = {}
    for count in COUNTS:
        scene, cameras, _ = noise(count)
        started = time.perf_counter()
        pyramid = pyramid_of(lod(scene, cameras, levels=LEVELS, refine=False, merge_below=BELOW))
        seconds = time.perf_counter() - started
        with_levels = Renderer.of(pyramid, cameras, "auto", quality="fast", rasterizer=rasterizer)
        without = Renderer.of(scene, cameras, find_recipe("matched"), rasterizer=rasterizer)
        for width, height in SIZES:
            view = replace(camera.resized(width, width), height=height)
            view = replace(view, cy=height / 2)
            took = milliseconds(partial(with_levels, view), partial(without, view))
            by_size.setdefault((width, height), []).append(took[0])
            assert with_levels.cutter is not None
            drawn, sizes = with_levels.cutter.count(view), ", ".join(f"{size:,}" for size in pyramid.sizes[1:])
            row(f"{count:,}", sizes, round(seconds), f"{width}x{height}", took[0], f"{drawn:,}", took[1])
    for size, times in by_size.items():
        if len(times) > 1:
            print(f"exponent of the Gaussians at {size[0]}x{size[1]}: {exponent(list(map(float, COUNTS)), times):.2f}")


def main(names: Sequence[str]) -> None:
    """Print the tables of these scenes."""
    rasterizer = find_rasterizer("auto", 1000, print)
    for name in names:
        if name == "cost":
            cost(rasterizer)
            continue
        bench = Bench(name, MILLIONS[name]() if name in MILLIONS else trained(name), rasterizer)
        if name in MILLIONS:
            million(bench)
            continue
        pyramid = levels(bench)
        fades(bench, pyramid)
        dolly(bench, pyramid)
        together(bench)
        lighter(bench)


if __name__ == "__main__":
    main(sys.argv[1:] or ("chair", "snowmiku", "million", "chair_million", "cost"))
