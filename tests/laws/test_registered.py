"""The laws that `aaplug check-plugin` runs: all that is registered keeps them, and broken objects do not."""

import math
import secrets
from dataclasses import replace
from inspect import isfunction, signature
from itertools import chain

import pytest
import torch
from torch.autograd.gradcheck import GradcheckError

from aaplug import METRICS, RECIPES, RULES_3DGS, SCREEN_FILTERS, Fusion, smoothed_by
from aaplug.evaluation.laws import LAWS, drawing, files, filters, recipes
from aaplug.io.scenes import ply, usd
from aaplug.lab.gaussian_blending import GaussianBlending
from aaplug.methods.pixel_kernels.point import Point
from aaplug.methods.recipe import Promises, Recipe
from aaplug.rasterizers.tiled import Tiled
from aaplug.system.errors import PlugInError
from aaplug.system.registry import registry_of
from tests.conftest import ALL_RASTERIZERS

OTHERS = {  # what recipes use without a name, and the compiled rasterizer
    "screen filter": {f"of {n}": r.screen for n, r in RECIPES.items() if r.screen not in SCREEN_FILTERS.values()},
    "rasterizer": {name: each for name, each in ALL_RASTERIZERS.items() if name == "compiled"},
}
LEFT_OUT = {  # all of USD's suffixes are read as the first is, in a process each
    "tells_scenes_apart": usd.SUFFIXES[1:],
    "draws_what_the_reference_draws": ("reference",),
}
BY_NAME = {law.__name__: law for law in chain(*LAWS.values())}
CASES = {
    f"{kind} {name}: {law.__name__}": (law, value)
    for kind, laws in LAWS.items()
    for name, value in {**registry_of(kind), **OTHERS.get(kind, {})}.items()
    for law in laws
    if name not in LEFT_OUT.get(law.__name__, ())
}


@pytest.mark.parametrize("case", CASES)
def test_the_law_holds(case):
    law, value = CASES[case]
    law(value)


class Broken(Point):
    """Rows that its exact form is not of, with a padding row that draws, in too small an ellipse."""

    def exact(self, splats, offsets):
        return 0.9 * super().exact(splats, offsets)

    def raster_rows(self, splats, kernels):
        return super().raster_rows(splats, kernels)[[*range(len(splats)), 0]]

    def bounding_ellipses(self, splats, rules):
        return replace(splats, covs=splats.covs / 4, dets=splats.dets / 16)


class Dimmed(GaussianBlending):
    def exact(self, *args):
        colours, alpha = super().exact(*args)
        return 0.9 * colours, alpha


class Spoiling:
    name = "spoiling"

    def __call__(self, splats, hw, background, pixel, compositor=None, rules=RULES_3DGS):
        splats.opacities.mul_(0.9)
        return Tiled()(splats, hw, (0.0, 0.0, 0.0), pixel, compositor, rules)


class Bare(Spoiling):
    def __call__(self, splats, hw, *args):
        return torch.zeros(*hw, 3)


class Raising:
    name = sign = "raising"

    def sniff(self, *args):
        raise KeyError("no answer")

    open_scene = read = sniff


class Forgetful:
    name, needs, sniff, open_scene = "ply", None, staticmethod(ply.sniff), staticmethod(ply.open_scene)

    def write(self, path, parts, count, overwrite, options):
        first = next(iter(parts))
        ply.write(path, [first], len(first), overwrite, options)


class Untidy(Forgetful):
    def write(self, path, parts, count, overwrite, options):
        super().write(path, parts, count, overwrite, options)
        path.with_name(secrets.token_hex()).touch()


def promising(name: str) -> Recipe:
    return replace(RECIPES[name], promises=Promises(True, True, True, True))


BROKEN = {
    "keeps_splats": lambda splats, *_: splats[1:],
    "never_shrinks_splats": lambda splats, *_: replace(splats, covs=splats.covs / 4, dets=splats.dets / 16),
    "keeps_opacities_in_range": lambda splats, *_: replace(splats, opacities=splats.opacities + 0.1),
    "keeps_huge_splats": lambda splats, *_: replace(splats, opacities=splats.opacities / 2),
    "has_gradients_on_screen": lambda splats, *_: replace(splats, opacities=splats.opacities.detach() * splats.dets),
    "keeps_gaussians": lambda scene, training: scene,
    "filters_each_by_itself": lambda scene, training: replace(scene, log_scales=scene.log_scales.flip(0)),
    "never_shrinks_gaussians": lambda scene, training: replace(scene, log_scales=scene.log_scales - 1),
    "has_gradients_in_the_world": lambda scene, training: replace(
        scene, logit_opacities=scene.logit_opacities.detach() * scene.log_scales[:, 0]
    ),
    **dict.fromkeys(("alpha_is_exact", "rows_hold_colours", "ellipses_bound_it", "draws_the_exact_image"), Broken()),
    "composites_the_exact_image": Dimmed(),
    **dict.fromkeys(("draws_what_the_reference_draws", "keeps_its_splats"), Spoiling()),
    "is_least_for_the_truth": lambda image, truth: image.mean(),
    "has_gradients_of_images": lambda image, truth: (image - truth).square().mean().sqrt(),
    "is_ideal_for_the_truth": replace(METRICS["PSNR"], measure=lambda image, truth: 40.0),
    **dict.fromkeys(("tells_scenes_apart", "tells_cameras_apart"), Raising()),
    "reads_what_it_writes": Forgetful(),
    "writes_the_same_files_again": Untidy(),
    **dict.fromkeys(("keeps_energy", "fades_when_small"), promising("classic")),
    "opaque_when_near": promising("mip-splatting"),
    "equals_training": promising("mip"),
}


def test_every_law_stands_in_the_table():
    modules = (drawing, files, filters, recipes)
    functions = filter(isfunction, chain(*(vars(module).values() for module in modules)))
    laws = {f for f in functions if len(signature(f).parameters) == 1 and signature(f).return_annotation is None}
    assert laws == {*chain(*LAWS.values())}


@pytest.mark.parametrize("law", BY_NAME)
def test_a_broken_object_breaks_the_law(law):
    with pytest.raises((AssertionError, GradcheckError, KeyError)):
        BY_NAME[law](BROKEN[law])


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_what_a_recipe_does_not_promise_does_not_hold(recipe):
    promises = recipe.promises
    if not promises.keeps_energy:
        drift = recipes.light_drift(recipe)
        assert drift[0.125] > 1  # its light more than doubles, even with the 0.075 px² of playcanvas-classic
        assert sorted(drift.values(), reverse=True) == list(drift.values())
        assert recipes.alpha_from_afar(recipe) > 0.5 * recipes.OPACITY
    elif not promises.fades_when_small:  # a sample hits the splat here
        assert recipes.alpha_from_afar(recipe) == pytest.approx(recipes.OPACITY / recipe.grid**2)
    if not promises.opaque_when_near:
        assert 0.2 * recipes.OPACITY < recipes.alpha_from_near(recipe) < 0.99 * recipes.OPACITY
    if not promises.equals_training:
        assert recipes.EQUAL < recipes.difference_to_training(recipe) < math.inf


class Few(Point):
    def bounding_ellipses(self, splats, rules):
        return splats[:0]


class Turned(Point):
    def exact(self, splats, offsets):
        return super().exact(splats, offsets).T


class Doubling(Forgetful):
    def write(self, path, parts, count, overwrite, options):
        for part in parts:
            part.means.mul_(2)


class Plain(Forgetful):
    write = staticmethod(ply.write)

    def open_scene(self, *given):
        return replace(ply.open_scene(*given), sh_degree=0)


def blackens(image, truth):
    image.numpy()[:] = 0.0  # torch counts no write
    return float((image - truth).abs().mean())


ALSO_BROKEN = {
    "changes covs to torch.float64": (
        "keeps_opacities_in_range",
        lambda splats, *_: replace(splats, covs=splats.covs.double()),
    ),
    "gives, called again, another opacities": (
        "keeps_splats",
        lambda splats, *_: replace(splats, opacities=torch.rand_like(splats.opacities)),
    ),
    "gives, called again, other log_scales": (
        "keeps_gaussians",
        lambda scene, *_: replace(
            scene, log_scales=torch.rand_like(scene.log_scales), fused=(*scene.fused, Fusion("odd", {}))
        ),
    ),
    "the gradient of opacities by opacities": (
        "has_gradients_on_screen",
        lambda splats, *_: replace(splats, opacities=splats.opacities.detach()),
    ),
    "the gradient of log_scales by log_scales": (
        "has_gradients_in_the_world",
        lambda scene, *_: replace(scene, log_scales=scene.log_scales.detach()),
    ),
    "there are 0 ellipses of 100 splats": ("ellipses_bound_it", Few()),
    "`alpha` and `exact` are of shapes": ("alpha_is_exact", Turned()),
    "should return a Render, got float32": ("keeps_its_splats", Bare()),
    "changes means": ("reads_what_it_writes", Doubling()),
    "says degree 0 and reads 1": ("reads_what_it_writes", Plain()),
    "changes an image": ("is_ideal_for_the_truth", replace(METRICS["PSNR"], ideal=0.0, measure=blackens)),
}


@pytest.mark.parametrize("problem", ALSO_BROKEN)
def test_a_broken_law_says_how(problem):
    law, broken = ALSO_BROKEN[problem]
    with pytest.raises((AssertionError, PlugInError), match=problem):
        BY_NAME[law](broken)


def test_a_world_filter_may_leave_opacities_as_they_are():
    BY_NAME["never_shrinks_gaussians"](
        lambda scene, training: smoothed_by(scene, torch.zeros(len(scene), 1).to(scene.means), volume=False)
    )
