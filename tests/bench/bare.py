"""What cameras are worth: python -m tests.bench.bare [SCENE ...], of the names in ALL.

Checkpoints with known cameras are rendered from their test views as if nobody knew how they were trained, or only at
which size.  Prints the assumed training rate over the true one; what is lost against photographs, in dB of PSNR, and
what 3DGS's rule loses; PSNR between the images with and without; and what is lost where the rate is wrong by a factor.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import BLACK, Camera
from aaplug.core.imaging import quantised, resampled
from aaplug.core.sampling import median_rates
from aaplug.core.training import TrainingViews
from aaplug.io.cameras import read_cameras
from aaplug.io.photographs import read_photo
from aaplug.io.scenes import read_scene
from aaplug.methods.recipes import find_recipe
from aaplug.rasterizers import find_rasterizer
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.assumed import Orbit, decibels_at
from aaplug.verbs.convert import convert
from tests.bench.away import SCENES, Scene, decibels
from tests.conftest import SHARED_DATA

VIEWS = 4
SIDE = 1000  # px: of a larger image, the middle is compared
SCALES = {"1": 1.0, "1/2": 1 / 2, "1/4": 1 / 4, "1/8": 1 / 8, "2": 2.0, "4": 4.0}
WRONG = {"1/4": 1 / 4, "1/2": 1 / 2, "2": 2.0, "4": 4.0, "8": 8.0}
TRAIN = "1000 Gaussians of train"
STATED = {"chair_eighth": Orbit(train_view="100x100"), "snowmiku_quarter": Orbit(train_view="246x185")}
ALL = {
    **SCENES,
    **{f"{name}, stated": SCENES[name] for name in STATED},
    TRAIN: Scene("formats/splats/train-1000.ply", background=BLACK),
}
APART = {TRAIN: "formats/splats/train.cameras.json"}  # cameras that do not lie beside the scene

Image = Float[Tensor, "h w 3"]


class Look(NamedTuple):
    """A renderer that takes the training to have been so and so, and the views as it knows them."""

    renderer: Renderer
    views: Sequence[Camera]

    def images(self, scale: float) -> list[Image]:
        """The views at a scale."""
        return [self.renderer(_middle(view.scaled(scale))).rgb for view in self.views]

    def wrong(self, factor: float) -> "Look":
        """The same with a training rate that is wrong by a factor."""
        views = [replace(view, trained_focal=(view.trained_focal or 1.0) * factor) for view in self.views]
        return Look(replace(self.renderer, training=self.renderer.training.finer(factor)), views)


@dataclass(frozen=True)
class Case:
    """A checkpoint, looked at with its cameras and without.

    converted: with cameras and without, by the rule that it is converted for.
    ratio: of the training rates.  said: PSNR to the picture at half and at twice the assumed rate, as aaplug prints it.
    """

    known: Look
    bare: Look
    converted: tuple[Look, Look]
    ratio: float
    said: Sequence[float]

    @property
    def classic(self) -> Look:
        """As 3DGS draws it, which needs no cameras."""
        return Look(replace(self.known.renderer, recipe=find_recipe("classic")), self.known.views)

    def reached(self, look: Look, scale: float) -> float | None:
        """PSNR against photographs, None without photographs that large."""
        found = []
        for view, image in zip(look.views, look.images(scale), strict=True):
            if view.photo is None:
                return None
            photo = quantised(read_photo(view.photo, self.known.renderer.background, view.lens))
            if (factor := scale * view.width / photo.shape[1]) > 1:
                return None
            small = resampled(photo, factor, view.scaled(scale).hw)
            found.append(decibels(image, quantised(_middle_of(small))))
        return sum(found) / len(found)

    def lost(self, look: Look, scale: float) -> str:
        """What a look loses against photographs, of what is reached with cameras."""
        best, worse = self.reached(self.known, scale), self.reached(look, scale)
        return "" if best is None or worse is None else f"{best - worse:+.2f} of {best:.2f}"

    def after_conversion(self, scale: float) -> str:
        """PSNR against photographs of the scene converted with cameras, and without."""
        found = [self.reached(look, scale) for look in self.converted]
        return ", ".join(f"{each:.2f}" for each in found if each is not None)

    def between(self, scale: float) -> str:
        """PSNR between the images with and without cameras."""
        pairs = zip(self.bare.images(scale), self.known.images(scale), strict=True)
        found = [decibels(bare, quantised(known)) for bare, known in pairs]
        return f"{sum(found) / len(found):.1f}"


def case(name: str) -> Case:
    """Read a checkpoint."""
    how, rasterizer = ALL[name], find_rasterizer()
    file = SHARED_DATA / how.file
    scene, cameras = read_scene(file), read_cameras(SHARED_DATA / APART.get(name, file.parent), train_scale=how.scale)
    plain, _, stated = name.partition(", ")
    sets = cameras, (STATED[plain] if stated else Orbit()).around(scene)
    trainings = [TrainingViews.of(scene, each, how.cull_margin) for each in sets]
    known, bare = (Renderer.of(scene, t, background=how.background, rasterizer=rasterizer) for t in trainings)
    true, assumed = (median_rates(scene.means, each.train) for each in sets)
    both = (true > 0) & (assumed > 0)
    views = cameras.test[:: -(-len(cameras.test) // VIEWS)]
    free = [replace(view, trained_focal=None) for view in views]
    ratio = float((assumed[both] / true[both]).median())
    fused = (convert(scene, each).scene for each in sets)
    shown = [replace(known, scene=each, recipe=find_recipe("mip")) for each in fused if each is not None]
    converted = Look(shown[0], views), Look(shown[1], views)
    return Case(Look(known, views), Look(bare, free), converted, ratio, decibels_at(bare, sets[1].test[0], (0.5, 2.0)))


def main(names: Sequence[str] = ()) -> None:
    torch.set_grad_enabled(False)
    cases = {name: case(name) for name in names or ALL}
    rows = {n: [f"{c.ratio:.2f}", *(f"{d:.0f}" for d in c.said)] for n, c in cases.items()}
    _table("the assumed rate over the true one, and what is said of half and twice the rate", ["", "1/2", "2"], rows)
    cells: dict[str, Callable[[Case, float], str]] = {
        "lost without cameras, against photographs": lambda one, scale: one.lost(one.bare, scale),
        "lost with 3DGS's own rule, `classic`": lambda one, scale: one.lost(one.classic, scale),
        "converted with cameras, and without": lambda one, scale: one.after_conversion(scale),
        "between the images with and without cameras": lambda one, scale: one.between(scale),
    }
    for title, cell in cells.items():
        _table(title, SCALES, {n: [cell(c, scale) for scale in SCALES.values()] for n, c in cases.items()})
    for at in ("1", "1/4"):
        rows = {n: [c.lost(c.known.wrong(f), SCALES[at]) for f in WRONG.values()] for n, c in cases.items()}
        _table(f"lost at {at} where the rate is wrong by a factor", WRONG, rows)


def _table(title: str, columns: Sequence[str] | dict[str, float], rows: dict[str, list[str]]) -> None:
    """Print a table of Markdown."""
    print(f"\n{title}\n\n| | {' | '.join(columns)} |\n{'|---' * (1 + len(columns))}|")
    for name, cells in rows.items():
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def _middle(view: Camera) -> Camera:
    """The view's middle."""
    width, height = min(view.width, SIDE), min(view.height, SIDE)
    left, top = (view.width - width) // 2, (view.height - height) // 2
    return replace(view, width=width, height=height, cx=view.cx - left, cy=view.cy - top)


def _middle_of(image: Image) -> Image:
    """The same part of an image."""
    height, width = image.shape[:2]
    left, top = max(0, width - SIDE) // 2, max(0, height - SIDE) // 2
    return image[top : top + SIDE, left : left + SIDE]


if __name__ == "__main__":
    main(sys.argv[1:])
