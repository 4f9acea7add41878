"""Pyramids: what a view draws of them, the laws that its cut keeps, the files that hold them, and what views show."""

import itertools
import json
import math
import shutil
import statistics
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import aaplug
from aaplug import VIEWERS, CameraSet, FormatError, Monitor, TrainingViews, lod, read_scene
from aaplug.core import pyramids
from aaplug.core.camera_paths import between, free_views, moved
from aaplug.core.chunks import chunks_of
from aaplug.core.conventions import ANTIALIASED
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, ORTHO, PINHOLE
from aaplug.core.pyramids import Cutter, Pyramid, faded
from aaplug.core.sights import sights
from aaplug.evaluation.engine import Task, evaluate, renderers_of
from aaplug.evaluation.metrics import psnr
from aaplug.evaluation.results import mean
from aaplug.evaluation.truth import Truth
from aaplug.finetuning import refining
from aaplug.io.rad import node_sizes, shown_of
from aaplug.io.scenes.pyramid_folder import MANIFEST, read_manifest, read_pyramid
from aaplug.levels.clusters import clusters_of, merge_pairs
from aaplug.levels.merging import Goal, merge
from aaplug.methods.presets import find_recipe, recipe_of
from aaplug.methods.recipe import LevelChoice, Recipe
from aaplug.rendering.renderer import Renderer, own_look
from aaplug.rendering.visibility import visibility
from aaplug.system.executors import torch_threads
from tests.conftest import made_by, make_camera, make_scene, make_splats

RATE = 20.0  # px per world unit
VIEWS = tuple(make_camera(eye, (64, 48)) for eye in ((0.0, -4.0, 0.0), (3.0, -2.0, 1.0), (-3.0, -2.0, 0.5)))
FAR = (0.0, -30.0, 4.0)  # from here everything is in the image


def rates(scene: Gaussians) -> torch.Tensor:
    return torch.full((len(scene),), RATE)


@pytest.fixture(scope="module")
def levels() -> Pyramid:
    """Merged without tuning."""
    scenes, chunks = [make_scene(300)], [chunks_of(make_scene(300).means, 40)]
    for level in range(1, 4):
        goal = Goal(0.5**level, tolerance=1e-2)
        scene, _, places, _ = merge(scenes[-1], rates(scenes[-1]), goal, chunks=chunks[-1])
        scenes.append(scene)
        chunks.append(places)
    return Pyramid.of(scenes, chunks)


@pytest.fixture(scope="module")
def renderer(levels) -> Renderer:
    return Renderer.of(levels, CameraSet(VIEWS, VIEWS), "auto", quality="fast", rasterizer="eager")


def test_the_shares_of_a_chunk_sum_to_one():
    scene, octaves = make_scene(5), torch.linspace(0, 5, 501)
    whole = Pyramid.of([scene] * 6, [torch.zeros(5, dtype=torch.int64)] * 6)
    cutter = Cutter.of(whole, TrainingViews.of(whole.scene, VIEWS))
    shares = torch.cat([cutter.shares(octave[None]) for octave in octaves], dim=1)
    torch.testing.assert_close(shares.sum(dim=0), torch.ones(501))
    assert (shares > 0).sum(dim=0).max() <= 2
    assert shares.min() >= 0
    meant = shares.gather(0, octaves.ceil().long()[None])  # the level that is meant for this rate
    assert (meant > 0).all()


def test_levels_become_lighter_and_stand_for_their_own_chunk_alone(levels):
    """Painted by chunk, every merged Gaussian keeps its chunk's colour."""
    assert list(levels.sizes) == sorted(levels.sizes, reverse=True)
    assert levels.sizes[-1] < levels.sizes[0] / 3
    finest = levels.finest
    chunks = levels.chunks[: levels.sizes[0]]
    painted = replace(finest, sh=chunks.float()[:, None, None].expand_as(finest.sh).clone())
    coarse, _, places, _ = merge(painted, rates(painted), Goal(0.25, tolerance=1e3), chunks=chunks)
    assert len(coarse) < len(finest) / 3
    assert torch.allclose(coarse.sh[:, 0, 0], places.float(), atol=1e-3)


def test_chunks_are_boxes_of_bounded_size_whatever_the_order():
    scene = make_scene(1000)
    chunks = chunks_of(scene.means, 50)
    assert torch.bincount(chunks).max() <= 50
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(1))
    assert torch.equal(chunks_of(scene.means[order], 50), chunks[order])
    numbers = range(int(chunks.max()) + 1)
    low, high = (
        torch.stack([getattr(scene.means[chunks == c], how)(dim=0).values for c in numbers]) for how in ("min", "max")
    )
    inside = ((scene.means[:, None] >= low) & (scene.means[:, None] <= high)).all(dim=2)
    assert (inside.sum(dim=1) == 1).all()
    assert int(chunks_of(torch.zeros(200, 3), 50).max()) == 0  # coincident Gaussians cannot be told apart


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_from_the_training_rate_on_the_image_is_the_scenes_own_to_the_bit(levels, renderer, scale):
    alone = Renderer.of(levels.finest, VIEWS, "auto", quality="fast", rasterizer="eager")
    for view in VIEWS:
        assert torch.equal(renderer(view.scaled(scale)).rgb, alone(view.scaled(scale)).rgb)


def test_a_pyramid_of_one_level_is_the_scene(levels):
    one = Pyramid.of([levels.finest], [levels.chunks[: levels.sizes[0]]])
    view = VIEWS[0].scaled(0.25)
    images = [Renderer.of(s, VIEWS, "matched", rasterizer="eager")(view).rgb for s in (one, levels.finest)]
    images.append(Renderer.of(one, VIEWS, "auto", quality="fast", rasterizer="eager")(view).rgb)
    assert torch.equal(images[0], images[1])
    assert torch.equal(images[2], images[1])


def test_pixels_larger_than_those_of_the_coarsest_level_take_several_samples(levels, renderer):
    """As many as reach that level's rate, but no more than without levels."""
    assert len(levels) == 4
    samples = [renderer.samples(VIEWS[0].scaled(0.5**k)) for k in range(7)]
    assert samples == [1, 1, 1, 1, 2, 4, 8]
    one = Pyramid.of([levels.finest], [levels.chunks[: levels.sizes[0]]])
    alone, same = (Renderer.of(s, VIEWS, "auto", quality="fast", rasterizer="eager") for s in (levels.finest, one))
    for k in range(7):
        assert same.samples(VIEWS[0].scaled(0.5**k)) == alone.samples(VIEWS[0].scaled(0.5**k))


@pytest.mark.parametrize("eye", [(0.0, -4.0, 0.0), (0.3, -0.6, 0.2), FAR, (2.0, 0.0, 2.0)])
@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_what_is_left_out_shows_nothing(renderer, eye, scale, monkeypatch):
    """Also with the camera in the scene, and looking past it."""
    view = replace(make_camera(eye, (48, 40), 0.5), trained_focal=None).scaled(scale)
    drawn, image = len(renderer.cutter(view)), renderer(view).rgb
    monkeypatch.setattr(pyramids, "_reaches", lambda frustum, places, room: torch.ones_like(room, dtype=torch.bool))
    assert (len(renderer.cutter(view)) > drawn) == (eye != FAR)
    assert torch.equal(renderer(view).rgb, image)


def test_a_view_past_the_scene_draws_nothing(renderer):
    away = make_camera((0.0, -40.0, 0.0))
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64)) @ away.cam_from_world
    view = replace(away, cam_from_world=turned, trained_focal=None)
    assert len(renderer.cutter(VIEWS[0])) > 0
    assert len(renderer.cutter(view)) == 0
    assert (renderer(view).rgb == 0).all()


def test_where_the_coarsest_level_shows_nothing_the_next_one_tells_a_free_cameras_rate(levels):
    empty = levels.finest[:0]
    chunks = levels.chunks.split(list(levels.sizes))
    parts = [levels.level(number) for number in range(len(levels))]
    more = Pyramid.of([*parts, empty], [*chunks, chunks[0][:0]])
    view = moved(VIEWS[0], 4 / 16, 4.0)
    rates = [Renderer.of(s, VIEWS, "auto", rasterizer="eager").relative_rate(view) for s in (levels, more)]
    assert rates[0] == rates[1] < 0.5


def test_a_near_part_is_fine_and_a_far_part_coarse():
    near, far = make_scene(60), make_scene(60, seed=1)
    near.means[:] *= 0.1
    far.means[:] = 0.1 * far.means + torch.tensor([0.0, 40.0, 0.0])
    both = Gaussians(**{name: torch.cat([getattr(near, name), getattr(far, name)]) for name in near.columns})
    chunks = torch.arange(2).repeat_interleave(60)
    coarse, _, places, _ = merge(both, rates(both), Goal(0.25, tolerance=1e3), chunks=chunks)
    whole = Pyramid.of([both, coarse, coarse], [chunks, places, places])
    view = make_camera((0.0, -4.0, 0.0), (640, 480))
    cutter = Cutter.of(whole, TrainingViews.of(whole.scene, [view]))
    octaves = cutter.octaves(replace(view, trained_focal=None))
    assert octaves[0] == octaves[1] == 0  # each as training saw it
    octaves = cutter.octaves(moved(view, 4 / 6, 4.0))
    assert octaves[0] > octaves[1] > 0


@pytest.mark.parametrize("lens", [PINHOLE, ORTHO, EQUIRECT, EQUIDISTANT], ids=lambda lens: lens.kind)
def test_a_free_camera_draws_the_level_of_its_rate_through_any_lens(lens):
    """Of a point 37° off the axis, where a panorama and a fisheye sample more finely than on it."""
    scene = make_scene(3)
    scene.means[:] = torch.tensor([0.0, 0.0, 1.5])
    whole = Pyramid.of([scene] * 5, [torch.zeros(3, dtype=torch.int64)] * 5)
    far, near = make_camera((0.0, -12.0, 0.0), (640, 480)), make_camera((0.0, -2.0, 0.0), (640, 480))
    factor = 1 / 64 if lens != ORTHO else 1 / 128  # an orthographic focal length is px per world unit
    free = replace(near, fx=near.fx * factor, fy=near.fy * factor, trained_focal=None, lens=lens)
    cutter = Cutter.of(whole, TrainingViews.of(whole.scene, [far]))
    rate, trained = float(sights(scene.means, free).rates[0]), float(cutter.lowest)
    assert 0 < (octaves := math.log2(trained / rate)) < 4
    assert float(cutter.octaves(free)) == pytest.approx(octaves, abs=1e-4)


@pytest.mark.parametrize("opacity", [0.3, 0.6, 0.98])
@pytest.mark.parametrize("octave", [0.04, 0.2, 0.4])
def test_two_levels_that_agree_keep_the_energy(opacity, octave):
    """The sum of alpha, of which the cut-off takes a little."""
    scene, camera = make_scene(1), make_camera((0.0, -4.0, 0.0), (640, 480))
    scene.means[:], scene.log_scales[:], scene.logit_opacities[:] = 0.0, -1.2, torch.tensor(opacity).logit()
    whole = Pyramid.of([scene] * 2, [torch.zeros(1, dtype=torch.int64)] * 2)
    view = camera.scaled(0.5**octave)
    both, alone = (Renderer.of(s, [camera], "auto", quality="fast", rasterizer="eager") for s in (whole, scene))
    assert both.cutter is not None
    assert both.cutter(view).shares is not None
    assert both(view).alpha.sum() == pytest.approx(float(alone(view).alpha.sum()), rel=0.02)


def test_a_whole_share_is_the_splat_to_the_bit():
    splats = make_splats(50, (48, 64))
    assert torch.equal(faded(splats, torch.ones(50)).opacities, splats.opacities)
    assert (faded(splats, torch.full((50,), 0.5)).opacities < splats.opacities).all()


def test_between_two_levels_an_image_is_about_as_close_to_the_scene_as_with_either(sample_scene, sample_cameras):
    """Of optical depths, or of opacities in the world, fades are 4 to 10 dB farther."""
    scene, view = sample_scene[::8], sample_cameras.test[0].scaled(1 / 2).as_trained()
    cameras = CameraSet(tuple(camera.scaled(1 / 2).as_trained() for camera in sample_cameras.train[::8]), (view,))
    made = lod(scene, cameras, levels=2, refine=False)
    pyramid = Pyramid.of([level.scene for level in made], [level.chunks for level in made])
    fast = Renderer.of(pyramid, cameras, quality="fast")
    best = Renderer.of(scene, cameras, quality="best")
    psnrs = [psnr(fast(view.scaled(rate)).rgb, best(view.scaled(rate)).rgb) or 0.0 for rate in (0.5, 0.43, 0.374)]
    assert psnrs[1] > min(psnrs[0], psnrs[2]) - 1


def test_a_dolly_does_not_pop(renderer):
    """Steps of 1/20 octave away from the scene: no step changes the image much more than its neighbours do."""
    images = [renderer(moved(VIEWS[0], 2 ** (-step / 20), 4.0)).rgb for step in range(61)]
    changes = torch.stack([(b - a).abs().max() for a, b in itertools.pairwise(images)])
    assert changes.max() < 3 * changes.median()


def test_gradients_reach_the_levels_of_a_cut(renderer, levels):
    """Half-way between two levels, against finite differences in float64."""
    view = VIEWS[0].scaled(0.42)
    scene = levels.scene.to(torch.float64)
    weights = torch.rand(view.height, view.width, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss(logits: torch.Tensor) -> torch.Tensor:
        shown = replace(renderer, scene=replace(scene, logit_opacities=logits))
        return (shown(view).rgb * weights).sum()

    cut = renderer.cutter(view)
    assert cut.shares is not None
    assert 0 < cut.shares.min() < 1
    logits = scene.logit_opacities.clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, logits, rtol=1e-4, atol=1e-6, fast_mode=True)


def test_views_between_two_cameras():
    first, last = VIEWS[0], VIEWS[2]
    for share, expected in ((0.0, first), (1.0, last)):
        assert torch.allclose(between(first, last, share).cam_from_world, expected.cam_from_world, atol=1e-9)
    middle = between(first, last, 0.5)
    turn = middle.cam_from_world[:3, :3]
    assert torch.allclose(turn @ turn.T, torch.eye(3, dtype=turn.dtype), atol=1e-12)
    assert torch.allclose(middle.centre, (first.centre + last.centre) / 2)
    assert torch.equal(between(first, first, 0.3).cam_from_world, first.cam_from_world)
    assert len(free_views(VIEWS, 2)) == 6
    assert not free_views(VIEWS[:1], 2)
    assert all(view.trained_focal is None for view in free_views(VIEWS, 1))


# ----------------------------------------------------------------------------------------------- files and commands


@pytest.fixture(scope="module")
def built(dataset, tmp_path_factory) -> Path:
    """A folder of levels, made by the command in a copy of the data set."""
    words = "lod scene.ply --cameras . -o levels --levels 2 --steps 1"
    return made_by(words, dataset, tmp_path_factory.mktemp("built")) / "levels"


@pytest.fixture
def folder(cli, built) -> Path:
    shutil.copytree(built, "levels")
    return Path("levels")


def test_a_folder_of_levels_is_a_scene(cli, folder):
    whole, manifest = read_pyramid(folder), read_manifest(folder)
    assert [level.rate for level in manifest.levels] == [1.0, 0.5, 0.25]
    assert [sum(level.chunks) for level in manifest.levels] == list(whole.sizes)
    assert (folder / "scene_lod0.ply").read_bytes() == Path("scene.ply").read_bytes()
    fused = [fusion.settings for fusion in read_scene(folder / "scene_lod2.ply").gaussians().fused]
    assert [settings["rate"] for settings in fused if "rate" in settings] == ["0.5", "0.25"]
    for quality in ("fast", "best"):
        cli.done(f"render levels --cameras . -o out-{quality} --scale 0.25 --quality {quality}")
    cli.done("evaluate levels --cameras . -o results --scale 0.5 --recipe auto matched --truth self")
    assert "3 levels of detail" in cli("info levels")[1]
    cli.done("convert levels --cameras . -o converted.ply")
    cli.done("lod levels --cameras . -o light.ply --simplify 0.5 --no-refine")


class Interrupting(Monitor):
    """Ends a run once the second level is merged."""

    def say(self, text: str) -> None:
        if "0.25 × the training rate" in text:
            raise KeyboardInterrupt


def test_building_goes_on_where_it_stopped(cli, folder):
    first = {file.name: file.read_bytes() for file in folder.iterdir()}
    shutil.rmtree(folder)
    with pytest.raises(KeyboardInterrupt):
        lod("scene.ply", ".", folder, levels=2, steps=1, monitor=Interrupting())
    assert {file.name: file.read_bytes() for file in folder.glob("*.ply")}.items() < first.items()
    cli.refused("info levels", "lists 2 of 3 levels, as making them was interrupted; `aaplug lod --resume`")
    _, err = cli.done("lod scene.ply --cameras . -o levels --levels 2 --steps 1 --resume")
    assert "resumed with 1 level" in err
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == first
    cli.refused("lod scene.ply --cameras . -o levels --levels 2 --steps 2 --resume", "other options")


def test_fewer_levels_leave_nothing_of_more(cli, folder):
    names, words = ["scene_lod0.ply", "scene_lod1.ply"], "lod scene.ply --cameras . -o levels --levels 1"
    cli.done(f"{words} --no-refine --overwrite")
    assert sorted(file.name for file in folder.iterdir()) == [MANIFEST, *names]
    (folder / "notes.txt").write_text("not a level")
    assert read_scene(folder).bytes == sum((folder / name).stat().st_size for name in (MANIFEST, *names))
    cli.done(f"{words} --steps 16 --for spark --overwrite")  # files by a viewer's rule, and no pyramid
    assert sorted(file.name for file in folder.iterdir()) == ["notes.txt", *names]
    for name in names:
        assert b"fused=finetune steps=16 for=spark" in (folder / name).read_bytes()
        assert read_scene(folder / name).gaussians().convention == ANTIALIASED
    for more, said in (("--resume", "levels for aaplug"), ("--no-refine", "is what the result is tuned for")):
        cli.refused(f"{words} --for spark {more}", said)


def test_an_earlier_runs_levels_go_whatever_they_are_called_and_no_input_does(cli, folder):
    words = "--cameras . -o levels --levels 1 --no-refine --overwrite"
    cli.refused(f"lod levels/scene_lod2.ply {words}", "scene_lod2.ply: is also the input")
    Path("scene.ply").rename("other.ply")
    Path("levels/other_lod2.ply").write_bytes(b"of a viewer, so in no manifest")
    cli.done(f"lod other.ply {words}")
    assert sorted(file.name for file in folder.iterdir()) == [MANIFEST, "other_lod0.ply", "other_lod1.ply"]


def in_manifest(**changes):
    """Change the second level in the manifest."""

    def change(_: Path, manifest: Path) -> None:
        document = json.loads(manifest.read_text())
        document["levels"][1] |= changes
        manifest.write_text(json.dumps(document))

    return change


def edit_middle(level: Path) -> None:
    data = bytearray(level.read_bytes())
    data[len(data) // 2] ^= 1
    level.write_bytes(data)


BROKEN = {
    "missing": (lambda level, _: level.unlink(), "scene_lod1.ply: is missing"),
    "truncated": (lambda level, _: level.write_bytes(level.read_bytes()[:-7]), "scene_lod1.ply: is not the level"),
    "edited": (lambda level, _: edit_middle(level), "scene_lod1.ply: is not the level"),
    "foreign": (lambda level, _: level.with_name("scene_lod2.ply").replace(level), "scene_lod1.ply: is not the level"),
    "newer": (lambda _, manifest: manifest.write_text('{"aaplug_levels": 3}'), "should be version 2, not version 3"),
    "older": (lambda _, manifest: manifest.write_text('{"aaplug_levels": 1}'), "lod --overwrite` makes the levels"),
    "too large": (in_manifest(chunks=[2**64]), "chunks should be a list of counts"),
    "largest": (lambda _, manifest: manifest.write_text(manifest.read_text().replace("1024", str(2**64))), "largest"),
    "outside": (in_manifest(file="../scene.ply"), "file should be a name without folders"),
    "chunks": (in_manifest(chunks=[10**9]), "does not have the chunks"),
    "empty": (lambda _, manifest: manifest.write_text("{}"), "lod.json"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_pyramid_is_refused_in_one_line(built, tmp_path, case):
    breaking, said = BROKEN[case]
    folder = Path(shutil.copytree(built, tmp_path / "levels"))
    breaking(folder / "scene_lod1.ply", folder / MANIFEST)
    with pytest.raises(FormatError, match=f"^[^\\n]*{said}[^\\n]*$"):
        Renderer.of(folder, VIEWS)


def test_tuning_brings_a_level_closer(sample_scene, sample_cameras):
    small = [view.scaled(0.25).as_trained() for view in (*sample_cameras.train[:4], sample_cameras.test[0])]
    few = CameraSet(tuple(small[:4]), tuple(small[4:]))
    scene, view = sample_scene[::12], few.test[0].scaled(0.25)
    truth = Renderer.of(scene, few, "auto", quality="best")(view).rgb
    (merged,) = aaplug.lod(scene, few, simplify=0.1, scale=0.25, refine=False)
    for viewer, recipe in ((None, "matched"), ("spark-classic", "classic")):
        (tuned,) = aaplug.lod(scene, few, simplify=0.1, scale=0.25, steps=20, viewer=viewer)
        assert len(merged.scene) == len(tuned.scene)
        shown = (Renderer.of(s.scene, few, recipe)(view).rgb for s in (merged, tuned))
        before, after = ((image - truth).square().mean() for image in shown)
        assert after < 0.9 * before


def test_tuning_a_tree_brings_what_spark_draws_of_it_closer(tmp_path, monkeypatch, sample_scene, sample_cameras):
    def spy(tree, parents, rates, look, *how):
        tuned = refining.refine_tree(tree, parents, rates, look, *how)
        for rate in rates:
            errors = []
            for scene in (tree, tuned):
                distances = (scene.means - view.centre).norm(dim=1)
                shown = shown_of(node_sizes(scene) * rate * view.focal / distances, parents)
                image = replace(look, recipe=recipe_of(VIEWERS["spark"])).showing(scene[shown])(view.scaled(rate)).rgb
                errors.append((image - Truth(look)(view, rate)).square().mean().item())
            shares[rate] = errors[1] / errors[0]
        return tuned

    few = CameraSet(tuple(view.scaled(0.25).as_trained() for view in sample_cameras.train[:5]), ())
    few, view, shares = CameraSet(few.train[:4], ()), few.train[4], {}
    monkeypatch.setattr("aaplug.verbs.lod.refine_tree", spy)
    aaplug.lod(sample_scene[::12], few, tmp_path, levels=2, to="rad", steps=60)
    assert [*shares] == [1.0, 0.5, 0.25]
    assert max(shares.values()) < 0.9


def test_a_level_is_tuned_over_the_rates_that_draw_it_and_on_free_poses_too(sample_cameras):
    """On no more views than steps look at."""
    poses = sample_cameras.train[::6]
    for steps in (1, 5):
        views, probes = refining._views(poses, (0.5,), steps)
        assert 0 < len(views) <= steps
        assert probes
    for some in (poses[:1], poses):
        views, _ = refining._views(some, (0.5,), 10_000)
        trained = [view.width / some[0].width for view in views if view.trained_focal]
        assert min(trained) < 0.9
        assert max(trained) == pytest.approx(1.5, abs=0.01)
        assert all(view.width == some[0].width for view in views if not view.trained_focal)
    assert len(views) > 5
    assert 0.15 < statistics.mean(view.trained_focal is None for view in views) < 0.35
    views, _ = refining._views(poses, (1.0,), 100)  # never above training's rate
    assert max(view.width for view in views) == poses[0].width


CAMERAS = CameraSet(VIEWS[:2], VIEWS[:2])


def in_one_chunk(*counts: int) -> Pyramid:
    """Levels of so many Gaussians, of different scenes."""
    scenes = [make_scene(count) for count in counts]
    return Pyramid.of(scenes, [torch.zeros(len(scene), dtype=torch.int64) for scene in scenes])


def limited_to(levels: Pyramid, **choice: float) -> Renderer:
    renderer = Renderer.of(levels, CAMERAS, rasterizer="eager")
    return replace(renderer, recipe=replace(renderer.recipe, levels=LevelChoice(**choice, finer=1.0)))


@pytest.mark.parametrize(
    ("budget", "share", "expected"),
    [
        *((0, 0.0, 0.5), (50, 0.0, 0.0), (49, 0.0, 0.5), (44, 0.0, 0.5)),
        *((0, 0.25, 0.0), (0, 0.24, 0.5), (50, 0.1, 0.0), (10, 0.25, 0.0)),
    ],
)
def test_balanced_draws_coarser_levels_where_they_are_many_and_a_large_share(budget, share, expected):
    """Of 200 Gaussians, level 1 has 50 and level 2 has 45; a view at 1/8 has 4 samples, at the rate of level 1."""
    limited, view = limited_to(in_one_chunk(200, 50, 45, 5), budget=budget, share=share), VIEWS[0].scaled(1 / 8)
    fine, samples = limited.sampled(view)
    assert samples == limited.samples(view) == 4
    assert limited.coarsening(fine, samples) == expected
    assert limited.cutter is not None
    assert limited.cutter.count(fine, expected) == (50 if expected == 0 else 45)
    assert len(limited.cutter(fine, expected)) > 0
    assert limited.draw(view).splats.sources.tolist() == limited.splats(fine, samples).sources.tolist()


@pytest.mark.parametrize(("quality", "expected"), [("fast", 0.5), ("balanced", 0.0)])
def test_levels_of_several_samples_stay_as_fine_as_the_quality_asks(quality, expected):
    levels = in_one_chunk(200_000, 150_000, 120_000)
    renderer = Renderer.of(levels, CAMERAS, quality=quality, rasterizer="eager")
    assert renderer.coarsening(VIEWS[0].scaled(1 / 2), 2) == expected


@pytest.mark.parametrize("scale", [1 / 4.17, 1 / 5, 1 / 9, 1 / 10, 1 / 10.5])
def test_where_no_level_is_light_enough_the_lightest_is_drawn_alone(scale):
    """And not two that fade."""
    limited = limited_to(in_one_chunk(200, 150, 120))
    fine, samples = limited.sampled(VIEWS[0].scaled(scale))
    assert limited.cutter is not None
    assert limited.cutter(fine, limited.coarsening(fine, samples)).shares is None


def test_evaluation_tells_apart_recipes_that_draw_different_levels():
    levels = in_one_chunk(200, 150, 20)
    training = TrainingViews.of(levels.finest, VIEWS[:2])
    fine = find_recipe("auto")
    coarse = replace(fine, name="coarse", levels=LevelChoice())
    truth = Truth(own_look(levels.finest, training, "eager"))

    def figures(*recipes: Recipe) -> list[float | None]:
        renderers = renderers_of(own_look(levels, training, "eager"), recipes)
        report = evaluate(Task(renderers, (1 / 8,), VIEWS[:1], truth))
        return [mean(report.select(recipe.name, 1 / 8), "PSNR") for recipe in recipes]

    assert figures(fine, coarse) == [*figures(fine), *figures(coarse)]
    assert figures(fine) != figures(coarse)


def test_a_comparison_of_levels_is_written_and_is_of_all_of_them(tmp_path, monkeypatch):
    monkeypatch.setattr("aaplug.verbs.compare.write_page", lambda *given: [])
    levels, other = in_one_chunk(200, 50), in_one_chunk(200, 40)
    how = {"output": tmp_path / "out", "scale": (1 / 8,), "rasterizer": "eager", "metric": "psnr", "resume": True}
    aaplug.compare({"levels": levels, "finest": levels.finest}, CAMERAS, **how)
    with pytest.raises(aaplug.UsageError, match="scenes_sha256"):
        aaplug.compare({"levels": other, "finest": levels.finest}, CAMERAS, **how)


FINE_RATE = 40.0  # px per world unit
FRONT = make_camera((0.0, -4.0, 0.0), (96, 96))
WALL = 0.6  # opacity


def one(place: tuple[float, float, float], size: float, opacity: float) -> Gaussians:
    """A round Gaussian."""
    scene = make_scene(1)
    columns = {"means": torch.tensor([place]), "log_scales": torch.full((1, 3), math.log(size))}
    return replace(scene, **columns, logit_opacities=torch.tensor([opacity]).logit())


def wall_and_behind(opacity: float) -> Gaussians:
    """A wide Gaussian, and a small one behind it as the camera in front sees it."""
    return joined([one((0.0, 0.0, 0.0), 0.4, opacity), one((0.0, 0.5, 0.0), 0.03, 0.5)])


def shown(
    scene: Gaussians, *eyes: tuple[float, float, float], rasterizer: str = "eager", side: int = 96
) -> torch.Tensor:
    views = [make_camera(eye, (side, side)) for eye in eyes] or [FRONT]
    return visibility(own_look(scene, TrainingViews.of(scene, views), rasterizer), views, 0.5)


@pytest.mark.parametrize("opacity", [0.2, WALL, 0.95])
def test_behind_a_wall_is_seen_what_the_wall_lets_through(opacity):
    front, behind = shown(wall_and_behind(opacity)).tolist()
    assert front == pytest.approx(1, abs=0.03)
    assert behind == pytest.approx(1 - opacity, abs=0.03)


def test_the_view_that_shows_most_counts():
    scene = wall_and_behind(0.95)
    assert shown(scene)[1] < 0.1
    assert shown(scene, (0.0, -4.0, 0.0), (0.0, 4.0, 0.0))[1] > 0.9


@pytest.mark.parametrize("place", [(0.0, -9.0, 0.0), (5.0, 0.0, 0.0)], ids=["behind", "beside"])
def test_of_what_lies_in_no_image_nothing_is_known(place):
    scene = joined([make_scene(20), one(place, 0.1, 0.9)])
    found = shown(scene)
    assert found[-1].isnan()
    assert (found[:-1] > 0).any()
    assert shown(one(place, 0.1, 0.9), rasterizer="reference").isnan().all()


@pytest.mark.parametrize("size", [0.05, 1.0, 10.0])
@pytest.mark.parametrize("opacity", [0.02, 0.9])
def test_all_is_seen_of_what_nothing_hides_however_large_and_faint(size, opacity):
    """Only what lies in the image counts, above the cut-off of alpha."""
    assert shown(one((0.1, 0.0, -0.2), size, opacity))[0] > 0.85


def test_lod_leaves_out_what_is_hidden_from_its_cameras():
    """Without cameras, nothing counts as hidden: the orbit's views stand in, and may look from the wrong side."""
    wall = one((0.0, 0.0, 0.0), 0.4, 0.99)
    layers = [replace(wall, means=torch.tensor([[0.0, 0.02 * i, 0.0]])) for i in range(4)]
    hidden = replace(make_scene(8), means=make_scene(8).means * 0.02 + torch.tensor([0.0, 0.7, 0.0]))
    hidden.log_scales[:], hidden.logit_opacities[:] = math.log(0.02), 2.0
    scene = joined([*layers, hidden])
    views = tuple(make_camera((x, -4.0, 0.0), (96, 96)) for x in (-0.2, 0.0, 0.2))
    found = [aaplug.lod(scene, known, levels=1, steps=1)[1].scene for known in (CameraSet(views, views), None)]
    behind = [int((level.means[:, 1] > 0.4).sum()) for level in found]
    assert behind[0] == 0
    assert behind[1] > 0


def test_it_equals_the_reference_rasterizers():
    scene, eyes = make_scene(150), ((0.0, -4.0, 0.0), (3.0, -2.0, 1.0))
    fast, slow = (shown(scene, *eyes, rasterizer=name) for name in ("eager", "reference"))
    torch.testing.assert_close(fast, slow, rtol=1e-3, atol=1e-5, equal_nan=True)
    assert (fast > 0).sum() > 100


def test_it_does_not_depend_on_the_number_of_threads():
    found = []
    for threads in (1, 2):
        with torch_threads(threads):
            found.append(shown(make_scene(500), (0.0, -4.0, 0.0), (3.0, -2.0, 1.0), side=512))
    assert torch.equal(*(share.nan_to_num(-1) for share in found))


def test_a_level_leaves_out_what_is_hidden_and_keeps_it_where_nothing_is_known():
    scene, rates = make_scene(40), torch.full((40,), FINE_RATE)
    hidden = torch.arange(40) % 2 == 0
    goal = Goal(1.0, tolerance=0.0)
    assert len(merge(scene, rates, goal).scene) == 40
    left = merge(scene, rates, goal, visible=(~hidden).float()).scene
    assert torch.equal(left.means.sort(dim=0).values, scene.means[~hidden].sort(dim=0).values)


def test_equally_visible_gaussians_merge_alike_for_a_tolerance_of_their_squared_share():
    scene, rates, share = make_scene(60), torch.full((60,), FINE_RATE), 0.4
    found = [
        merge(scene, rates, Goal(0.1, tolerance=0.3 * own**2), visible=torch.full((60,), own)).scene
        for own in (1.0, share)
    ]
    assert len(found[0]) < 50
    for name, column in found[0].columns.items():
        torch.testing.assert_close(found[1].columns[name], column, rtol=1e-3, atol=1e-4)


def test_a_hidden_gaussian_adds_nothing_to_the_seen_one_that_it_is_merged_with():
    scene = joined([one((0.0, 0.0, 0.0), 0.1, 0.5), one((0.0, 0.1, 0.0), 0.1, 0.5)])
    scene.sh[:, 0] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    clusters = clusters_of(scene, torch.full((2,), FINE_RATE), visible=torch.tensor([1.0, 0.0]))
    seen, hidden = (clusters[torch.tensor([place])] for place in range(2))
    both = merge_pairs(seen, hidden)
    for name in ("means", "covs", "opacities", "colours", "visible"):
        torch.testing.assert_close(getattr(both, name), getattr(seen, name), rtol=5e-3, atol=5e-3)
