"""Levels of detail against the scene they were made of: quality, milliseconds, lighter scenes.

For a trained scene it makes a pyramid, kept in a folder of the working directory, and draws the sizes of its levels
with and without them: PSNR in dB, SSIM and flicker against the scene's own look, PSNR against photographs, median
milliseconds, Gaussians projected and evaluations of a splat in a pixel.  Then come all levels in one scene by
Multi-Scale 3DGS' rule, and lighter scenes beside splat-transform's `--decimate`.
"""

import statistics
import time
from collections.abc import Sequence
from typing import Any, Literal

import torch

from aaplug import Gaussians, Pyramid, Renderer, evaluate, lod
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.results import Report, mean
from aaplug.evaluation.truth import Truth, ViewTruth
from aaplug.io.scenes.pyramid_folder import read_pyramid
from aaplug.lab.multi_scale import in_one_scene
from tests.bench import heading, row
from tests.bench.scenes import Trained, decibels, trained

TEST_VIEWS = 5
LEVELS = 5  # of a pyramid, each for half the size of the one before
SHARES = {1 / 4: (1 / 4, 1 / 8), 1 / 16: (1 / 8,)}  # of the Gaussians, and the scales that lighter scenes are tuned for
RULES = ("matched", "classic")  # that lighter scenes are shown by
VIEWER = "classic"  # of other programs: by the second rule
DECIMATED = {  # at 1/2, 1/4 and 1/8 by each of these, with @playcanvas/splat-transform 3.7
    ("chair", 1 / 4): (31.85, 33.31, 33.28, 32.27, 28.40, 23.03),
    ("chair", 1 / 16): (27.27, 28.45, 30.08, 27.53, 28.45, 25.96),
    ("snowmiku", 1 / 4): (32.40, 32.88, 33.48, 32.39, 31.73, 28.62),
    ("snowmiku", 1 / 16): (25.93, 26.17, 26.68, 25.96, 26.24, 26.31),
}
METRICS = ("psnr", "ssim", "flicker")


def main(scenes: Sequence[str] = ("chair", "snowmiku"), count: int = LEVELS, refine: bool = True) -> None:
    """Print the tables of these scenes.

    Args:
        scenes: names of trained scenes.
        count: number of levels.  Any other than the usual prints the table of levels alone.
        refine: tune the levels.
    """
    for name in scenes:
        bench = Bench(name, trained(name), count)
        levels(bench, refine)
        if count == LEVELS:
            in_one(bench)
            lighter(bench)


class Bench:
    """A scene, its look, and what test views should show."""

    def __init__(self, name: str, opened: Trained, count: int = LEVELS):
        self.name, self.opened, self.count = name, opened, count
        self.scales = tuple(0.5**level for level in range(1, count + 1))
        self.scene, self.cameras, self.training = opened.scene, opened.cameras, opened.training
        self.options = {"cull_margin": opened.checkpoint.cull_margin, "background": opened.checkpoint.background}
        self.look = opened.renderer("matched")
        self.views = opened.views(TEST_VIEWS)
        self.own_looks = [ViewTruth(Truth(self.look), view) for view in self.views]

    def renderer(self, scene: Gaussians | Pyramid, recipe: str, quality: str = "balanced") -> Renderer:
        """A renderer of a scene or of levels."""
        cameras = self.training if isinstance(scene, Pyramid) else self.cameras
        return Renderer.of(scene, cameras, recipe, quality=quality, **self.options)

    def report(self, scene: Gaussians | Pyramid, quality: str, truth: Literal["self", "photographs"]) -> Report:
        """Recipe auto at all sizes."""
        views = ",".join(view.name for view in self.views)
        metrics = METRICS if truth == "self" else ("psnr",)
        options = {"views": views, "scale": self.scales, "recipe": "auto", "quality": quality, "truth": truth}
        return evaluate(scene, self.cameras, metric=metrics, **options, **self.options)

    def pyramid(self, folder: str, refine: bool = True) -> Pyramid:
        """Levels in a folder of the working directory; those that are there are kept."""
        started = time.perf_counter()
        lod(self.scene, self.cameras, folder, levels=self.count, resume=True, refine=refine, **self.options)
        print(f"\n{folder}: built or found in {time.perf_counter() - started:.0f} s")
        pyramid = read_pyramid(folder)
        print(f"levels: {', '.join(f'{size:,}' for size in pyramid.sizes)} Gaussians in {pyramid.count} chunks")
        return pyramid

    def projected(self, renderer: Renderer, scale: float) -> int:
        """Gaussians that a view at a scale projects."""
        fine, samples = renderer.sampled(self.views[0].scaled(scale))
        cutter = renderer.cutter
        return len(renderer.scene) if cutter is None else cutter.count(fine, renderer.coarsening(fine, samples))

    @torch.no_grad()
    def psnr(self, renderer: Renderer, scale: float) -> float:
        """PSNR by the own look at a scale, mean of the views."""
        truths = [(truth.view.scaled(scale), truth.compared(scale)) for truth in self.own_looks]
        return statistics.mean(decibels(renderer(view).rgb, wanted) for view, wanted in truths if wanted is not None)


def lighter(bench: Bench) -> None:
    """Lighter scenes, one sample per pixel."""
    cases = [(rule, scale) for rule in RULES for scale in bench.scales[:3]]
    heading(bench.name, "", "Gaussians", *(f"{rule} 1/{1 / scale:g}" for rule, scale in cases))

    def add(label: str, scene: Gaussians) -> None:
        row(label, f"{len(scene):,}", *(bench.psnr(bench.renderer(scene, rule), scale) for rule, scale in cases))

    def add_lighter(label: str, share: float, scale: float, **options: Any) -> None:
        options = {"simplify": share, "scale": scale, **bench.options, **options}
        add(label, lod(bench.scene, bench.cameras, **options)[0].scene)

    add("the whole scene", bench.scene)
    for share, scales in SHARES.items():
        if (bench.name, share) in DECIMATED:
            row(f"`--decimate` {share:g}", "", *DECIMATED[bench.name, share])
        add_lighter(f"`--simplify {share:g} --no-refine`", share, share**0.5, refine=False)
        for scale in scales:
            add_lighter(f"`--simplify {share:g} --scale {scale:g}`", share, scale)
            add_lighter(f"the same `--for {VIEWER}`", share, scale, viewer=VIEWER)


@torch.no_grad()
def in_one(bench: Bench) -> None:
    """All levels in one scene by Multi-Scale 3DGS' rule, beside 3DGS."""
    together = in_one_scene(bench.scene, bench.cameras.train, bench.count)
    scales = (1.0, *bench.scales)
    heading("all levels in one scene", "", *(f"1/{1 / scale:g}" for scale in scales))
    for recipe, scene in (("multi-scale", together), ("classic", bench.scene)):
        renderer = bench.renderer(scene, recipe)
        row(f"`{recipe}`, PSNR", *(bench.psnr(renderer, scale) for scale in scales))
        row("splats", *(f"{len(renderer.splats(bench.views[0].scaled(scale))):,}" for scale in scales))


def levels(bench: Bench, refine: bool = True) -> None:
    """A pyramid against the scene."""
    pyramid = bench.pyramid(f"{bench.name}-lod{bench.count}{'' if refine else '-merged'}", refine)
    columns = ("", "size", "own look", "SSIM", "flicker", "photographs", "ms", "Gaussians", "evaluations, M")
    heading(bench.name, *columns)
    for quality in ("fast", "balanced", "best"):
        for name, scene in (("levels", pyramid), ("the scene", bench.scene)):
            renderer = bench.renderer(scene, "auto", quality)
            own, photographs = (bench.report(scene, quality, truth) for truth in ("self", "photographs"))
            for scale in bench.scales:
                views, real = own.select("auto", scale), mean(photographs.select("auto", scale), PSNR.name)
                ms = round(1e3 * statistics.median(view.seconds for view in views))
                evaluations = statistics.mean(view.evaluations or 0 for view in views) / 1e6
                figures = [metric.text(mean(views, metric.name)) for metric in own.metrics]
                count = f"{bench.projected(renderer, scale):,}"
                row(f"{name}, {quality}", f"1/{1 / scale:g}", *figures, real, ms, count, evaluations)
