"""What cameras are worth: PSNR that is lost where nobody knows how a scene was trained, or only at which size.

Checkpoints with known cameras are rendered from their test views without them.  The tables have the assumed training
rate over the true one; what is lost against photographs, in dB, and what 3DGS's rule loses; PSNR between the images
with and without cameras; and what is lost where the rate is wrong by a factor.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import mean
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.imaging import quantised, resampled
from aaplug.core.sampling import median_rates
from aaplug.io.photographs import read_photo
from aaplug.io.scenes import scene_of
from aaplug.methods.recipes import find_recipe
from aaplug.options.shared import Orbit
from aaplug.rendering.assumed import cameras_around, decibels_at
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.convert import convert
from tests.bench import heading, row
from tests.bench.scenes import CHECKPOINTS, decibels, trained

MAX_SIDE = 1000  # px: of a larger image, the middle is compared
SCALES = {"1": 1.0, "1/2": 1 / 2, "1/4": 1 / 4, "1/8": 1 / 8, "2": 2.0, "4": 4.0}
WRONG_FACTORS = {"1/4": 1 / 4, "1/2": 1 / 2, "2": 2.0, "4": 4.0, "8": 8.0}
STATED = {"chair_eighth": Orbit(train_view="100x100"), "snowmiku_quarter": Orbit(train_view="246x185")}
CASES = (*CHECKPOINTS, *(f"{name}, stated" for name in STATED))

Image = Float[Tensor, "h w 3"]


class Look(NamedTuple):
    """A renderer that takes the training to have been so and so, and the views as it knows them."""

    renderer: Renderer
    views: Sequence[Camera]

    def images(self, scale: float) -> list[Image]:
        """The views at a scale."""
        return [self.renderer(_middle(view.scaled(scale))).rgb for view in self.views]

    def with_wrong_rate(self, factor: float) -> "Look":
        """The same with a training rate that is wrong by a factor."""
        views = [replace(view, trained_focal=(view.trained_focal or 1.0) * factor) for view in self.views]
        return Look(replace(self.renderer, training=self.renderer.training.finer(factor)), views)

    def photograph(self, view: Camera, scale: float) -> Image | None:
        """The middle of a view's photograph at a scale; None without a photograph that large."""
        if view.photo is None:
            return None
        photo = quantised(read_photo(view.photo, self.renderer.background, view.lens))
        if (factor := scale * view.width / photo.shape[1]) > 1:
            return None
        small = resampled(photo, factor, view.scaled(scale).hw)
        height, width = small.shape[:2]
        left, top = max(0, width - MAX_SIDE) // 2, max(0, height - MAX_SIDE) // 2
        return quantised(small[top : top + MAX_SIDE, left : left + MAX_SIDE])

    def psnr(self, scale: float) -> float | None:
        """PSNR against photographs; None where one is missing."""
        photographs = [self.photograph(view, scale) for view in self.views]
        pairs = [(i, p) for i, p in zip(self.images(scale), photographs, strict=True) if p is not None]
        return mean(decibels(*pair) for pair in pairs) if len(pairs) == len(self.views) else None


@dataclass(frozen=True, eq=False)
class Case:
    """A checkpoint, looked at with its cameras and without.

    converted: with cameras and without, by the rule that it is converted for.
    ratio: of the training rates.  warning: PSNR to the picture at half and at twice the assumed rate, as aaplug prints.
    """

    known: Look
    bare: Look
    converted: tuple[Look, Look]
    ratio: float
    warning: Sequence[float]

    def lost(self, look: Look, scale: float) -> str:
        """What a look loses against photographs, of what is reached with cameras."""
        best, worse = self.known.psnr(scale), look.psnr(scale)
        return "" if best is None or worse is None else f"{best - worse:+.2f} of {best:.2f}"

    def lost_by_classic(self, scale: float) -> str:
        """What 3DGS's rule loses, which needs no cameras."""
        return self.lost(Look(replace(self.known.renderer, recipe=find_recipe("classic")), self.known.views), scale)

    def after_conversion(self, scale: float) -> str:
        """PSNR against photographs of the scene converted with cameras, and without."""
        ratios = [look.psnr(scale) for look in self.converted]
        return ", ".join(f"{ratio:.2f}" for ratio in ratios if ratio is not None)

    def between(self, scale: float) -> str:
        """PSNR between the images with and without cameras."""
        pairs = zip(self.bare.images(scale), self.known.images(scale), strict=True)
        return f"{mean(decibels(bare, quantised(known)) for bare, known in pairs):.1f}"


COLUMNS: dict[str, Callable[[Case, float], str]] = {
    "lost without cameras, against photographs": lambda case, scale: case.lost(case.bare, scale),
    "lost with 3DGS's own rule, `classic`": Case.lost_by_classic,
    "converted with cameras, and without": Case.after_conversion,
    "between the images with and without cameras": Case.between,
}


@torch.no_grad()
def main(scenes: Sequence[str] = CASES) -> None:
    """Print all tables."""
    cases = {name: _case(name) for name in scenes}
    heading("the assumed rate over the true one, and what is said of half and twice the rate", "", "", "1/2", "2")
    for name, case in cases.items():
        row(name, case.ratio, *(f"{ratio:.0f}" for ratio in case.warning))
    for title, cell in COLUMNS.items():
        heading(title, "", *SCALES)
        for name, case in cases.items():
            row(name, *(cell(case, scale) for scale in SCALES.values()))
    for at in ("1", "1/4"):
        heading(f"lost at {at} where the rate is wrong by a factor", "", *WRONG_FACTORS)
        for name, case in cases.items():
            looks = map(case.known.with_wrong_rate, WRONG_FACTORS.values())
            row(name, *(case.lost(look, SCALES[at]) for look in looks))


def _case(name: str) -> Case:
    """Read a checkpoint."""
    plain, _, stated = name.partition(", ")
    known = trained(plain)
    bare = replace(known, cameras=cameras_around(scene_of(known.scene), STATED[plain] if stated else Orbit()))
    true, assumed = (median_rates(known.scene.means, each.cameras.train) for each in (known, bare))
    both = (true > 0) & (assumed > 0)
    views = known.views()
    free_views = [replace(view, trained_focal=None) for view in views]
    scenes = [convert(known.scene, each.cameras).scene for each in (known, bare)]
    mip = replace(known.renderer(), recipe=find_recipe("mip"))
    with_cameras, without = (Look(replace(mip, scene=scene), views) for scene in scenes if scene is not None)
    return Case(
        Look(known.renderer(), views),
        Look(bare.renderer(), free_views),
        (with_cameras, without),
        float((assumed[both] / true[both]).median()),
        decibels_at(bare.renderer(), bare.cameras.test[0], (0.5, 2.0)),
    )


def _middle(view: Camera) -> Camera:
    """The view's middle."""
    width, height = min(view.width, MAX_SIDE), min(view.height, MAX_SIDE)
    left, top = (view.width - width) // 2, (view.height - height) // 2
    return replace(view, width=width, height=height, cx=view.cx - left, cy=view.cy - top)
