"""Laws of screen filters and world filters.

A screen filter is tried in `SITUATIONS`, in which each kind of view and each convention of training occurs.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product

import torch

from aaplug.core.conventions import ANTIALIASED, CLASSIC, CONVENTIONS, MIP, Convention
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import ScreenFilter, WorldFilter
from aaplug.core.projection import project
from aaplug.core.shading import shade
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.system.plug_ins import check_answer

from .base import F64, copies_of, make_camera, make_scene, make_splats, require, require_gradients, require_same

N = 40  # Gaussians
EYES = [(0.0, -4.0, 0.0), (3.0, -4.0, 1.0), (-2.0, -6.0, 0.5)]
CAMERAS = [make_camera(eye) for eye in EYES]
FREE = replace(make_camera((0.3, -2.0, 0.2)), trained_focal=None)
SCENE = make_scene(N, dtype=F64)
EXTREMES: dict[str, Callable[[Gaussians], Gaussians]] = {
    "points": lambda scene: _with_scales(scene, -80.0, -80.0, -80.0),
    "needles": lambda scene: _with_scales(scene, 0.0, -30.0, -30.0),
    "sheets": lambda scene: _with_scales(scene, 0.0, 0.0, -80.0),
    "sheets of no thickness": lambda scene: _with_scales(scene, 0.0, 0.0, -torch.inf),
    "giants": lambda scene: _with_scales(scene, 12.0, 12.0, 12.0),
}


def _with_scales(scene: Gaussians, *log_scales: float) -> Gaussians:
    return replace(scene, log_scales=scene.log_scales.new_tensor(log_scales).repeat(N, 1))


@cache
def trained_with(convention: Convention) -> TrainingViews:
    """The training views of `SCENE`, had it been trained in that convention."""
    return TrainingViews.of(replace(SCENE, convention=convention), CAMERAS)


SITUATIONS = {  # a view, and training views
    "training size, classic": (CAMERAS[0], trained_with(CLASSIC)),
    "half, antialiased": (CAMERAS[0].scaled(0.5), trained_with(ANTIALIASED)),
    "threefold, mip": (CAMERAS[0].scaled(3.0), trained_with(MIP)),
    "free, near and small, classic": (FREE.scaled(0.3), trained_with(CLASSIC)),
}


def spheres(sigma: float, opacities: tuple[float, ...] = (0.0, 0.1, 0.5, 0.9, 1.0)) -> Splats2D:
    """Round splats of `sigma` px."""
    m = len(opacities)
    splats = make_splats(m, (48, 64)).to(F64)
    return replace(
        splats,
        covs=torch.tensor([[sigma**2, 0.0, sigma**2]], dtype=F64).expand(m, 3),
        dets=torch.full((m,), sigma**4, dtype=F64),
        opacities=torch.tensor(opacities, dtype=F64),
        depths=torch.linspace(2, 6, m, dtype=F64),
    )


def keeps_splats(screen: ScreenFilter) -> None:
    """It keeps its input, and returns splats with other covariances and opacities alone, the same again."""
    for view, training in SITUATIONS.values():
        splats = shade(project(SCENE, view), SCENE, view)
        before = copies_of(splats)
        filtered = screen(splats, view, training)
        check_answer("`__call__`", filtered, Splats2D)
        require_same(splats, before)
        require(len(filtered) == len(splats), "leaves splats out")
        require_same(filtered, {name: before[name] for name in ("means", "depths", "sources", "rgb")})
        require_same(screen(splats, view, training), copies_of(filtered), "gives, called again, another")


def never_shrinks_splats(screen: ScreenFilter) -> None:
    """Covariances never shrink, and stored determinants are theirs."""
    for view, training in SITUATIONS.values():
        splats = project(SCENE, view)
        filtered = screen(splats, view, training)
        xx, xy, yy = (filtered.covs - splats.covs).unbind(dim=1)
        grows = (xx.min() >= 0) & (yy.min() >= 0) & ((xx * yy - xy * xy).min() >= -1e-12)
        require(grows & (filtered.dets >= splats.dets).all(), "a covariance is smaller than it was")
        xx, xy, yy = filtered.covs.unbind(dim=1)
        torch.testing.assert_close(filtered.dets, xx * yy - xy * xy, rtol=1e-7, atol=1e-12)


def keeps_opacities_in_range(screen: ScreenFilter) -> None:
    """Opacities stay in [0, 1], an opacity of 0 stays 0; at any scale values are finite and keep their precision."""
    for (view, training), sigma, dtype in product(
        SITUATIONS.values(), (1e-6, 1e-3, 0.1, 1.0, 30.0, 1e6), (torch.float32, F64)
    ):
        opacities = screen(spheres(sigma).to(dtype), view, training).opacities
        require(opacities.min() >= 0 and opacities.max() <= 1 and opacities[0] == 0, f"{opacities} at {sigma} px")
    for (view, training), (name, shape) in product(SITUATIONS.values(), EXTREMES.items()):
        filtered = screen(project(shape(SCENE.to(torch.float32)), view), view, training)
        for column, value in copies_of(filtered).items():
            require(value.dtype in (torch.float32, torch.int64), f"changes {column} to {value.dtype}")
        finite = all(value.isfinite().all() for value in copies_of(filtered).values())
        require(finite, f"{name} give values that are not finite")


def keeps_huge_splats(screen: ScreenFilter) -> None:
    """A splat much larger than a pixel keeps its opacity and shape."""
    for view, training in SITUATIONS.values():
        splats = spheres(1e4)
        filtered = screen(splats, view, training)
        torch.testing.assert_close(filtered.opacities, splats.opacities, rtol=1e-6, atol=0)
        scale = splats.covs[:, :1]
        torch.testing.assert_close(filtered.covs / scale, splats.covs / scale, rtol=1e-6, atol=1e-6)


def has_gradients_on_screen(screen: ScreenFilter) -> None:
    """Its gradient is that of its formula."""
    splats = make_splats(3, (48, 64), log_sigmas=(-1.0, 1.0)).to(F64)
    inputs, outputs = ("covs", "dets", "depths", "opacities"), ("covs", "dets", "opacities")
    # not at the training size, where the range of rates ends at the view itself: that is a kink
    for view, training in list(SITUATIONS.values())[1:]:
        require_gradients(lambda given: screen(given, view, training), splats, inputs, outputs)  # noqa: B023


def world_scene(dtype: torch.dtype = F64, convention: Convention = ANTIALIASED) -> Gaussians:
    """A scene that every world filter changes."""
    filters = torch.linspace(0.01, 0.2, N, dtype=dtype)
    return replace(make_scene(N, dtype=dtype), filter_3d=filters, convention=convention)


def keeps_gaussians(world: WorldFilter) -> None:
    """It keeps its input, records itself in `fused`, and else changes scales and opacities alone, the same again."""
    scene = world_scene()
    before, training = copies_of(scene), TrainingViews.of(scene, CAMERAS)
    once = world(scene, training)
    check_answer("`__call__`", once, Gaussians)
    require_same(scene, before)
    require(scene.fused == (), "changes its input's `fused`")
    require(once.log_scales.shape == scene.log_scales.shape, "does not return as many Gaussians")
    require_same(once, {name: before[name] for name in ("means", "quats", "sh")})
    require(len(once.fused) == 1 and once.fused[0].method, f"records {once.fused} instead of itself")
    require_same(world(scene, training), copies_of(once), "gives, called again, other")
    twice = world(replace(once, filter_3d=scene.filter_3d), training)
    require(twice.fused[0] == once.fused[0] and len(twice.fused) == 2, "drops earlier records from `fused`")


def filters_each_by_itself(world: WorldFilter) -> None:
    """It treats each Gaussian by itself."""
    scene = world_scene()
    order = torch.randperm(N, generator=torch.Generator().manual_seed(0))[:25]
    part = world(scene[order], TrainingViews.of(scene[order], CAMERAS))
    whole = world(scene, TrainingViews.of(scene, CAMERAS))[order]
    torch.testing.assert_close(part.log_scales, whole.log_scales)
    torch.testing.assert_close(part.logit_opacities, whole.logit_opacities)


def never_shrinks_gaussians(world: WorldFilter) -> None:
    """Scales never shrink and opacities stay inside (0, 1), finite at any scale and in every convention."""
    shapes = {"scales as usual": lambda scene: scene, **EXTREMES}
    for convention, dtype, (name, shape) in product(CONVENTIONS.values(), (torch.float32, F64), shapes.items()):
        scene = shape(world_scene(dtype, convention)).to(dtype)
        scene.logit_opacities[:2] = torch.tensor([-30.0, 100.0])
        filtered = world(scene, TrainingViews.of(scene, CAMERAS))
        require(filtered.log_scales.dtype == filtered.logit_opacities.dtype == dtype, f"changes {dtype}")
        require((filtered.log_scales >= scene.log_scales).all(), f"{name}: a scale is smaller than it was")
        finite = (filtered.log_scales < torch.inf).all() and filtered.logit_opacities.isfinite().all()
        require(finite, f"{name}: values are not finite")
        inside = (filtered.opacities > 0) & (filtered.opacities < 1)
        kept = filtered.logit_opacities == scene.logit_opacities  # 1 where it was 1
        require((inside | kept).all() or name != "scales as usual", "opacities reach 0 or 1")


def has_gradients_in_the_world(world: WorldFilter) -> None:
    """Its gradient is that of its formula."""
    scene = world_scene()[torch.arange(2)]
    training, fainter = TrainingViews.of(scene, CAMERAS), replace(scene, logit_opacities=scene.logit_opacities - 2)
    outputs = ("log_scales", "logit_opacities")
    require_gradients(lambda given: world(given, training), fainter, (*outputs, "filter_3d"), outputs)
