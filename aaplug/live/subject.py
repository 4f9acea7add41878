"""What is looked at: a scene, the views to stand in, and its renderers by recipe and quality."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from aaplug.core.camera_paths import up_of
from aaplug.core.cameras import Camera, CameraSet, spread
from aaplug.core.choices import QUALITIES
from aaplug.core.errors import AaplugError
from aaplug.core.gaussians import Gaussians
from aaplug.core.orbits import pinhole
from aaplug.core.pyramids import Pyramid
from aaplug.evaluation.protocols import median_depth
from aaplug.live.messages import See, Side
from aaplug.live.paints import PAINTS
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import RECIPES, find_recipe
from aaplug.rendering.renderer import Renderer

KEPT = 6  # renderers: a recipe with a world filter has Gaussians of its own
BOLDEST = 400_000  # Gaussians that are drawn while the camera moves, at most
MOST_VIEWS = 1000  # that a page offers


@dataclass
class Subject:
    """A scene to look at; one thread draws it.

    look: renders the scene, with the background, rasterizer and training views of all other renderers.
    recipes: names that can be chosen.  title: of the page.
    words: of a command line that names the scene and its cameras: the words after the verb.
    """

    scene: Gaussians | Pyramid
    cameras: CameraSet
    look: Renderer
    recipes: Sequence[str]
    title: str
    words: Sequence[str]
    views: Sequence[Camera] = field(init=False)
    _renderers: dict[Side, Renderer] = field(default_factory=dict, init=False)
    _bold: dict[int, tuple[Gaussians, Gaussians]] = field(default_factory=dict, init=False)
    _order: torch.Tensor | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        test = {id(camera) for camera in self.cameras.test}
        first = sorted(self.cameras.all, key=lambda camera: id(camera) not in test)
        self.views = spread(first, MOST_VIEWS)

    @property
    def start(self) -> Camera:
        """The view that a page opens with."""
        return self.views[0]

    def camera(self, see: See) -> Camera:
        """The camera of a picture; at a view of the data set its pixels are those of the view, scaled."""
        if see.at is None:
            pose = torch.tensor(see.pose, dtype=torch.float64).view(4, 4)
            return pinhole("view", (see.width, see.height), see.focal, pose)
        scaled = self._scaled(see)
        left, top, _, _ = self.frame(see)
        return replace(scaled, width=see.width, height=see.height, cx=scaled.cx + left, cy=scaled.cy + top)

    def frame(self, see: See) -> tuple[int, int, int, int]:
        """Where in the picture the view that it stands in lies: left, top, width, height in px."""
        scaled = self._scaled(see)
        return (see.width - scaled.width) // 2, (see.height - scaled.height) // 2, scaled.width, scaled.height

    def renderer(self, side: Side) -> Renderer:
        """The renderer of a recipe by a quality; its memory of rates is empty, so that it stays small."""
        if side not in self._renderers:
            while len(self._renderers) >= KEPT:
                self._renderers.pop(next(iter(self._renderers)))
            how = {"background": self.look.background, "rasterizer": self.look.rasterizer}
            made = Renderer.of(self.scene, self.look.training, self._recipe(side), **how)
            self._renderers[side] = made
        return replace(self._renderers[side])

    def boldest(self, side: Side, count: int) -> Renderer:
        """The same with the Gaussians that pictures hang on most, `count` of them, or fewer of coarser levels."""
        renderer = self.renderer(side)
        if renderer.cutter is not None:
            return self.renderer(replace(side, quality=next(iter(QUALITIES))))
        order = self._boldest_first()
        kept = self._bold.get(id(renderer.scene))
        if kept is None or kept[0] is not renderer.scene:
            while len(self._bold) >= KEPT:
                self._bold.pop(next(iter(self._bold)))
            kept = renderer.scene, replace(renderer.scene, origin=None)[order]
            self._bold[id(renderer.scene)] = kept
        bounds = renderer.training.bounds[order[:count]]
        return replace(renderer, scene=kept[1][:count], training=replace(renderer.training, bounds=bounds))

    def about(self) -> dict[str, Any]:
        """What a page must know to begin, as JSON."""
        start = self.start
        return {
            "title": self.title,
            "words": list(self.words),
            "gaussians": len(self.look.scene),
            "rasterizer": self.look.rasterizer.name,
            "assumed": self.cameras.assumed,
            "background": [round(255 * x) for x in self.look.background],
            "recipes": [{"name": name, "when": RECIPES[name].when} for name in self.recipes],
            "qualities": list(QUALITIES),
            "paints": {name: paint.title for name, paint in PAINTS.items()},
            "up": up_of(self.cameras).tolist(),
            "depth": self._depth(start),
            "views": [_described(view) for view in self.views],
        }

    def _scaled(self, see: See) -> Camera:
        assert see.at is not None
        view = self.views[see.at]
        return view.scaled(see.focal / view.focal)

    def _recipe(self, side: Side) -> Recipe:
        return find_recipe(side.recipe, quality=side.quality)

    def _depth(self, view: Camera) -> float:
        """Distance to what a view shows, around which a page turns."""
        try:
            return median_depth(self.look.scene.means, view)
        except AaplugError:  # it shows nothing
            return 1.0

    def _boldest_first(self) -> torch.Tensor:
        """By opacity and by the area in px² that training saw it with, largest first."""
        if self._order is None:
            scene, bounds = self.look.scene, self.look.training.bounds
            areas = scene.log_scales.topk(2, dim=1).values.sum(dim=1) + 2 * bounds.highest.log()
            weight = areas + scene.opacities.clamp(min=1e-6).log()
            self._order = weight.topk(min(BOLDEST, len(weight))).indices
        return self._order


def _described(view: Camera) -> dict[str, Any]:
    """A view as a page draws it and stands in it."""
    photo = view.photo is not None and view.photo.is_file()
    return {
        "name": view.name,
        "width": view.width,
        "height": view.height,
        "focal": view.focal,
        "pose": view.cam_from_world.flatten().tolist(),
        "photo": photo,
    }
