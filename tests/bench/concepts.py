"""Two figures from one Gaussian of the bundled chair: what `matched` does, and where anti-aliasing acts."""

import math
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from aaplug import SCREEN_FILTERS, Camera, CameraSet, Gaussians, Recipe, Renderer, Splats2D, TrainingViews, find_recipe
from aaplug.evaluation.report.plots import COLOURS, Plot
from aaplug.lab.integral import INTEGRAL
from aaplug.methods.pixel_kernels.point import POINT

RATE = 1 / 4  # of the small image, against training
HALF = 8  # px of training on each side of the Gaussian
PIXELS = 4  # of the small image, along the side of the panel of samples
FINE = 320  # points along a panel's side
GAP = 0.12  # inches around a panel
SHARP, LONG = (0.05, 0.6), (2.0, 6.0)  # px²: least and largest variance of a Gaussian that shows it well
LIGHT = LinearSegmentedColormap.from_list("light", ["#ffffff", COLOURS[0]])


class Seen(NamedTuple):
    """A splat after a screen filter, in px of training: covariance, peak of its alpha, and centre."""

    cov: np.ndarray
    opacity: float
    mean: np.ndarray

    @property
    def light(self) -> float:
        """Its alpha, summed over the plane: 2π o √|C|, in px² of training."""
        return 2 * math.pi * self.opacity * math.sqrt(np.linalg.det(self.cov))


class Subject(NamedTuple):
    """The Gaussian that the figures show, and how it is seen."""

    scene: Gaussians
    training: TrainingViews
    view: Camera
    place: int

    def splat(self, screen: str, rate: float) -> Splats2D:
        """It alone, after a screen filter, in px of an image at `rate`."""
        recipe = Recipe(screen, SCREEN_FILTERS[screen], source="", when="")
        splats = Renderer.of(self.scene, self.training, recipe).splats(self.view.scaled(rate))
        return splats[splats.sources == self.place]

    def seen(self, screen: str, rate: float) -> Seen:
        """It after a screen filter, measured in px of training whatever the rate."""
        splat = self.splat(screen, rate)
        xx, xy, yy = (splat.covs[0].double() / rate**2).tolist()
        mean = splat.means[0].double().numpy() / rate
        return Seen(np.array([[xx, xy], [xy, yy]]), float(splat.opacities[0]), mean)


def concepts(scene: Gaussians, cameras: CameraSet) -> list[Plot]:
    """The figures of matched.md."""
    training, view = TrainingViews.of(scene, cameras), cameras.test[0]
    subject = Subject(scene, training, view, _clear(scene, training, view))
    return [
        Plot(
            "matched", "A Gaussian as training drew it, and as four filters draw it at 1/4", lambda _: _matched(subject)
        ),
        Plot("places", "The four places where anti-aliasing acts, on one Gaussian", lambda _: _places(subject)),
    ]


def _clear(scene: Gaussians, training: TrainingViews, view: Camera) -> int:
    """The most opaque Gaussian of a shape that is thin against a pixel across, and long along."""
    recipe = Recipe("bare", SCREEN_FILTERS["none"], source="", when="")
    splats = Renderer.of(scene, training, recipe).splats(view)
    xx, xy, yy = splats.covs.double().unbind(1)
    spread = ((xx - yy).square() / 4 + xy.square()).sqrt()
    thin, long = (xx + yy) / 2 - spread, (xx + yy) / 2 + spread
    fits = (thin > SHARP[0]) & (thin < SHARP[1]) & (long > LONG[0]) & (long < LONG[1]) & (xy.abs() > spread / 3)
    return int(splats.sources[torch.where(fits, splats.opacities, 0.0).argmax()])


def _sheet(height: float) -> Figure:
    return Figure((10, height), layout=ConstrainedLayoutEngine(h_pad=GAP, w_pad=GAP))


def _matched(subject: Subject) -> Figure:
    """Three steps above, three ways to draw the small image below."""
    own, trained = subject.seen("none", 1), subject.seen("classic", 1)
    fields = (
        ("the Gaussian: C", own, 1),
        ("1. as training drew it: C + 0.3 I", trained, 1),
        ("2. the same look at rate r = 1/4: r² (C + 0.3 I)", subject.seen("sa-gs", RATE), RATE),
        ("3. with the pixel's rest: + 0.07 (1 − r²) I", subject.seen("matched-global", RATE), RATE),
        ("classic at 1/4: r² C + 0.3 I", subject.seen("classic", RATE), RATE),
        ("Mip filter at 1/4: r² C + 0.1 I", subject.seen("mip", RATE), RATE),
    )
    figure, at, how = _sheet(7.2), np.linspace(-HALF, HALF, FINE), {"vmin": 0, "vmax": 1, "interpolation": "bilinear"}
    offsets = np.stack(np.meshgrid(at, at), axis=-1)
    for axes, (title, seen, rate) in zip(figure.subplots(2, 3).flat, fields, strict=True):
        square = np.einsum("...i,ij,...j", offsets, np.linalg.inv(seen.cov), offsets)
        alpha = seen.opacity * np.exp(-square / 2)
        axes.imshow(alpha, cmap=LIGHT, extent=(-HALF, HALF, HALF, -HALF), **how)
        axes.contour(at, at, square, [1.0], colors=COLOURS[1], linewidths=1.6)  # of one standard deviation
        _grid(axes, seen.mean, 1 / rate)
        axes.set_title(title, fontsize=9.5)
        axes.set_xlabel(f"light: {seen.light / trained.light:.0%} of training's")
    return figure


def _grid(axes: Axes, mean: np.ndarray, pixel: float) -> None:
    for centre, line in zip(mean, (axes.axvline, axes.axhline), strict=True):
        first = -(centre % pixel)
        for edge in np.arange(first - HALF // pixel * pixel, HALF + pixel, pixel):
            line(edge, color="#7b8794", lw=0.5, alpha=0.6)
    axes.set(xlim=(-HALF, HALF), ylim=(HALF, -HALF), xticks=[], yticks=[])


def _places(subject: Subject) -> Figure:
    figure = _sheet(8.4)
    world, screen, kernel, samples = figure.subplots(2, 2).flat
    _world(world, subject)
    angle = np.linspace(0, 2 * math.pi, FINE)
    for name, colour in (("none", COLOURS[1]), ("matched-global", COLOURS[0])):
        values, vectors = np.linalg.eigh(subject.seen(name, RATE).cov)
        x, y = vectors @ (np.sqrt(values)[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
        screen.plot(x, y, color=colour, lw=1.8)
        screen.fill(x, y, color=colour, alpha=0.15)
    _grid(screen, subject.seen("none", RATE).mean, 1 / RATE)
    screen.set_title("2. screen filter: once per splat and view")
    screen.set_xlabel("as projected, and as matched widens it; pixels at 1/4")
    screen.set_aspect("equal")
    _kernel(kernel, subject)
    _samples(samples, subject)
    return figure


def _world(axes: Axes, subject: Subject) -> None:
    """The Gaussian's two longest axes, before and after Mip-Splatting's 3D smoothing; in world units."""
    one = torch.tensor([subject.place])
    smoothed = Renderer.of(subject.scene, subject.training, "mip-splatting").scene
    angle = np.linspace(0, 2 * math.pi, FINE)
    for scene, colour in ((subject.scene, COLOURS[1]), (smoothed, COLOURS[0])):
        long, *_, thin = np.sort(scene.log_scales[one][0].exp().numpy())[::-1]
        axes.plot(long * np.cos(angle), thin * np.sin(angle), color=colour, lw=1.8)
        axes.fill(long * np.cos(angle), thin * np.sin(angle), color=colour, alpha=0.15)
    axes.set_aspect("equal")
    axes.set_title("1. world filter: once per scene")
    axes.set_xlabel("before and after 3D smoothing; world units")


def _kernel(axes: Axes, subject: Subject) -> None:
    """Alpha at a pixel, by the distance of its centre from the splat, for two pixel kernels."""
    splat = subject.splat("none", RATE).to(torch.float64)
    x = torch.linspace(-2, 2, FINE, dtype=torch.float64)
    offsets = torch.stack([x, torch.zeros_like(x)], dim=1)[:, None]
    named = (
        ("at the pixel's centre", POINT, COLOURS[1]),
        ("mean over the pixel (Analytic-Splatting)", INTEGRAL, COLOURS[0]),
    )
    for name, pixel, colour in named:
        alpha = splat.opacities * pixel.exact(splat, offsets)
        axes.plot(x.numpy(), alpha[:, 0].numpy(), color=colour, lw=1.8, label=name)
    axes.set(title="3. pixel kernel: once per splat and pixel", ylabel="alpha", ylim=(0, 1.3))
    axes.set_xlabel("offset of the pixel's centre from the splat, in px at 1/4")
    axes.legend(loc="upper right", fontsize=8.5)


def _samples(axes: Axes, subject: Subject) -> None:
    """The training-size look where it varies most, the small image's pixels, and where `auto` samples them."""
    recipe, at = find_recipe("auto"), RATE / 2
    whole = Renderer.of(subject.scene, subject.training, "auto", background="white")(subject.view).rgb.clamp(0, 1)
    side, n = round(PIXELS / at), recipe.samples_at(at)
    parts = whole.unfold(0, side, side).unfold(1, side, side).flatten(0, 1)  # [parts, 3, side, side]
    busiest = parts.mean(dim=1).flatten(1).std(dim=1).argmax()
    axes.imshow(parts[busiest].permute(1, 2, 0).numpy(), extent=(0, PIXELS, PIXELS, 0))
    steps = (np.arange(PIXELS * n) + 0.5) / n
    x, y = np.meshgrid(steps, steps)
    axes.plot(x.ravel(), y.ravel(), "o", ms=4, color=COLOURS[1], mec="white", mew=0.6)
    edges = range(PIXELS + 1)
    axes.set(xticks=edges, yticks=edges)
    axes.grid(color="white", lw=1)
    axes.set_title("4. samples: once per pixel")
    axes.set_xlabel(f"pixels at 1/8, each the mean of {n}×{n} samples, as auto takes them")
