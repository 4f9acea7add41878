"""The figures of examples/guides/methods.md on methods that papers name and aaplug has for comparison.

Parts: the time of every recipe; `eaa` beside `analytic`; energy above the Nyquist rate; Group Training;
learned filters; separable sinc and anisotropic filters; `obbl` on pixel-aligned Gaussians.
"""

import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aaplug import RECIPES, SH_C0, Limits, Pixels, Recipe, Renderer, Rules, Splats2D, TrainingViews, finetune, grown
from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.gaussians import Gaussians, joined
from aaplug.evaluation.coverage import above_nyquist
from aaplug.evaluation.metric import Image
from aaplug.evaluation.truth import Truth, ViewTruth
from aaplug.lab.elliptical import Elliptical
from aaplug.lab.integral import HALF_U, HALF_V, Integral, principal_columns
from aaplug.lab.obbl import BoundedBandLimit
from aaplug.methods.pixel_kernels.raster_rows import OPACITY, forms_at
from tests.bench import row, timed
from tests.bench.scenes import Trained, decibels, trained

SCALES = (1 / 2, 1 / 4, 1 / 8)
SINC_RADIUS, SINC_NODES, SINC_VIEWS = 2.0, 12, 2  # px; frequencies of the quadrature; views, which are slow
WIDE = 1.2  # px: standard deviation of a Gaussian without frequencies above the Nyquist rate
GROUP_STEPS = {"chair": 600, "snowmiku": 300}  # of fine-tuning; multiples of the periods of Group Training's schedule
ROUNDS = 5  # of timed renders
VIEWS = "r_0", "r_40", "r_80", "r_120", "r_160"  # of the chair, as in the tables of methods.md
CONTEXTS = 12  # views of the feed-forward network, about
LEAST_ALPHA = 0.9  # of a pixel that gets a Gaussian
SIGMAS = 0.05, 0.5  # px of a context view: standard deviations of pixel-aligned Gaussians
OPAQUE = 0.95  # opacity of pixel-aligned Gaussians
BESIDE_OBBL = "classic", "matched", "auto", "mip", "mip-splatting", "mip-splatting-balanced", "obbl"
BOUNDS = 0.95, 0.6, 0.4, 0.2

Truths = Sequence[tuple[Camera, Mapping[float, Image]]]  # views with their photographs by scale


def main(parts: tuple[str, ...] = ()) -> None:
    """Print the figures of some parts; of all without a name."""
    torch.set_num_threads(1)
    chair = trained("chair")
    for name, part in PARTS.items():
        if not parts or name in parts:
            print(f"\n{name}: {(part.__doc__ or '').splitlines()[0]}")
            part(chair)


def photographs(opened: Trained, scales: Sequence[float] = SCALES, views: Sequence[Camera] = ()) -> Truths:
    """Views, by default those of `VIEWS`, with what they should show."""
    truth = Truth(opened.renderer("matched"), "photographs")
    views = views or [view for view in opened.cameras.test if view.name in VIEWS]
    made = [ViewTruth(truth, view) for view in views]
    assert made
    return [(each.view, {s: image for s in scales if (image := each.compared(s)) is not None}) for each in made]


@torch.no_grad()
def psnr(renderer: Renderer, truths: Truths) -> list[float]:
    """PSNR by scale, mean of the views."""
    return [
        statistics.mean(decibels(renderer(view.scaled(scale)).rgb, images[scale]) for view, images in truths)
        for scale in truths[0][1]
    ]


@torch.no_grad()
def milliseconds(renderers: Mapping[str, Renderer], view: Camera) -> dict[str, float]:
    """Least time of a view by each renderer, in turn."""
    works = {name: partial(renderer, view) for name, renderer in renderers.items()}
    return {name: 1e3 * seconds for name, seconds in timed(works, ROUNDS, min).items()}


def times(chair: Trained) -> None:
    """Time of each recipe at 1/4 on the chair, over classic's; one thread."""
    renderers = {name: chair.renderer(recipe) for name, recipe in RECIPES.items() if not recipe.lacks(chair.scene)}
    found = milliseconds(renderers, chair.views()[0].scaled(1 / 4))
    for name, taken in found.items():
        row(name, taken / found["classic"], f"{RECIPES[name].time or 1}")


def eaa(chair: Trained) -> None:
    """PSNR of eaa and its variants at 1/2, 1/4 and 1/8 on the chair, and ms at 1/4, beside analytic."""
    own, truths = RECIPES["eaa"], photographs(chair)
    kernels = {
        "eaa, beta 0": Elliptical(beta=0.0),
        "eaa, beta 8": Elliptical(beta=8.0),
        "eaa, not normalized": Elliptical(normalized=False),
        "eaa, not normalized, gamma 0": Elliptical(gamma=0.0, normalized=False),
    }
    recipes: dict[str, Recipe | str] = {"analytic": "analytic", "mip": "mip", "eaa": "eaa"}
    recipes |= {name: replace(own, pixel=kernel) for name, kernel in kernels.items()}
    renderers = {name: chair.renderer(recipe) for name, recipe in recipes.items()}
    taken = milliseconds({name: renderers[name] for name in ("analytic", "mip", "eaa")}, chair.views()[0].scaled(1 / 4))
    for name, renderer in renderers.items():
        row(name, *psnr(renderer, truths), f"{taken[name]:.0f}" if name in taken else "")


def nyquist(chair: Trained) -> None:
    """Energy above the Nyquist rate at 1, 1/2, 1/4 and 1/8 in percent, of the chair and the capture."""
    scenes = chair, trained("snowmiku")
    for name in ("classic", "ewa", "mip", "mip-splatting", "sa-gs", "matched", "auto"):
        shares = [
            above_nyquist(each.renderer(name), each.cameras.test, scale) for each in scenes for scale in (1.0, *SCALES)
        ]
        row(f"`{name}`", *(f"{100 * (share or 0):.1f}" for share in shares))


def groups(chair: Trained) -> None:
    """PSNR at 1, 1/2, 1/4 and 1/8 after fine-tuning, and processor seconds: plain and in groups."""
    for name, opened in {"chair": chair, "snowmiku": trained("snowmiku")}.items():
        views, steps = opened.views(5), GROUP_STEPS[name]
        truths = photographs(opened, (1.0, *SCALES), views)
        row(f"{name}, not tuned", *psnr(opened.renderer("matched"), truths))
        for method in ("consistency", "group-training"):
            started = time.process_time()
            tuned = finetune(opened.scene, opened.cameras, None, method=method, steps=steps, **options_of(opened))
            figures = psnr(replace(opened, scene=tuned.scene).renderer("matched"), truths)
            row(f"{name}, {steps} steps, {method}", *figures, f"{time.process_time() - started:.0f}")


def options_of(opened: Trained) -> dict[str, Any]:
    """Options of fine-tuning a scene, measured on one view only."""
    about = opened.checkpoint
    return {"cull_margin": about.cull_margin, "background": about.background, "views": opened.views(5)[0].name}


def learned(chair: Trained) -> None:
    """PSNR from 1 to 1/16 by photographs, then by the own look, of learned filters and what they stand beside.

    Then the seconds of learning, of one processor, and ms at 1/8 by one sample.
    """
    scales = (1.0, *SCALES, 1 / 16)
    for name, opened in {"chair": chair, "snowmiku": trained("snowmiku")}.items():
        look, views = Truth(opened.renderer("matched")), opened.views(5)
        by_photographs = photographs(opened, scales, views)
        truths = by_photographs, [(view, {s: look(view, s) for s in scales}) for view in views]
        renderers = {"matched": opened.renderer("matched")}
        renderers |= {f"auto, {quality}": opened.renderer(quality=quality) for quality in ("fast", "balanced")}
        seconds = dict[str, float]()
        for truth in ("photographs", "self"):
            started = time.process_time()
            tuned = finetune(opened.scene, opened.cameras, None, learn_filters=True, truth=truth, **options_of(opened))
            seconds[f"learned, {truth}"] = time.process_time() - started
            renderers[f"learned, {truth}"] = replace(opened, scene=tuned.scene).renderer("learned")
        taken = milliseconds(renderers, views[0].scaled(1 / 8))
        for each, renderer in renderers.items():
            figures = [figure for truth in truths for figure in psnr(renderer, truth)]
            row(f"{name}: {each}", *figures, f"{seconds.get(each, 0):.0f}", f"{taken[each]:.0f}")


@dataclass(frozen=True)
class Sinc(Integral):
    """The Gaussian cut off at the Nyquist rate of the pixels, along the splat's axes: a separable sinc as pixel filter.

    Along an axis of standard deviation σ it is σ √(2π) / π ∫ e^(-σ²ω²/2) cos(ωx) dω from 0 to π, which is negative in
    places.

    clamped: negative alpha is not drawn, as by 3DGS's cut-off; else it is composited, and adds to the light behind it.
    """

    name: str = "sinc"
    clamped: bool = True

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D:
        """Ellipses that reach `SINC_RADIUS` px beyond."""
        return grown(splats, torch.full_like(splats.dets, SINC_RADIUS), rules.min_alpha)

    def alpha(self, rows: Tensor, pixels: Pixels, limits: Limits) -> Tensor:
        """Opacity times both cut Gaussians."""
        alpha = rows[..., OPACITY, None]
        for form, half in zip(forms_at(rows, pixels), (HALF_U, HALF_V), strict=True):
            sigma = 0.5 / rows[..., half, None].clamp(min=1e-6)
            alpha = alpha * band_limited(form * sigma, sigma)
        return limits.cut(alpha) if self.clamped else torch.where(alpha.abs() > limits.below_min_alpha, alpha, 0.0)


def band_limited(x: Tensor, sigma: Tensor, nodes: int = SINC_NODES) -> Tensor:
    """exp(-x²/2σ²) without its frequencies above π, by Gauss-Legendre quadrature; x and sigma in px.

    A Gaussian wider than `WIDE` px has none, to 0.1 %.
    """
    total = torch.zeros_like(x * sigma)
    for node, weight in zip(*np.polynomial.legendre.leggauss(nodes), strict=True):
        omega = math.pi / 2 * (node + 1)
        total = total + math.pi / 2 * weight * (-0.5 * (sigma * omega).square()).exp() * (omega * x).cos()
    return torch.where(sigma > WIDE, (-0.5 * (x / sigma).square()).exp(), sigma * (2 / math.pi) ** 0.5 * total)


@dataclass(frozen=True)
class Floored:
    """Widen by a Gaussian along those axes of a splat alone whose variance is below `variance` px², and keep energy."""

    variance: float

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
        added = torch.zeros_like(splats.covs)
        for x, y in ((ux, uy), (vx, vy)):
            square = x * x + y * y  # 1 / variance along the axis
            more = (self.variance - 1 / square).clamp(min=0.0) / square
            added = added + more[:, None] * torch.stack([x * x, x * y, y * y], dim=1)
        return splats.convolved(added, compensate=True)


def sinc(chair: Trained) -> None:
    """Lobes of a band-limited splat by its width, and PSNR of separable and anisotropic filters at 1/2, 1/4 and 1/8."""
    at = torch.arange(-300, 301, dtype=torch.float64) / 100
    for sigma in (0.1, 0.3, 0.5, 0.7, 1.0):
        lobes = band_limited(at, torch.tensor(sigma, dtype=torch.float64), 8 * SINC_NODES)
        light, lost = lobes.sum(), -lobes.clamp(max=0.0).sum()
        row(f"σ = {sigma:g} px", max(0.0, float(-100 * lobes.min() / lobes.max())), abs(float(100 * lost / light)))
    truths = photographs(chair)[:SINC_VIEWS]
    analytic, mip = RECIPES["analytic"], RECIPES["mip"]
    recipes = {
        "mean over the square (analytic)": analytic,
        "sinc, negative alpha not drawn": replace(analytic, pixel=Sinc()),
        "sinc, negative alpha composited": replace(analytic, pixel=Sinc(clamped=False)),
        "Gaussian, 0.1 px² (mip)": mip,
        "Gaussian along thin axes alone, up to 0.1 px²": replace(mip, screen=Floored(0.1)),
        "the same, up to 0.2 px²": replace(mip, screen=Floored(0.2)),
    }
    for name, recipe in recipes.items():
        row(name, *psnr(chair.renderer(recipe, rasterizer="eager" if "sinc" in name else "auto"), truths))


def pixel_aligned(opened: Trained, views: Sequence[Camera]) -> Trained:
    """A scene as a feed-forward network makes it: one Gaussian for each pixel of each view, from our depth pass.

    Each lies where the pixel's ray meets the surface, has the pixel's colour, an opacity of 0.95 and no harmonics.  Its
    standard deviations are drawn log-uniformly from `SIGMAS` px of its view, about the range that such networks
    predict, with random axes: many are degenerate, far below what the view resolves.
    """
    g, parts = torch.Generator().manual_seed(1), []
    renderer = opened.renderer("auto")
    for view in views:
        seen = renderer.passes(view, ("rgb", "alpha", "position", "depth"))
        at = seen["alpha"] > LEAST_ALPHA
        depths, alpha = seen["depth"][at].flatten(), seen["alpha"][at][:, None]
        colours = (seen["rgb"][at] - (1 - alpha) * torch.tensor(opened.checkpoint.background)) / alpha
        low, high = (math.log(sigma) for sigma in SIGMAS)
        drawn = low + (high - low) * torch.rand(len(depths), 3, generator=g)
        parts.append(
            Gaussians(
                means=seen["position"][at],
                quats=torch.randn(len(depths), 4, generator=g),
                log_scales=drawn + (depths / view.focal).log()[:, None],
                logit_opacities=torch.full_like(depths, OPAQUE).logit(),
                sh=((colours - 0.5) / SH_C0)[:, None],
            )
        )
    return Trained(joined(parts), CameraSet(tuple(views), tuple(views)), opened.checkpoint)


def obbl(chair: Trained) -> None:
    """PSNR of obbl and others at 1/4, 1 and 4 on pixel-aligned Gaussians, and ms at 4."""
    contexts = [
        view.scaled(1 / 4).as_trained() for view in chair.cameras.train[:: len(chair.cameras.train) // CONTEXTS]
    ]
    scene = pixel_aligned(chair, contexts)
    sizes = {1 / 16: 1 / 4, 1 / 4: 1, 1: 4}
    truths = [
        (view.scaled(1 / 4).as_trained(), {sizes[s]: image for s, image in images.items()})
        for view, images in photographs(chair, tuple(sizes))
    ]
    own = RECIPES["obbl"]
    recipes: dict[str, Recipe | str] = {name: name for name in BESIDE_OBBL}
    for bound in BOUNDS:
        world = BoundedBandLimit(bound)
        recipes[f"obbl, opacities at most {bound:g}"] = replace(own, world=world)
        recipes[f"opacities at most {bound:g}, colours not renormalized"] = replace(own, world=world, compositor=None)
    print(f"{len(scene.scene):,} Gaussians of {len(contexts)} views")
    renderers = {name: scene.renderer(recipe) for name, recipe in recipes.items()}
    taken = milliseconds({name: renderers[name] for name in BESIDE_OBBL}, truths[0][0].scaled(4))
    for name, renderer in renderers.items():
        row(name, *psnr(renderer, truths), f"{taken[name]:.0f}" if name in taken else "")


PARTS = {part.__name__: part for part in (times, eaa, nyquist, groups, learned, sinc, obbl)}
