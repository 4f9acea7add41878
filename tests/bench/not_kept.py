"""Ways to filter that were tried and not kept: python -m tests.bench.not_kept [SCENE ...], of the names in VIEWS.

Pixel filters other than the box, which weigh a pixel's samples and its neighbours'; an upper bound on opacities; and
colours renormalized by what hides the background.  The first two columns compare with photographs, as downscaled by
"box" (the usual) and "pil-bicubic" (3DGS's -r), the third with the scene's own look.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import mean, median

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.choices import QUALITIES
from aaplug.core.imaging import over, quantised
from aaplug.core.interfaces import Colour, Rasterizer, ScreenFilter
from aaplug.core.splats import Render, Splats2D
from aaplug.core.training import TrainingViews
from aaplug.evaluation.metric import SHIFT_STEPS
from aaplug.evaluation.metrics import flicker, psnr, ssim
from aaplug.evaluation.protocols import PROTOCOLS
from aaplug.evaluation.results import scale_name
from aaplug.evaluation.truth import Truth, ViewTruth, own_look
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import find_recipe
from aaplug.rendering.renderer import Renderer
from tests.bench.away import Scene, on_each
from tests.conftest import SHARED_DATA

SMALLER, LARGER = (1.0, 0.5, 0.25, 0.125), (1.0, 2.0, 4.0)
VIEWS = {"chair": 5, "chair_eighth": 5, "snowmiku": 4, "snowmiku_quarter": 4}

FAINTEST = 1e-6  # alpha below which nothing is divided by it
DEFAULT = PROTOCOLS["default"]

Image = Float[Tensor, "h w 3"]
Figures = dict[str, float | None]


@dataclass(frozen=True)
class Samples:
    """A supersampled image.

    n: samples along a pixel's side.  rate: the view's, relative to training.  seconds: that drawing took.
    """

    render: Render
    n: int
    background: Colour
    rate: float
    seconds: float


Finish = Callable[[Samples], Image]


@dataclass(frozen=True)
class PixelFilter:
    """A separable weight of samples by their distance from the pixel's centre, in px; 0 beyond the radius."""

    weight: Callable[[Tensor], Tensor]
    radius: float

    def __call__(self, samples: Samples) -> Image:
        """Weighted means of each pixel's samples and of its neighbours'."""
        return self._along(self._along(samples.render.rgb, 0, samples.n), 1, samples.n)

    def _along(self, image: Tensor, dim: int, n: int) -> Tensor:
        """Along the height (0) or the width (1); edges are repeated."""
        reach = math.ceil(self.radius * n)
        places = torch.arange(-reach, n + reach)
        weights = self.weight(((places + 0.5) / n - 0.5).abs())
        weights = weights / weights.sum()
        side = image.shape[dim]
        padded = image.index_select(dim, torch.arange(-reach, side + reach).clamp(0, side - 1))
        windows = padded.unfold(dim, len(places), n)
        return windows @ weights


def cubic(b: float, c: float) -> Callable[[Tensor], Tensor]:
    """Piecewise cubics (Mitchell and Netravali 1988, eq. 8)."""

    def weight(x: Tensor) -> Tensor:
        near = (12 - 9 * b - 6 * c) * x**3 + (-18 + 12 * b + 6 * c) * x**2 + (6 - 2 * b)
        far = (-b - 6 * c) * x**3 + (6 * b + 30 * c) * x**2 + (-12 * b - 48 * c) * x + (8 * b + 24 * c)
        return torch.where(x < 1, near, torch.where(x < 2, far, 0.0)) / 6

    return weight


def lanczos(lobes: int) -> PixelFilter:
    """sinc(x) sinc(x / lobes) (Duchon 1979)."""
    return PixelFilter(lambda x: torch.sinc(x) * torch.sinc(x / lobes) * (x < lobes), lobes)


def gaussian(sigma: float) -> PixelFilter:
    """A Gaussian of that standard deviation in px, up to 3 of them."""
    return PixelFilter(lambda x: torch.exp(-0.5 * (x / sigma) ** 2) * (x < 3 * sigma), 3 * sigma)


BOX = PixelFilter(lambda x: (x < 0.5).float(), 0.5)
PIXEL_FILTERS: dict[str, PixelFilter] = {
    "box": BOX,
    "tent, 2 px wide": PixelFilter(lambda x: (1 - x).clamp(min=0), 1),
    "Gaussian, σ 0.35 px": gaussian(0.35),
    "Gaussian, σ 0.5 px": gaussian(0.5),
    "Mitchell": PixelFilter(cubic(1 / 3, 1 / 3), 2),
    "Catmull-Rom": PixelFilter(cubic(0, 0.5), 2),
    "Lanczos 3": lanczos(3),
}


@dataclass(frozen=True)
class Bounded:
    """A screen filter whose opacities are at most `most`."""

    screen: ScreenFilter
    most: float

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of one view."""
        filtered = self.screen(splats, camera, training)
        return replace(filtered, opacities=filtered.opacities.clamp(max=self.most))


@dataclass(frozen=True)
class Renormalized:
    """Divides a pixel's colour by its alpha A, and composites it with 1 - (1 - A)^p instead.

    p grows from 1 at the training rate to `power` at a rate of 0; an infinite one hides the background wholly where
    more than half of it is hidden, at any rate.
    """

    power: float = math.inf

    def __call__(self, samples: Samples) -> Image:
        """Renormalize each sample, then average them."""
        rgb, alpha = samples.render
        light = rgb - (1 - alpha)[..., None] * rgb.new_tensor(samples.background)
        hidden = self._hidden(1 - alpha, samples.rate)
        gain = hidden / alpha.clamp(min=FAINTEST)
        whole = over(light * gain[..., None], hidden, samples.background)
        return BOX(replace(samples, render=whole))

    def _hidden(self, clear: Tensor, rate: float) -> Tensor:
        if math.isinf(self.power):
            return torch.where(clear < 0.5, 1.0, 1 - clear)
        return 1 - clear ** (1 + (self.power - 1) * max(0.0, 1 - rate**2))


@dataclass(frozen=True)
class Tried:
    """A recipe, and what makes pixels of its samples."""

    recipe: Recipe
    finish: Finish = BOX


Ways = dict[str, Tried]


def bounded(recipe: Recipe, most: float) -> Recipe:
    """The recipe with bounded opacities."""
    return replace(recipe, screen=Bounded(recipe.screen, most))


def colours() -> Ways:
    """Bounded opacities and renormalized colours, with one sample per pixel."""
    tried = {}
    for name in ("matched", "mip-splatting-balanced"):
        recipe, label = find_recipe(name), f"`{name}`"
        tried[label] = Tried(recipe)
        tried |= {f"{label}, opacity at most {most:g}": Tried(bounded(recipe, most)) for most in (0.95, 0.8, 0.6)}
        tried[f"{label}, colour over alpha"] = Tried(recipe, Renormalized())
        tried[f"{label}, opacity at most 0.8, colour over alpha"] = Tried(bounded(recipe, 0.8), Renormalized())
    for power in (0.7, 0.85, 1.2, 1.5):
        tried[f"`matched`, clear share to the power {power:g}"] = Tried(find_recipe("matched"), Renormalized(power))
    return tried


def pixel_filters(scales: Sequence[float]) -> Ways:
    """Every pixel filter with the samples of each quality; above the training size with one and four samples."""
    if max(scales) > 1:
        recipes = {f"{n * n} samples": replace(find_recipe("matched"), grid=n) for n in (1, 2)}
    else:
        plain = replace(find_recipe("auto"), neighbours=0.0)
        recipes = {f"`{quality}`": replace(plain, target_rate=rate) for quality, rate in QUALITIES.items()}
    return {f"{label}, {f}": Tried(r, how) for label, r in recipes.items() for f, how in PIXEL_FILTERS.items()}


def main(names: Sequence[str]) -> None:
    on_each(names or VIEWS, measure)


def measure(name: str, how: Scene, rasterizer: Rasterizer) -> None:
    """Print a scene's tables."""
    cameras = read_cameras((SHARED_DATA / how.file).parent, train_scale=how.scale)
    scene = read_scene(SHARED_DATA / how.file)
    training = TrainingViews.of(scene, cameras, how.cull_margin)
    look = own_look(scene, training, rasterizer, how.background)
    scales = SMALLER if how.finer is None else LARGER
    views = cameras.test[:: -(-len(cameras.test) // VIEWS[name])]
    tables = [colours()] if how.finer is None else []
    for tried in (*tables, pixel_filters(scales)):
        rows = list(measured(look, tried, views, scales))
        print(f"\n{name}, at {', '.join(map(scale_name, scales))}; views {', '.join(v.name for v in views)}\n")
        print("| | PSNR, dB | PSNR, bicubic | PSNR, own look | SSIM | flicker | s |\n|---|---|---|---|---|---|---|")
        for label in tried:
            mine = [row for row in rows if row.label == label]
            print(f"| {label} | {' | '.join(cells(mine, scales))} |", flush=True)


@dataclass(frozen=True)
class Row:
    """Figures of one way, view and scale."""

    label: str
    scale: float
    figures: Figures


DIGITS = {"box": 2, "pil-bicubic": 2, "self": 2, "SSIM": 4, "flicker": 2, "s": 3}


def cells(rows: Sequence[Row], scales: Sequence[float]) -> Iterator[str]:
    """Means over the views at each scale, and medians of seconds."""
    for figure, digits in DIGITS.items():
        values = [[r.figures[figure] for r in rows if r.scale == scale] for scale in scales]
        middle = median if figure == "s" else mean
        known = [[v for v in at if v is not None] for at in values]
        yield " / ".join(f"{middle(at):.{digits}f}" if at else "–" for at in known)


def measured(look: Renderer, tried: Ways, views: Sequence[Camera], scales: Sequence[float]) -> Iterator[Row]:
    """Every way on every view at every scale."""
    truths = {name: Truth(look, "photographs", replace(DEFAULT, downscale=name)) for name in ("box", "pil-bicubic")}
    for view in views:
        photographs = {name: ViewTruth(truth, view) for name, truth in truths.items()}
        own = ViewTruth(Truth(look), view)
        for scale in scales:
            wanted = {name: truth.compared(scale) for name, truth in photographs.items()}
            wanted |= {"self": own.compared(scale)} if scale <= 1 else {}
            motion = own.motion(scale) if scale < 1 else []
            drawn: dict[Recipe, list[Samples]] = {}
            for label, way in tried.items():
                if way.recipe not in drawn:
                    drawn[way.recipe] = sampled(look, way.recipe, view.scaled(scale), frames=max(1, len(motion)))
                yield Row(label, scale, figures(drawn[way.recipe], way.finish, wanted, motion))


def sampled(look: Renderer, recipe: Recipe, camera: Camera, frames: int) -> list[Samples]:
    """The samples of an image, and of more frames between which it moves by 1/4 px."""
    renderer = Renderer.of(look.scene, look.training, recipe, rasterizer=look.rasterizer, background=look.background)
    one = replace(renderer, recipe=replace(renderer.recipe, grid=1, target_rate=0.0))
    found = []
    for step in range(frames):
        moved = replace(camera, cx=camera.cx + step / SHIFT_STEPS, cy=camera.cy + step / SHIFT_STEPS)
        fine, n = renderer.sampled(moved)
        started = time.perf_counter()
        render = one(fine)
        seconds = time.perf_counter() - started
        found.append(Samples(render, n, renderer.background, renderer.relative_rate(moved), seconds))
    return found


def figures(frames: list[Samples], finish: Finish, wanted: Mapping[str, Image | None], motion: list[Image]) -> Figures:
    """What is measured of the first frame, and of all of them."""
    started = time.perf_counter()
    images = [finish(samples).clamp(0, 1) for samples in frames]
    seconds = frames[0].seconds + (time.perf_counter() - started) / len(frames)
    image = quantised(images[0])
    found = {name: psnr(image, truth) for name, truth in wanted.items() if truth is not None}
    box = wanted["box"]
    found["SSIM"] = None if box is None else ssim(image, box)
    found["flicker"] = flicker(images, motion) if motion else None
    return dict.fromkeys(DIGITS) | found | {"s": seconds}


if __name__ == "__main__":
    main(sys.argv[1:])
