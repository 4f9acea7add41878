"""The figures of examples/guides/methods.md on methods that papers name and aaplug has for comparison.

Parts: the time of every recipe; `eaa` beside `analytic`; energy above the Nyquist rate; `obbl` on pixel-aligned
Gaussians.
"""

import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.spherical_harmonics import SH_C0
from aaplug.evaluation.coverage import above_nyquist
from aaplug.evaluation.metric import Image
from aaplug.evaluation.truth import Truth, ViewTruth
from aaplug.lab.elliptical import Elliptical
from aaplug.lab.obbl import BoundedBandLimit
from aaplug.methods import RECIPES
from aaplug.methods.recipe import Recipe
from aaplug.rendering.renderer import Renderer
from tests.bench.scenes import Trained, decibels, trained

SCALES = (1 / 2, 1 / 4, 1 / 8)
ROUNDS = 5  # of timed renders
VIEWS = "r_0", "r_40", "r_80", "r_120", "r_160"  # of the chair, as in the tables of methods.md
CONTEXTS = 12  # views of the feed-forward network, about
LEAST_ALPHA = 0.9  # of a pixel that gets a Gaussian
SIGMAS = 0.05, 0.5  # px of a context view: standard deviations of pixel-aligned Gaussians
OPACITY = 0.95  # of pixel-aligned Gaussians
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


def photographs(opened: Trained, scales: Sequence[float] = SCALES) -> Truths:
    """The views of `VIEWS` with what they should show."""
    truth = Truth(opened.renderer("matched"), "photographs")
    made = [ViewTruth(truth, view) for view in opened.cameras.test if view.name in VIEWS]
    assert len(made) == len(VIEWS)
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
    times = dict[str, list[float]]()
    for turn in range(ROUNDS + 1):
        for name, renderer in renderers.items():
            started = time.perf_counter()
            renderer(view)
            if turn:  # the first loads kernels
                times.setdefault(name, []).append(1e3 * (time.perf_counter() - started))
    return {name: min(each) for name, each in times.items()}


def row(name: str, *figures: float | str) -> None:
    """Print a row."""
    cells = [f"{each:.2f}" if isinstance(each, float) else each for each in figures]
    print(f"| {name} | {' | '.join(cells)} |")


def times(chair: Trained) -> None:
    """Time of each recipe at 1/4 on the chair, over classic's; one thread."""
    renderers = {name: chair.renderer(recipe) for name, recipe in RECIPES.items() if not recipe.lacks(chair.scene)}
    found = milliseconds(renderers, chair.views()[0].scaled(1 / 4))
    for name, taken in found.items():
        row(name, taken / found["classic"], f"{RECIPES[name].time}")


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
                logit_opacities=torch.full_like(depths, OPACITY).logit(),
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


PARTS = {part.__name__: part for part in (times, eaa, nyquist, obbl)}
