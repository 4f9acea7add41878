"""The subject: a scene, the views to stand in, and its renderers by recipe and quality."""

import math
import os
import shlex
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import torch

from aaplug.core.camera_paths import median_depth, up_of
from aaplug.core.cameras import Camera, CameraSet, centred, spread
from aaplug.core.colours import Colour
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import quantised
from aaplug.evaluation.metrics import psnr
from aaplug.live.messages import PictureRequest, Side
from aaplug.live.overlays import OVERLAYS
from aaplug.methods import QUALITIES, RECIPES
from aaplug.methods.presets import find_recipe
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import AaplugError

MAX_RENDERERS = 6  # in memory: a recipe with a world filter has Gaussians of its own
MAX_PREVIEW_GAUSSIANS = 400_000  # that are drawn while the camera moves
MAX_VIEWS = 1000  # that a page offers
START_SECONDS = 2.0  # to find the view and the scale that a page opens with
START_VIEWS, START_SCALES, MIN_START_SIDE = 5, (0.125, 0.25, 0.5), 16  # compared; px


@dataclass(eq=False)
class Subject:
    """A scene to look at; one thread draws it.

    look: renders the scene, with the background, rasterizer and training views of all other renderers.
    recipes: names that can be chosen.  title: of the page.
    words: of a command line that names the scene and its cameras: the words after the verb.
    views: test views first; a page opens with the first one.
    """

    cameras: CameraSet
    look: Renderer
    recipes: Sequence[str]
    title: str
    words: Sequence[str]
    views: Sequence[Camera] = field(init=False)
    _prepared: Callable[[Side], Renderer] = field(init=False, repr=False)
    _prominent: Callable[[Gaussians], Gaussians] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        test = {id(camera) for camera in self.cameras.test}
        test_first = sorted(self.cameras.all, key=lambda camera: id(camera) not in test)
        self.views = spread(test_first, MAX_VIEWS)
        self._prepared = lru_cache(MAX_RENDERERS)(lambda s: self.look.by(find_recipe(s.recipe, quality=s.quality)))
        self._prominent = lru_cache(MAX_RENDERERS)(lambda scene: replace(scene, origin=None)[self._by_prominence])

    @property
    def opening(self) -> tuple[Side, Side]:
        """The sides that a page opens with."""
        left, right = (name if name in self.recipes else self.recipes[0] for name in ("classic", "auto"))
        return Side(left, next(reversed(QUALITIES))), Side(right, next(reversed(QUALITIES)))

    def camera(self, request: PictureRequest) -> Camera:
        """The camera of a picture; at a view of the data set its pixels are those of the view, scaled."""
        if request.at is None:
            pose = torch.tensor(request.pose, dtype=torch.float64).view(4, 4)
            return centred("view", (request.width, request.height), request.focal, pose)
        view, left, top = self.placed_view(request)
        return replace(view, width=request.width, height=request.height, cx=view.cx + left, cy=view.cy + top)

    def placed_view(self, request: PictureRequest) -> tuple[Camera, int, int]:
        """The view that a picture stands in, scaled; left and top px of it in the picture."""
        assert request.at is not None
        view = self.views[request.at]
        view = view.scaled(request.focal / view.focal)
        return view, (request.width - view.width) // 2, (request.height - view.height) // 2

    def renderer(self, side: Side, background: Colour | None = None) -> Renderer:
        """The renderer of a recipe by a quality; its memory of rates is empty, so that it stays small.

        background: None for that of the scene.
        """
        return replace(self._prepared(side), background=background or self.look.background)

    def preview_renderer(self, side: Side, background: Colour | None, count: int) -> Renderer:
        """The same with the `count` Gaussians that pictures hang on most, or with coarser levels."""
        renderer = self.renderer(side, background)
        if renderer.cutter is not None:
            return self.renderer(replace(side, quality=next(iter(QUALITIES))), background)
        training = replace(renderer.training, bounds=renderer.training.bounds[self._by_prominence[:count]])
        return replace(renderer, scene=self._prominent(renderer.scene)[:count], training=training)

    def about(self) -> dict[str, Any]:
        """The facts that a page needs to begin, as JSON."""
        try:  # the distance around which a page turns
            depth = median_depth(self.look.scene.means, self.views[0])
        except AaplugError:  # no Gaussian is in view
            depth = 1.0
        training = {id(view) for view in self.cameras.train}
        return {
            "title": self.title,
            "words": (subprocess.list2cmdline if os.name == "nt" else shlex.join)([*self.words]),
            "gaussians": len(self.look.scene),
            "rasterizer": self.look.rasterizer.name,
            "assumed": self.cameras.assumed,
            "background": "#" + bytes(round(255 * x) for x in self.look.background).hex(),
            "recipes": [{"name": name, "when": RECIPES[name].when} for name in self.recipes],
            "qualities": list(QUALITIES),
            "sides": [asdict(side) for side in self.opening],
            "start": self.start(),
            "paints": {name: overlay.title for name, overlay in OVERLAYS.items()},
            "up": up_of(self.cameras).tolist(),
            "depth": depth,
            "views": [
                {
                    "name": view.name,
                    "training": id(view) in training,
                    "width": view.width,
                    "height": view.height,
                    "focal": view.focal,
                    "pose": view.cam_from_world.flatten().tolist(),
                    "photo": view.photo is not None and view.photo.is_file(),
                }
                for view in self.views
            ],
        }

    def start(self) -> dict[str, Any] | None:
        """View and scale at which the two sides that a page opens with differ most, and by how many dB.

        A few views and scales are compared, for `START_SECONDS`; None if nothing differs.
        """
        end, best = time.monotonic() + START_SECONDS, (math.inf, 0, 1.0)
        renderers = [self.renderer(side) for side in self.opening]
        for index in range(0, len(self.views), -(-len(self.views) // START_VIEWS)):
            for scale in START_SCALES if best[0] == math.inf else (best[2],):
                camera = self.views[index].scaled(scale)
                if time.monotonic() < end and min(camera.hw) >= MIN_START_SIDE:
                    left, right = (quantised(renderer(camera).rgb) for renderer in renderers)
                    best = min(best, (psnr(left, right) or math.inf, index, scale))
        return None if best[0] == math.inf else {"decibels": best[0], "view": best[1], "scale": best[2]}

    @cached_property
    def _by_prominence(self) -> torch.Tensor:
        """Indices of Gaussians by opacity times the area in px² that training saw, largest first."""
        scene, bounds = self.look.scene, self.look.training.bounds
        areas = scene.log_scales.topk(2, dim=1).values.sum(dim=1) + 2 * bounds.highest.log()
        weight = areas + scene.opacities.clamp(min=1e-6).log()
        return weight.topk(min(MAX_PREVIEW_GAUSSIANS, len(weight))).indices
