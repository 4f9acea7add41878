"""Levels of detail: what merging keeps, what it does not depend on, and the files and errors of `aaplug lod`."""

import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from threading import get_ident

import pytest
import torch

import aaplug
import aaplug.core.projection
from aaplug import Camera, CameraSet, Gaussians, Renderer, Scene, cameras_around, look_at, read_scene, sh_of_colour
from aaplug.core.chunks import chunks_of
from aaplug.core.conventions import ANTIALIASED, CLASSIC, MIP
from aaplug.core.gaussians import joined
from aaplug.core.imaging import box_average
from aaplug.core.projection import project, quats_of, rotation_matrices
from aaplug.evaluation.metrics import psnr
from aaplug.levels import pairing
from aaplug.levels.clusters import MAX_OPACITY, clusters_of, merge_pairs, pair_moments, rates_of
from aaplug.levels.covariances import area, areas, blur, covariances, overlaps
from aaplug.levels.merging import TOLERANCE, Goal, merge
from aaplug.levels.pairing import ALPHA_WEIGHT, MAX_COST, PIXEL_BLUR, costs, edges_below, matching
from aaplug.methods.conversion import MERGED, blurring
from aaplug.methods.pixel_kernels.surfel import SURFEL
from aaplug.system.errors import FrameError, OutputError, UsageError
from aaplug.system.executors import torch_threads
from tests.conftest import assert_equal, make_camera, make_scene, shuffled

RATE = 20.0  # px per world unit


def pair(opacity: float, apart: float, size: float = 0.2) -> Gaussians:
    """Two round Gaussians beside each other, which both appear at full alpha."""
    scene = replace(make_scene(2), means=torch.tensor([[-apart / 2, 0, 0], [apart / 2, 0.0, 0]]))
    scene.log_scales[:] = math.log(size)
    scene.logit_opacities[:] = torch.tensor(opacity).logit()
    return scene


def level_goal(level: int) -> Goal:
    return Goal(0.5**level, tolerance=TOLERANCE)


def merged_to(count: int, scene: Gaussians, rate: float = RATE) -> Gaussians:
    return merge(scene, torch.full((len(scene),), rate), Goal(min(1.0, math.sqrt(count / len(scene))), count)).scene


def test_a_merged_pair_alone_keeps_the_integral_of_its_alpha():
    """Against a fine grid: the closed form a + b - a b, without a renderer's cut-off."""
    scene = pair(0.7, 0.25)
    rates = torch.full((2,), 1e4)  # training's dilation vanishes
    clusters = clusters_of(scene, rates)
    both = merge_pairs(*(clusters[torch.tensor([place])] for place in range(2)))
    x = torch.linspace(-2, 2, 401, dtype=torch.float64)
    found = []
    for plane in ((0, 1), (1, 2), (2, 0)):
        offsets = [
            [x - mean for x, mean in zip((x[:, None], x[None]), m[list(plane)], strict=True)]
            for m in scene.means.double()
        ]
        one, other = (0.7 * torch.exp(-0.5 * (u * u + v * v) / 0.04) for u, v in offsets)
        found.append((1 - (1 - one) * (1 - other)).sum() * 1e-4)
    expected = both.opacities * areas(both.covs).mean()
    torch.testing.assert_close(torch.stack(found).mean().float(), expected[0], rtol=1e-4, atol=0)


def test_opaque_pairs_never_exceed_the_cap_and_grow_instead():
    scene = pair(0.99, 0.6)
    one = merged_to(1, scene)
    assert one.opacities.item() == pytest.approx(MAX_OPACITY, abs=1e-6)
    plain = clusters_of(scene, torch.full((2,), RATE))
    moments = merge_pairs(*(plain[torch.tensor([place])] for place in range(2)))
    assert moments.opacities.item() > 1
    assert area(covariances(one)).item() > area(moments.covs).item() * 1.02


@pytest.mark.parametrize("convention", [CLASSIC, ANTIALIASED, MIP])
def test_two_equal_gaussians_of_half_the_depth_become_one(convention):
    """Merging halves at one place gives the shape back; the dilation is taken out again."""
    scene = replace(make_scene(1)[torch.tensor([0, 0])], convention=convention)
    scene.logit_opacities[:] = torch.tensor(0.1).logit()
    one = merged_to(1, scene)
    torch.testing.assert_close(covariances(one), covariances(scene[:1]), rtol=2e-3, atol=1e-6)
    torch.testing.assert_close(one.sh, scene[:1].sh)
    assert 0.18 < one.opacities.item() < 0.2  # 0.2 less what they hide of each other


def test_counts_are_met_exactly():
    scene = make_scene(120)
    assert [len(merged_to(count, scene)) for count in (1, 30, 119)] == [1, 30, 119]
    assert merged_to(120, scene) is scene


def test_costs_are_those_of_the_overlaps_of_both_gaussians_and_the_merged_one():
    scene = make_scene(40, dtype=torch.float64)
    clusters = clusters_of(scene, torch.linspace(10, 30, 40))
    one, other = torch.arange(39), torch.arange(1, 40)
    a, b = clusters[one], clusters[other]
    _, share, covs = pair_moments(a, b)
    px2 = (a.rates * 0.5).square()
    middle = a.means + (1 - share)[:, None] * (b.means - a.means)
    alpha = torch.full((39, 1), ALPHA_WEIGHT**0.5, dtype=torch.float64)
    first, second = (c.weights[:, None] * torch.cat([c.colours, alpha], dim=1) for c in (a, b))
    parts = [(a.means, a.covs, first), (b.means, b.covs, second), (middle, covs, -first - second)]
    expected = torch.zeros(39, dtype=torch.float64)
    for (m, u, light), (n, v, by) in product(parts, parts):
        through = overlaps(blur(u + v, 2 * PIXEL_BLUR / px2), n - m).mean(dim=1)
        expected += (light * by).sum(dim=1) * through * px2
    torch.testing.assert_close(costs(clusters, one, other, 0.5), expected)
    cheap = expected <= expected.median()
    found = costs(clusters, one, other, 0.5, expected.median().item())
    torch.testing.assert_close(found[cheap], expected[cheap])
    assert (found[~cheap] > expected.median()).all()


def test_neighbours_along_several_curves_are_compared_once():
    clusters = clusters_of(make_scene(300), torch.full((300,), RATE))
    fresh = torch.arange(300) % 7 == 0
    for edges in (edges_below(clusters, 1.0, math.inf), edges_below(clusters, 1.0, math.inf, 0.0, fresh)):
        assert (edges.one < edges.other).all()
        assert len((300 * edges.one + edges.other).unique()) == len(edges)


def test_equal_gaussians_are_merged_too():
    """Equal costs must not leave every cluster preferring its neighbour."""
    scene = make_scene(1)[torch.zeros(200, dtype=torch.long)]
    clusters = clusters_of(scene, torch.full((200,), RATE))
    pairs = matching(edges_below(clusters, 1.0, math.inf), 200)
    assert len(pairs) > 60
    assert len(set(pairs.one.tolist()) | set(pairs.other.tolist())) == 2 * len(pairs)
    assert len(merged_to(3, scene)) == 3


def test_the_order_of_the_scene_plays_no_part():
    scene = make_scene(300)
    assert_equal(*(merged_to(60, s) for s in (scene, shuffled(scene, 1))))


def test_the_number_of_threads_plays_no_part(sample_scene):
    scene, found = sample_scene[::16], []
    for threads in (1, 2):
        with torch_threads(threads):
            found.append(merged_to(len(scene) * 9 // 10, scene, rate=200.0))
    assert_equal(*found)


def test_batches_of_chunks_may_be_merged_by_several_threads(monkeypatch):
    monkeypatch.setattr("aaplug.levels.merging.GAUSSIANS_PER_BATCH", 100)
    scene, goal = make_scene(700), Goal(0.25, tolerance=1e-2)
    chunks, told = chunks_of(scene.means, 50), []

    def merged(threads: int):
        with torch_threads(threads):
            rates = torch.full((700,), RATE)
            return merge(scene, rates, goal, lambda *done: told.append((done, get_ident())), chunks=chunks)

    one, three = merged(1), merged(3)
    assert len(one.scene) < 600
    assert_equal(one.scene, three.scene)
    assert torch.equal(one.chunks, three.chunks)
    assert torch.equal(one.parents, three.parents)
    assert torch.equal(one.parents.unique(), torch.arange(len(one.scene)))
    assert torch.equal(one.chunks[one.parents], chunks)
    alone = one.parents.bincount()[one.parents] == 1
    assert_equal(one.scene[one.parents[alone]], scene[alone])
    assert len({thread for _, thread in told}) > 1
    assert max(done for done, _ in told) == (700, 700)


def test_what_is_large_stays_and_what_is_small_is_merged():
    large, small = make_scene(50), make_scene(400, seed=1)
    large.log_scales[:] = math.log(0.3)
    large.sh[:, 0] += torch.linspace(-2, 2, 50)[:, None]
    small.means[:] = 0.02 * small.means + 3
    small.log_scales[:] = math.log(0.002)
    found = merge(joined([large, small]), torch.full((450,), RATE), level_goal(1)).scene
    near = found.means.min(dim=1).values > 2
    assert int((~near).sum()) > 45
    assert int(near.sum()) < 40


def test_what_falls_below_a_size_is_merged_whatever_it_changes():
    near = torch.tensor([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [3.0, 0.0, 0.0], [3.5, 0.0, 0.0]])
    scene = replace(make_scene(4), means=near, log_scales=torch.full((4, 3), math.log(0.01)))
    goals = [Goal(0.5, tolerance=1e-12, smallest=px) for px in (0.0, 0.5, 100.0)]
    everywhere, one = torch.full((4,), RATE), torch.zeros(4, dtype=torch.int64)
    counts = [len(merge(scene, everywhere, goal, chunks=one)[0]) for goal in goals]
    assert counts == [4, 3, 1]


def test_a_lighter_scene_looks_like_the_scene(sample_scene, sample_cameras):
    rates = rates_of(sample_scene, sample_cameras.train)
    view = sample_cameras.test[0]
    truth = Renderer.of(sample_scene, sample_cameras, quality="best", background="white")(view.scaled(1 / 8)).rgb
    level = merge(sample_scene, rates, level_goal(3)).scene
    assert len(level) < 0.5 * len(sample_scene)
    image = Renderer.of(level, sample_cameras, background="white")(view.scaled(1 / 8)).rgb
    assert (psnr(image, truth) or 0) > 38
    assert [fusion.method for fusion in level.fused] == [MERGED]
    assert not blurring(level.fused)


SIDE, FOCAL, DISTANCE = 128, 256.0, 4.0  # px, px, world units from the cameras to the board
WIDTHS, CELL, SPACING = (0.5, 1.0, 2.0, 3.0, 4.0), 8, 2.0  # px: of wires, of the board's cells, between Gaussians
THICKNESS = 0.05  # px, of the board and the thinnest wires
TRAIN_VIEWS, TEST_VIEWS = 12, 3


def across_the_view(x, y, sizes, angle, opacity, colours, distance) -> Gaussians:
    """Gaussians across the axis z at a distance from the cameras; places [n] and sizes [3] in px there."""
    px = distance / FOCAL
    means = torch.stack([x * px, y * px, torch.full_like(x, DISTANCE - distance)], dim=1)
    turns = torch.tensor([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]).repeat(len(x), 1)
    logits, sh = torch.full_like(x, opacity).logit(), sh_of_colour(colours.expand(len(x), 3))[:, None]
    return Gaussians(means, turns, (torch.tensor(sizes) * px).log().repeat(len(x), 1), logits, sh)


def wires_over_checkerboard() -> tuple[Gaussians, CameraSet]:
    """Wires about a px in front of a grey checkerboard, and cameras that look at its middle.

    A wire is a chain of long Gaussians.  Its width is that of an opaque bar with the same alpha across it.  A wire
    thinner than training's dilation is transparent instead, as training makes it.
    """
    g = torch.Generator().manual_seed(0)
    places = torch.arange(-0.8 * SIDE, 0.8 * SIDE, SPACING)
    x, y = (grid.flatten() for grid in torch.meshgrid(places, places, indexing="xy"))
    greys = torch.tensor([0.35, 0.75])[((x / CELL).floor() + (y / CELL).floor()).remainder(2).long()]
    x, y = (v + 0.3 * SPACING * torch.rand(len(v), generator=g) for v in (x, y))
    size = 0.6 * SPACING
    parts = [across_the_view(x, y, [size, size, THICKNESS], 0.0, 0.95, greys[:, None], DISTANCE)]
    along = torch.arange(-0.6 * SIDE, 0.6 * SIDE, SPACING)
    for number, width in enumerate(WIDTHS):
        across = (number + 0.5 - len(WIDTHS) / 2) * 0.75 * SIDE / len(WIDTHS)
        angle = 0.35 * math.pi + 0.1 * float(torch.rand((), generator=g))
        x = along * math.cos(angle) - across * math.sin(angle)
        y = along * math.sin(angle) + across * math.cos(angle)
        seen = max(CLASSIC.kernel + THICKNESS**2, (width / 0.95) ** 2 / math.tau)  # px², across the wire
        thin = math.sqrt(seen - CLASSIC.kernel)
        # neighbours in the chain overlap: 1 - (1 - a)^k of k that cover a place
        opacity = 1 - (1 - min(0.99, width / math.sqrt(math.tau * seen))) ** (1 / (0.6 * math.sqrt(math.tau)))
        red = torch.tensor([0.9, 0.1, 0.1])
        parts.append(across_the_view(x, y, [size, thin, thin], angle, opacity, red, 0.995 * DISTANCE))
    views = []
    for number in range(TRAIN_VIEWS + TEST_VIEWS):
        eye = torch.tensor([*(0.15 * DISTANCE * (2 * torch.rand(2, generator=g).double() - 1)), DISTANCE]).double()
        pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        views.append(Camera(f"view {number}", SIDE, SIDE, FOCAL, FOCAL, SIDE / 2, SIDE / 2, pose))
    return joined(parts), CameraSet(tuple(views[:TRAIN_VIEWS]), tuple(views[TRAIN_VIEWS:]))


@pytest.mark.parametrize(("level", "least", "blind"), [(2, 0.9, 0.85), (3, 0.8, 0.5)])
def test_thin_things_keep_their_contrast(level, least, blind, monkeypatch):
    """Wires 0.5 to 4 px wide close to a board; merging to the same count by distance alone loses them."""
    scene, cameras = wires_over_checkerboard()
    look, rates, factor = Renderer.of(scene, cameras, "matched"), rates_of(scene, cameras.train), 2**level

    def redness(images):
        """The wires' alone, as the board is grey."""
        return torch.cat([(rgb[..., 0] - rgb[..., 1:].mean(dim=2)).flatten() for rgb in images])

    truth = redness(box_average(look(view).rgb, factor) for view in cameras.test)
    truth = truth - truth.mean()

    def contrast(found):
        """The slope of a regression on the scene's box averages: 1 is all."""
        drawn = redness(look.showing(found)(view.scaled(1 / factor)).rgb for view in cameras.test)
        return float((drawn * truth).sum() / truth.square().sum())

    found = merge(scene, rates, level_goal(level)).scene
    assert least < contrast(found) < 1.1

    def distances(clusters, one, other, rate, most):
        return (clusters.means[other] - clusters.means[one]).square().sum(dim=1).float()

    monkeypatch.setattr(pairing, "costs", distances)
    assert contrast(merge(scene, rates, Goal(0.5**level, len(found))).scene) < blind


def test_without_cameras_levels_are_for_the_orbits_views():
    scene = make_scene(101)
    (found,) = aaplug.lod(scene, simplify=0.2, refine=False)
    (expected,) = aaplug.lod(scene, cameras_around(Scene.in_memory(scene), aaplug.Orbit()), simplify=0.2, refine=False)
    assert torch.equal(found.scene.means, expected.scene.means)
    (coarser,) = aaplug.lod(scene, aaplug.Orbit(train_view="160x106"), simplify=0.2, refine=False)
    assert not torch.equal(found.scene.means, coarser.scene.means)


def test_gaussians_that_no_camera_sees_have_the_lowest_rate():
    scene = make_scene(20)
    scene.means[3] = torch.tensor([0.0, -9.0, 0.0])
    rates = rates_of(scene, [make_camera()])
    assert rates[3] == rates[torch.arange(20) != 3].min() > 0
    with pytest.raises(FrameError, match="none of its Gaussians is seen by any of 1 camera"):
        rates_of(replace(scene, means=scene.means + 1000), [make_camera()])


def test_extreme_sizes_and_transparent_gaussians_are_merged():
    scene = make_scene(60)
    scene.log_scales[:20] = 29.0
    scene.log_scales[20:40] = -29.0
    scene.logit_opacities[::2] = -90.0
    found = merged_to(9, scene)
    assert len(found) == 9
    assert all(column.isfinite().all() for column in found.columns.values())
    clusters = clusters_of(scene, torch.full((60,), RATE))
    assert (costs(clusters, torch.arange(59), torch.arange(1, 60), 1.0) <= MAX_COST).all()


def test_rotations_become_quaternions_again():
    scene = make_scene(50, dtype=torch.float64)
    again = quats_of(rotation_matrices(scene.unit_quats))
    torch.testing.assert_close((again * scene.unit_quats).sum(dim=1).abs(), torch.ones(50, dtype=torch.float64))


@pytest.mark.parametrize(("place", "eye"), [(1, (-1000.0, 0.0, 0.0)), (2, (0.0, -1000.0, 0.0))])  # across x and y
def test_areas_are_those_of_splats_seen_along_an_axis_from_far_away(place, eye):
    scene, camera = make_scene(5, dtype=torch.float64), make_camera(eye, (64, 64))
    scene.means[:] = 0
    expected = 2 * math.pi * project(scene, camera).dets.sqrt() * (1000 / camera.fx) ** 2
    torch.testing.assert_close(areas(covariances(scene))[:, place], expected, rtol=1e-3, atol=0)


def test_one_lighter_scene(cli):
    facts = cli.facts("lod scene.ply --cameras . -o light.ply --simplify 0.2 --steps 1")
    assert facts["levels"] == [{"rate": pytest.approx(0.2**0.5), "gaussians": 30}]
    found = read_scene(Path("light.ply")).gaussians()
    assert (len(found), found.convention) == (30, CLASSIC)
    assert found.fused[0].settings == {"rate": "0.4472", "from": "150"}
    cli.done("lod scene.ply --cameras . -o counted.ply --simplify 12 --no-refine")
    assert read_scene(Path("counted.ply")).count == 12
    cli.done("lod scene.ply --cameras . -o budget.ply --budget 0.01 --no-refine")
    assert 8_000 < Path("budget.ply").stat().st_size <= 10_000


def test_what_no_camera_sees_stays_when_all_else_is_too_faint():
    cameras = [make_camera(eye, (640, 480)) for eye in ((0.0, -4.0, 0.0), (3.0, -2.0, 1.0))]
    scene = replace(make_scene(4), log_scales=torch.full((4, 3), -7.0), logit_opacities=torch.full((4,), -2.0))
    scene.means[3] = torch.tensor([0.0, -40.0, 0.0])
    scene.log_scales[3], scene.logit_opacities[3] = -2.0, 4.0
    levels = aaplug.lod(scene, CameraSet(tuple(cameras), ()), levels=5, refine=False, min_seen=0.0)
    sizes = [len(level.scene) for level in levels]
    assert (sizes[0], sizes[-2:]) == (4, [1, 1])


def test_a_level_may_have_no_gaussians(tmp_path):
    """What is too faint to be drawn at a size is in no level from there on."""
    faint = replace(make_scene(3), log_scales=torch.full((3, 3), -7.0), logit_opacities=torch.full((3,), -4.0))
    views = (make_camera(size=(640, 480)),)
    levels = aaplug.lod(faint, CameraSet(views, ()), tmp_path, levels=4, refine=False, min_seen=0.0)
    pyramid = aaplug.read_scene(tmp_path).levels
    assert pyramid.sizes == tuple(len(level.scene) for level in levels)
    assert (pyramid.sizes[0], pyramid.sizes[-1]) == (3, 0)
    renderer = aaplug.Renderer.of(pyramid, views, quality="fast", rasterizer="eager")
    assert renderer(views[0].scaled(1 / 16)).alpha.max() == 0


def test_levels_of_discs_are_discs_across_the_thinnest_axes_of_what_they_merge(tmp_path):
    """Two discs side by side in a plane become one in it, as wide as 3D Gaussians would become."""
    pair = replace(make_scene(2), quats=torch.tensor([[0.9, 0.3, 0.2, 0.1]]).expand(2, 4), flat=True)
    pair = replace(pair, log_scales=torch.tensor([[-2.0, -2.0, -30.0]]).expand(2, 3))
    plane = rotation_matrices(pair.unit_quats)[0]
    pair = replace(pair, means=plane[:, 0] * torch.tensor([[-0.02], [0.02]]))
    solid = replace(pair, flat=False)
    goal = Goal(math.sqrt(1 / 2), 1)
    one, other = (merge(scene, torch.full((2,), 50.0), goal).scene for scene in (pair, solid))
    scales = one.log_scales[0]
    assert one.flat
    assert scales[2] == -30
    torch.testing.assert_close(scales[:2], other.log_scales[0].sort(descending=True).values[:2])
    normal = rotation_matrices(one.unit_quats)[0, :, 2]
    assert abs(normal @ plane[:, 2]) > 1 - 1e-5
    views = (make_camera(), make_camera((3.0, -2.0, 1.0)))
    levels = aaplug.lod(pair, CameraSet(views, ()), tmp_path, levels=1, steps=1, rasterizer="eager")
    drawn = aaplug.Renderer.of(aaplug.read_scene(tmp_path), views, rasterizer="eager")
    assert all(level.scene.flat for level in levels)
    assert drawn.recipe.pixel is SURFEL
    assert drawn(views[0].scaled(1 / 4)).rgb.isfinite().all()


def test_what_cannot_be_merged_is_refused(tmp_path):
    scene, views = make_scene(9), aaplug.CameraSet((make_camera(),), (make_camera(),))
    away, discs = replace(scene, means=scene.means + 1000), replace(scene, flat=True)
    for error, said, given, how in (
        (UsageError, r"simplify: above 1 is a count: expected a whole number, got 2\.5", [scene], {"simplify": 2.5}),
        (UsageError, "2D Gaussians, whose levels only aaplug draws", [discs], {"simplify": 0.5, "viewer": "spark"}),
        (UsageError, "no Gaussians", [make_scene(0)], {"simplify": 0.5}),
        (FrameError, "different frames", [away, views], {"simplify": 0.5}),
    ):
        with pytest.raises(error, match=said):
            aaplug.lod(*given, **how)
    (tmp_path / "scene_lod1.ply").touch()
    with pytest.raises(OutputError, match=r"already holds scene_lod1.*or `resume` to go on"):
        aaplug.lod(make_scene(9), output=tmp_path, levels=1)
