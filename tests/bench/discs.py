"""Discs by compiled and by eager kernels: milliseconds a frame, and the ratio; converted and merged, in PSNR.

The chair's Gaussians are drawn as discs across their thinnest axes.  Compiled kernels are those that
`aaplug warmup --recipe 2dgs 2dgs-matched aa-2dgs` builds, which this does first where they are missing.
"""

from dataclasses import replace
from functools import partial
from statistics import mean

import torch
from torch import Tensor

import aaplug
from aaplug import RASTERIZERS, Recipe, find_recipe, warmup
from aaplug.core.gaussians import MAX_LOG_SCALE, Gaussians
from aaplug.core.projection import quats_of, rotation_matrices
from aaplug.rasterizers.choice import find_rasterizer
from tests.bench import heading, row, timed
from tests.bench.scenes import decibels, trained

RECIPES = ("2dgs", "2dgs-matched", "aa-2dgs")
SCALES = (1.0, 1 / 4)
COMPARED_SCALES = (1.0, 1 / 2, 1 / 4, 1 / 8)


@torch.no_grad()
def main(rounds: int = 3, threads: int = 1) -> None:
    """Print the table: of so many rounds, in which both take turns, the fastest frame of each."""
    torch.set_num_threads(threads)
    warmup(RECIPES)
    opened = trained("chair")
    [view] = opened.views(1)
    heading(f"one view of the chair, {threads} thread", "recipe", "size", "eager, ms", "compiled, ms", "times as fast")
    for recipe in RECIPES:
        kinds = [opened.renderer(recipe, rasterizer=r) for r in (RASTERIZERS["eager"], find_rasterizer("compiled"))]
        for scale in SCALES:
            works = {renderer.rasterizer.name: partial(renderer, view.scaled(scale)) for renderer in kinds}
            eager, compiled = (1e3 * seconds for seconds in timed(works, rounds, min).values())
            row(f"`{recipe}`", f"1/{1 / scale:g}", round(eager), round(compiled), eager / compiled)
    views, discs = opened.views(2), as_discs(opened.scene)
    lighter = aaplug.lod(discs, opened.cameras, levels=3)
    solid = [level.scene for level in aaplug.lod(replace(discs, flat=False), opened.cameras, levels=3, refine=False)]
    smoothed = aaplug.convert(discs, opened.cameras, None).scene
    assert smoothed is not None

    def drawn(recipe: str | Recipe, scene: Gaussians) -> list[list[Tensor]]:
        renderer = replace(opened, scene=scene).renderer(recipe)
        return [[renderer(view.scaled(scale)).rgb.clamp(0, 1) for view in views] for scale in COMPARED_SCALES]

    def compare(name: str, recipe: str, scene: Gaussians) -> None:
        sizes = zip(drawn(recipe, scene), best, strict=True)
        row(name, f"`{recipe}`", len(scene), *(mean(map(decibels, images, truth)) for images, truth in sizes))

    best = drawn(replace(find_recipe("2dgs-matched"), target_rate=1.0), discs)
    columns = ("scene", "recipe", "Gaussians", *map(str, COMPARED_SCALES))
    heading("PSNR in dB against the discs' own look, supersampled", *columns)
    for recipe in ("auto", "2dgs"):
        compare("discs", recipe, discs)
        compare("smoothed within their planes", recipe, smoothed)
    for number, (level, other) in enumerate(zip(lighter[1:], solid[1:], strict=True), start=1):
        compare(f"level {number}, discs", "auto", level.scene)
        compare(f"level {number}, merged as 3D Gaussians", "auto", other)


def as_discs(scene: Gaussians) -> Gaussians:
    """2D Gaussians across the thinnest axes."""
    log_scales, order = scene.log_scales.sort(dim=1, descending=True)
    axes = rotation_matrices(scene.unit_quats).gather(2, order[:, None].expand(-1, 3, -1))
    quats = quats_of(axes * torch.linalg.det(axes)[:, None, None])
    flat = log_scales.index_fill(1, torch.tensor(2), -MAX_LOG_SCALE)
    return replace(scene, quats=quats, log_scales=flat, flat=True, origin=None)
