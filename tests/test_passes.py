"""Passes: each against a truth of its own, and by its rule where a pixel sees several things."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import aaplug
from aaplug import Gaussians, Lens, Renderer, UsageError, write_scene
from aaplug.core.passes import PASSES
from aaplug.io.image_formats import IMAGE_FORMATS, PNG
from aaplug.methods.order import Order
from aaplug.rasterizers.reference import REFERENCE
from aaplug.rasterizers.tiled.rasterizer import EAGER_TILED
from aaplug.rendering.frames import write_frames
from tests.conftest import make_camera, make_scene, make_splats

BLACK = (0.0, 0.0, 0.0)
TILT = math.radians(35)  # of the plane against the image


def plane(count: int = 120, side: float = 3.0) -> Gaussians:
    """A textured square of discs in a tilted plane through the origin, in any order."""
    at = (torch.arange(count) + 0.5) / count * side - side / 2
    u, v = (x.flatten() for x in torch.meshgrid(at, at, indexing="ij"))
    order = torch.randperm(len(u), generator=torch.Generator().manual_seed(0))
    means = torch.stack([u, v * math.sin(TILT), v * math.cos(TILT)], dim=1)[order]
    n, width = len(means), 0.7 * side / count
    log_scales = torch.tensor([width, width, 1e-4]).log().expand(n, 3)
    turn = (math.pi / 2 - TILT) / 2  # half the angle from z to the normal
    quats = torch.tensor([math.cos(turn), math.sin(turn), 0.0, 0.0]).expand(n, 4)
    colours = torch.rand(n, 1, 3, generator=torch.Generator().manual_seed(1)) * 3 - 1.5
    return Gaussians(means, quats.contiguous(), log_scales.contiguous(), torch.full((n,), 4.0), colours)


CAMERA = make_camera((0.4, -4.0, 0.3), (96, 72), name="v")
SMALL = make_camera((0.0, -4.0, 0.3), (64, 48), name="v")


@pytest.mark.parametrize("scale", [1.0, 0.25])
@pytest.mark.parametrize("axes", ["camera", "world"])
def test_depth_normal_and_position_of_a_textured_plane(scale, axes):
    """Largest errors: of depths and of position as shares of the depth, of normals in degrees."""
    renderer, camera = Renderer.of(plane(), [CAMERA], rasterizer="eager"), CAMERA.scaled(scale)
    assert renderer.samples(camera) == (1 if scale == 1 else 2)
    drawn = renderer.passes(camera, list(PASSES), axes)
    rotation, centre = camera.cam_from_world[:3, :3].float(), camera.centre.float()
    normal = torch.tensor([0.0, -math.cos(TILT), math.sin(TILT)])  # towards cameras at negative y
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], dim=2)
    depth = -(centre @ normal) / (rays @ rotation @ normal)
    covered = drawn["alpha"] > 0.9
    assert covered.float().mean() > 0.1
    depths = {name: (drawn[name] / depth - 1).abs() for name in PASSES if name.startswith("depth")}
    off = (drawn["position"] - centre - depth[..., None] * (rays @ rotation)).norm(dim=2) / depth
    seen = normal if axes == "world" else rotation @ normal * torch.tensor([1.0, -1.0, -1.0])
    angle = (drawn["normal"] @ seen).clamp(max=1).acos().rad2deg()
    error = {name: float(x[covered].max()) for name, x in (depths | {"position": off, "normal": angle}).items()}
    limits = {"depth": 0.001, "depth-median": 0.015, "depth-nearest": 0.025, "position": 0.002, "normal": 0.1}
    assert all(error[name] < limit for name, limit in limits.items()), error


def test_the_depth_of_a_ball_is_that_of_its_centre():
    ball = plane(count=1)
    ball = replace(ball, log_scales=torch.full((1, 3), -1.0), means=torch.tensor([[0.3, 0.2, 0.1]]))
    drawn = Renderer.of(ball, [CAMERA], rasterizer="eager").passes(CAMERA, ["depth", "alpha"])
    seen = drawn["alpha"] > 0
    assert seen.any()
    assert torch.allclose(drawn["depth"][seen], CAMERA.project(ball.means)[1].float(), rtol=1e-5)


def test_a_silhouette_takes_no_depth_from_behind_it():
    renderer = Renderer.of(plane(side=1.0), [CAMERA], background="white", rasterizer="eager")
    drawn = renderer.passes(CAMERA.scaled(0.25), ["depth", "alpha", "normal", "depth-nearest"])
    edge = (drawn["alpha"] > 0.02) & (drawn["alpha"] < 0.9)
    assert edge.sum() > 8
    assert 3.5 < drawn["depth"][edge].min() < drawn["depth"][edge].max() < 4.6
    assert torch.allclose(drawn["normal"][edge].norm(dim=1), torch.ones(int(edge.sum())))
    nothing = drawn["alpha"] == 0
    assert nothing.any()
    assert not any(drawn[name][nothing].any() for name in ("depth", "normal", "depth-nearest"))


GROUPS = [("nearest", "median", "number", "weight"), ("count", "weight", "number", "median"), ("last",) * 4]


@pytest.mark.parametrize("kernel", aaplug.PIXEL_KERNELS)
@pytest.mark.parametrize("shown", GROUPS)
def test_the_order_of_splats_agrees_with_its_float64_twin(kernel, shown):
    pixel, splats = aaplug.PIXEL_KERNELS[kernel], make_splats(160, (28, 37)).to(torch.float64)
    depth_and_number = torch.stack([splats.depths, torch.arange(160.0), torch.zeros(160)], dim=1)
    splats = replace(splats, rgb=depth_and_number, depth_slopes=torch.zeros_like(splats.means))
    order = Order.of(pixel, shown, splats)
    fast, exact = (draw(splats, (28, 37), BLACK, pixel, order) for draw in (EAGER_TILED, REFERENCE))
    for name, a, b in zip(shown, (*fast.rgb.unbind(2), fast.alpha), (*exact.rgb.unbind(2), exact.alpha), strict=True):
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-6), name
        assert len(a.unique()) > 10
    half = EAGER_TILED(splats.to(torch.float32), (28, 37), BLACK, pixel, order)
    assert (half.rgb[..., 2].double() - exact.rgb[..., 2]).abs().lt(1e-4).double().mean() > 0.999


def test_each_pass_resolves_the_samples_of_a_pixel_by_its_rule():
    """Against the passes of the supersampled image, in which each sample is a pixel."""
    camera = make_camera((0.0, -4.0, 0.3), (24, 18))
    recipe = aaplug.find_recipe("classic")
    single = Renderer.of(make_scene(80), [camera], recipe, rasterizer="eager")
    names = ["depth", "depth-median", "depth-nearest", "id", "samples", "alpha", "normal", "position"]
    pixels = replace(single, recipe=replace(recipe, grid=4)).passes(camera, names)
    fine = {name: boxes(layer) for name, layer in single.passes(camera.resized(96, 72), names).items()}
    alpha = fine["alpha"][..., None]

    def mean(name: str) -> torch.Tensor:
        layer = fine[name] if fine[name].ndim == 4 else fine[name][..., None]
        return ((layer * alpha).sum(dim=2) / alpha.sum(dim=2).clamp(min=1e-9)).squeeze(2)

    assert torch.allclose(pixels["alpha"], fine["alpha"].mean(dim=2), atol=1e-6)
    assert torch.allclose(pixels["depth"], mean("depth"), rtol=1e-4)
    assert torch.allclose(pixels["position"], mean("position"), rtol=1e-4, atol=1e-4)
    far = {name: fine[name].masked_fill(fine[name] == 0, torch.inf) for name in ("depth-median", "depth-nearest")}
    median, nearest = far["depth-median"].sort(dim=2).values[..., 7], far["depth-nearest"].amin(dim=2)
    assert pixels["depth-median"].equal(median.masked_fill(median == torch.inf, 0))
    assert pixels["depth-nearest"].equal(nearest.masked_fill(nearest == torch.inf, 0))
    assert pixels["samples"].equal(fine["samples"].sum(dim=2))
    assert (fine["id"] == pixels["id"][..., None]).any(dim=2).all()
    mixed = (fine["depth-median"] > 0).any(dim=2) & (fine["depth-median"] == 0).any(dim=2)
    assert mixed.any()


def boxes(layer: torch.Tensor) -> torch.Tensor:
    """The 4x4 samples of each pixel, in the third dimension."""
    return layer.unflatten(1, (-1, 4)).unflatten(0, (-1, 4)).transpose(1, 2).flatten(2, 3)


def test_ids_are_places_in_the_file_also_in_other_processes(tmp_path):
    scene = make_scene(60)
    write_scene(tmp_path / "whole.ply", scene)
    kept = aaplug.read_scene(tmp_path / "whole.ply").gaussians()[torch.cat([torch.arange(7), torch.arange(20, 60)])]
    found = []
    renderer = Renderer.of(kept, [SMALL], "classic", rasterizer="eager")
    for each in (renderer, renderer.portable()):
        found.append(each.passes(SMALL, ["id"])["id"])
    assert found[0].equal(found[1])
    drawn = set(found[0].flatten().tolist())
    assert max(drawn) >= 47  # beyond the places of what was kept
    assert not drawn & set(range(7, 20))
    assert -1 in drawn


def test_passes_leave_the_picture_as_it_is():
    renderer = Renderer.of(make_scene(200), [SMALL], rasterizer="eager", background="white")
    image, drawn = renderer(SMALL), renderer.passes(SMALL, list(PASSES))
    assert image.rgb.equal(drawn["rgb"])
    assert image.alpha.equal(drawn["alpha"])
    assert list(drawn) == list(PASSES)
    assert all(drawn[name].equal(renderer.passes(SMALL, [name])[name]) for name in PASSES)
    assert all(layer.isfinite().all() for layer in drawn.values())


@pytest.mark.parametrize("recipe", ["2dgs", "gaussian-blending", "sa-gs-integral", "mip-splatting"])
def test_every_kind_of_recipe_serves_every_pass(recipe):
    drawn = Renderer.of(make_scene(60), [SMALL], recipe, rasterizer="eager").passes(SMALL, list(PASSES))
    covered = drawn["alpha"] > 0.5
    assert covered.any()
    assert (drawn["id"][covered] >= 0).all()
    assert (drawn["depth-nearest"] <= drawn["depth-median"])[drawn["depth-median"] > 0].all()


def test_where_nothing_is_drawn_everything_is_0_and_ids_are_minus_1():
    drawn = Renderer.of(make_scene(0), [SMALL], "classic", rasterizer="eager").passes(SMALL, list(PASSES))
    assert (drawn.pop("id") == -1).all()
    assert not any(layer.any() for layer in drawn.values())


def test_the_bound_is_the_training_rate_over_the_views():
    renderer = Renderer.of(make_scene(60), [SMALL], "classic", rasterizer="eager")
    for factor in (1, 4):
        layers = renderer.passes(SMALL.scaled(1 / factor), ["bound", "alpha"])
        assert torch.allclose(layers["bound"][layers["alpha"] > 0.01], torch.tensor(float(factor)), rtol=1e-3)


def test_a_misspelt_pass_is_refused_with_the_nearest_name(cli):
    with pytest.raises(UsageError, match=r"passes: 'dept' is not one of rgb, alpha.*; did you mean depth?"):
        Renderer.of(make_scene(5), [make_camera()], "classic").passes(make_camera(), ["dept"])
    cli.refused(
        "render scene.ply --cameras . -o out --format exr --passes rgb,normals",
        "--passes: 'normals' is not one of rgb",
        "did you mean normal?",
    )
    cli.refused(
        "render scene.ply --cameras . -o out --passes rgb,depth", "--passes: a .png cannot hold depth; .exr, .npz can"
    )
    assert not Path("out").exists()


def test_render_writes_passes(cli):
    names = "rgb,alpha,depth,normal,id"
    facts = cli.facts(f"render scene.ply --cameras . -o out --views train --format npz --passes {names}")
    with np.load(facts["images"][0]["file"]) as found:
        assert {*names.split(",")} < {*found.files}
        assert found["normal"].shape == (48, 64, 3)
        assert found["id"].dtype == np.int64


LENSES = {
    "equirect": (Lens("equirect"), 30.0), "fisheye": (Lens("equidistant"), 40.0), "ortho": (Lens("ortho"), 20.0),
    "distorted": (Lens(radial=(0.1,)), 90.0),
}  # fmt: skip


@pytest.mark.parametrize("lens", LENSES)
def test_through_a_lens_a_position_is_where_the_splat_is(lens):
    """A ball far off the axis: its place, its distance or depth, its id, and no more."""
    kind, focal = LENSES[lens]
    ball = replace(make_scene(1), means=torch.tensor([[0.7, 0.1, -0.2]]), log_scales=torch.full((1, 3), -2.0))
    ball = replace(ball, logit_opacities=torch.tensor([5.0]))
    camera = replace(CAMERA, lens=kind, fx=focal, fy=focal)
    drawn = Renderer.of(ball, [CAMERA], "matched", rasterizer="eager").passes(camera, list(PASSES))
    seen = drawn["alpha"] > 0.5
    assert seen.any()
    place = drawn["position"][seen] - ball.means
    assert place.norm(dim=1).max() < 0.4
    offset = ball.means[0].double() - camera.centre
    away = offset @ camera.cam_from_world[2, :3] if kind.flat else offset.norm()
    for name in ("depth", "depth-median", "depth-nearest"):
        assert torch.allclose(drawn[name][seen], away.float(), rtol=1e-4), name
    assert (drawn["id"][seen] == 0).all()
    assert (drawn["id"] >= 0).equal(drawn["alpha"] > 0)
    assert torch.allclose(drawn["normal"][seen].norm(dim=1), torch.ones(1))


def test_an_exr_takes_no_ids_that_float_cannot_hold(monkeypatch, tmp_path):
    renderer = Renderer.of(make_scene(60), [CAMERA], "classic", rasterizer="eager")
    storage = replace(PNG, format=IMAGE_FORMATS["exr"], passes=("id",))
    monkeypatch.setattr("aaplug.rendering.frames.MAX_NUMBER", 59)
    with pytest.raises(UsageError, match=r"an \.exr holds ids up to 59, not 60; an \.npz does"):
        write_frames(renderer, [CAMERA], [tmp_path / "a.exr"], storage=storage)
    assert not list(tmp_path.iterdir())
