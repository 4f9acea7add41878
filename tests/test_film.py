"""Aperture and shutter: samples of the lens and of time, and what each adds to the splats."""

import itertools
import json
import math
from dataclasses import dataclass, replace

import pytest
import torch

import aaplug
from aaplug import Aperture, CameraSet, Exposure, Render, UsageError, read_camera_path
from aaplug.core.camera_paths import toward
from aaplug.core.exposures import FAINT, cells, lattice, opening, sample_cameras, spread, spread_out
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, ORTHO, PINHOLE, Lens
from aaplug.core.projection import project
from aaplug.evaluation.metrics import psnr
from aaplug.options.verbs import ImageOptions
from aaplug.rasterizers.tiled.rasterizer import EAGER_TILED
from aaplug.rendering.film import filmed
from aaplug.rendering.visibility import visibility
from aaplug.verbs.render import description
from tests.conftest import make_camera, make_scene
from tests.test_camera_paths import document

VIEW = make_camera((0.0, -4.0, 0.0))
MOVED = make_camera((0.5, -4.0, 0.2))
ZOOMED = VIEW, replace(MOVED, fx=1.2 * VIEW.fx, fy=1.2 * VIEW.fy, cx=VIEW.cx + 2.0)
APERTURE = Aperture(radius=0.1, focus=3.0)
MANY = 512  # samples


def exposed(aperture=None, motion=None, samples=16):
    return replace(VIEW, exposure=Exposure(aperture, motion, samples))


@pytest.mark.parametrize("count", [1, 2, 6, 7, 16, 100, 1024])
def test_a_lattice_has_one_point_in_each_part_of_each_axis(count):
    points = lattice(count)
    places = (points.sort(dim=0).values * count - 0.5).round()
    assert torch.equal(places, torch.arange(count).double()[:, None].expand(-1, 5))
    assert points.mean(dim=0).tolist() == pytest.approx([0.5] * 5)


@pytest.mark.parametrize("count", [5, 13, 16, 17, 31, 61, 64, 101, 128, 256])
def test_no_two_points_of_a_lattice_are_close_in_the_opening(count):
    """In the square, whose sides are joined, a grid's least distance is 1 / √count."""
    places = lattice(count)[:, 2:4]
    offsets = (places[:, None] - places + 0.5) % 1 - 0.5
    assert float(offsets.norm(dim=2).fill_diagonal_(1.0).min()) > 0.6 / math.sqrt(count)


def test_lattices_fill_the_opening():
    """In the square a grid's least distance is 1 / √count, and no place is farther than 0.71 / √count from it."""
    side = (torch.arange(50).double() + 0.5) / 50
    for count in range(2, 257):
        places = lattice(count)[:, 2:4]
        apart = float(torch.cdist(places, places).fill_diagonal_(1.0).min()) * math.sqrt(count)
        away = float(torch.cdist(torch.cartesian_prod(side, side), places).amin(dim=1).max()) * math.sqrt(count)
        few = count in (4, 5, 6, 8, 10, 12, 24)
        assert apart > (0.7 if few else 0.55), count
        assert away < (1.25 if few else 1.6), count


@pytest.mark.parametrize("blades", [0, 3, 4, 5, 6, 9])
def test_places_fill_the_opening_evenly(blades):
    aperture = Aperture(2.0, 1.0, blades)
    side = (torch.arange(60) + 0.5) / 60
    places = torch.tensor([opening(aperture, float(u), float(v)) for u in side for v in side])
    assert float(places.norm(dim=1).max()) <= 2.0 + 1e-6
    moments = places.T @ places / len(places)
    assert moments.flatten().tolist() == pytest.approx([aperture.variance, 0, 0, aperture.variance], abs=2e-3 * 4)
    if blades:
        turned = torch.stack([torch.cos(t := torch.arange(blades) * 2 * math.pi / blades + math.pi / blades), t.sin()])
        assert float((places.double() @ turned.double()).max()) <= 2.0 * math.cos(math.pi / blades) + 1e-6


def test_the_plane_in_focus_stays_and_the_rest_moves():
    sharp, blurred = torch.tensor([[0.3, -1.0, 0.2], [-0.4, -1.0, 0.0]]), torch.tensor([[0.3, 2.0, 0.2]])
    still, _ = VIEW.project(sharp)
    cameras = list(sample_cameras(exposed(APERTURE)))
    shifts = torch.stack([camera.project(sharp)[0] - still for camera in cameras])
    assert torch.allclose(shifts[:, 0], shifts[:, 1], atol=1e-9)  # within the pixel, and everywhere the same
    assert float(shifts.abs().max()) < 0.5
    far = torch.stack([camera.project(blurred)[0] for camera in cameras]) - VIEW.project(blurred)[0]
    radius = VIEW.fx * APERTURE.radius * (1 / 3 - 1 / 6)
    assert 0.8 * radius < float((far - shifts[:, :1]).norm(dim=2).max()) <= radius + 1e-9


@pytest.mark.parametrize(
    ("aperture", "motion", "lens"),
    [
        (APERTURE, None, PINHOLE),
        (Aperture(0.2, 5.0, 6), None, PINHOLE),
        (APERTURE, (VIEW, MOVED), PINHOLE),
        *itertools.product([None], [(VIEW, MOVED), ZOOMED], [PINHOLE, ORTHO, Lens(radial=(0.02,)), EQUIDISTANT]),
    ],
)
def test_spread_is_the_covariance_of_the_places_of_many_samples(aperture, motion, lens):
    """The slow twin: places in float64 under the cameras of the samples; a fisheye's planes lie along its image."""
    scene, camera = make_scene(30), exposed(aperture, None, MANY)
    if motion is not None:
        motion = tuple(replace(each, lens=lens) for each in motion)
        camera = replace(toward(*motion, 0.5), exposure=Exposure(aperture, motion, MANY))
    splats = project(scene, camera)
    means = scene.means[splats.sources]

    def covariance(samples):
        places = torch.stack([each.project(means)[0] for each in sample_cameras(samples)])
        offsets = places - places.mean(dim=0)
        return (offsets[..., :, None] * offsets[..., None, :]).mean(dim=0)

    truth = covariance(camera) - covariance(replace(camera, exposure=Exposure(None, None, MANY)))
    truth = torch.stack([truth[:, 0, 0], truth[:, 0, 1], truth[:, 1, 1]], dim=1)
    assert torch.allclose(spread(splats, camera).double(), truth, rtol=0.05, atol=0.05)


@pytest.mark.parametrize("samples", [1, 7])
@pytest.mark.parametrize("aperture", [None, APERTURE], ids=["pinhole", "aperture"])
@pytest.mark.parametrize("motion", [None, (VIEW, VIEW), (VIEW, MOVED)], ids=["no shutter", "still", "moved"])
def test_gradients_of_what_a_cell_spreads_are_finite_differences(aperture, motion, samples):
    scene, camera = make_scene(30, dtype=torch.float64), exposed(aperture, motion, samples)
    weights, step = (torch.rand(2, 30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 0.5) * 1e-6

    def total(means):
        splats = project(replace(scene, means=means), camera)
        wide, opacities = spread_out(splats, camera, torch.full_like(splats.dets, 0.5))
        of_each = (wide.covs * weights[wide.sources]).sum() + (opacities * weights[splats.sources, 0]).sum()
        return (of_each + (wide.opacities * weights[wide.sources, 1]).sum()) / 1e-6

    means = scene.means.clone().requires_grad_()
    total(means).backward()
    slope = float((means.grad * step).sum())
    assert float(total(scene.means + step / 2) - total(scene.means - step / 2)) == pytest.approx(
        slope, rel=1e-4, abs=1e-12
    )


def test_through_a_fisheye_a_path_is_as_long_as_its_angle():
    """The camera turns by 149 degrees; points at its height move along a great circle, some to behind their planes."""
    angle, scene = 2.6, make_scene(30)
    middle = replace(VIEW, lens=EQUIDISTANT)
    splats = project(replace(scene, means=scene.means * torch.tensor([1.0, 1.0, 0.0])), middle)
    ends = []
    for turn in (-0.1 * angle, 0.9 * angle):
        (c, s), pose = (math.cos(turn), math.sin(turn)), torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = pose.new_tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        ends.append(replace(middle, cam_from_world=pose @ middle.cam_from_world))
    path = spread(splats, replace(middle, exposure=Exposure(None, (ends[0], ends[1]))))
    assert splats.planes is not None
    lengths = (12 * (path[:, 0] + path[:, 2])).sqrt() / splats.planes[:, 0].norm(dim=1)
    assert torch.allclose(lengths, torch.full_like(lengths, angle), rtol=1e-3)


def test_cells_of_a_disc_are_round_and_those_of_a_line_lie_along_it():
    splats = project(make_scene(30), VIEW)
    round_cells, whole = (cells(splats, exposed(APERTURE, None, n)) for n in (16, 1))
    disc, line = spread(splats, exposed(APERTURE)), spread(splats, exposed(None, (VIEW, MOVED)))
    assert torch.allclose(whole, disc, rtol=1e-3, atol=1e-6)
    assert torch.allclose(round_cells, disc / 16, rtol=1e-3, atol=1e-6)
    assert torch.allclose(cells(splats, exposed(None, (VIEW, MOVED))), line / 256, rtol=0.02, atol=1e-3)


@pytest.mark.parametrize("light", [1.0, 0.2])
def test_of_faint_spread_splats_some_are_drawn_with_the_light_of_all(light):
    splats, camera = project(make_scene(300), VIEW), exposed(Aperture(1.0, 2.0), None, 1)
    wide, opacities = spread_out(splats, camera, torch.full_like(splats.dets, light))
    assert 0 < len(wide) < len(splats)
    assert float(wide.opacities.min()) > 0.99 * min(FAINT, float(splats.opacities.min()))
    assert float(wide.opacities.sum()) == pytest.approx(float(opacities.sum()), abs=2 * FAINT)
    ratio = (splats.dets / splats.convolved(0.75 * cells(splats, camera), False).dets).sqrt()
    assert torch.allclose(opacities, splats.opacities * ratio * light ** (1 - ratio), rtol=1e-4)


def test_few_samples_come_close_to_many_and_closer_than_samples_without_cells(monkeypatch):
    scene = make_scene(200)
    renderer = aaplug.Renderer.of(scene, [VIEW], "matched", min_seen=0.0)
    many = renderer(exposed(APERTURE, (VIEW, MOVED), 100)).rgb
    few, one = (renderer(exposed(APERTURE, (VIEW, MOVED), n)).rgb for n in (16, 1))
    monkeypatch.setattr("aaplug.core.exposures.cells", lambda splats, camera: torch.zeros_like(splats.covs))
    plain, pinhole = renderer(exposed(APERTURE, (VIEW, MOVED), 16)).rgb, renderer(toward(VIEW, MOVED, 0.5)).rgb
    figures = [psnr(image, many) for image in (few, plain, one, pinhole)]
    assert figures[0] > 36
    assert figures[0] > figures[1]
    assert figures[2] > 26
    assert figures[2] > figures[3] + 2


def test_a_drawing_of_an_exposure_is_the_mean_of_its_frames_which_share_the_samples_of_a_pixel():
    renderer = aaplug.Renderer.of(make_scene(50), [VIEW], "auto", min_seen=0.0)
    camera, small = exposed(APERTURE, (VIEW, MOVED), 4), exposed(APERTURE, (VIEW, MOVED), 4).scaled(1 / 4)
    assert renderer.draw(camera).render.rgb.equal(renderer(camera).rgb)
    assert renderer.samples(small) == renderer.samples(replace(small, exposure=None)) / 2


def walls() -> aaplug.Gaussians:
    """A red wall of many splats, a blue one close behind it that is hidden, and a green one far behind, to one side."""
    side = torch.linspace(-1.0, 1.0, 21)
    x, z = (axis.flatten() for axis in torch.meshgrid(side, side, indexing="ij"))
    parts = [torch.stack([0.5 * x, torch.full_like(x, y), 0.5 * z], dim=1) for y in (0.0, 0.1)]
    means = torch.cat([*parts, torch.stack([2 * x + 1.0, torch.full_like(x, 3.0), z], dim=1)])
    colours = torch.eye(3)[[0, 2, 1]].repeat_interleave(len(x), dim=0)
    columns = {"means": means, "log_scales": torch.full_like(means, -2.8), "sh": (colours - 0.5)[:, None] / 0.2821}
    columns["log_scales"][2 * len(x) :] = -1.8
    return replace(make_scene(len(means), degree=0), **columns, logit_opacities=torch.full((len(means),), 3.0))


@pytest.mark.parametrize("motion", [None, (VIEW, make_camera((0.4, -4.0, 0.0)))], ids=["still", "moved"])
def test_a_spread_splat_has_the_light_that_is_seen_of_it(motion, monkeypatch):
    renderer, opening = aaplug.Renderer.of(walls(), [VIEW], "matched", min_seen=0.0), Aperture(0.3, 7.0)
    many = renderer(exposed(opening, motion, 256)).rgb
    ours = [psnr(renderer(exposed(opening, motion, count)).rgb, many) for count in (1, 5)]
    monkeypatch.setattr(aaplug.Renderer, "_light", lambda self, camera, samples: None)
    alone = [psnr(renderer(exposed(opening, motion, count)).rgb, many) for count in (1, 5)]
    assert ours[0] > alone[0] + 3
    assert ours[1] > alone[1] + 1


def test_splats_at_a_panoramas_edge_have_the_light_of_its_middle():
    """Beyond the edge a splat has a copy, whose centre the image does not show."""
    renderer, ahead, seen = aaplug.Renderer.of(walls(), [VIEW], "matched", min_seen=0.0), [], []
    for side in (1.0, -1.0):
        turn = torch.diag(torch.tensor([side, 1.0, side, 1.0], dtype=torch.float64))
        panorama = {"lens": EQUIRECT, "fx": 80.0, "fy": 80.0, "cx": 80.0 * math.pi, "cy": 40.0 * math.pi}
        panorama |= {"width": round(160 * math.pi), "height": round(80 * math.pi)}
        first, last = (replace(v, cam_from_world=turn @ v.cam_from_world, **panorama) for v in (VIEW, MOVED))
        ahead.append(renderer._light(replace(first, exposure=Exposure(None, (first, last), 1)), 1))
        seen.append(visibility(renderer, [first], 1.0))
    middle, edge = ahead
    assert torch.equal(*(each.isnan() for each in seen))
    assert middle.quantile(0.1) < 0.2, "some are hidden"
    assert (middle - edge).abs().max() < 0.4
    assert (middle - edge).abs().mean() < 0.015


def test_a_view_that_shows_nothing_has_an_exposure_too():
    sky, back = (0.2, 0.4, 0.6), torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))
    renderer = aaplug.Renderer.of(make_scene(20), [VIEW], "matched", min_seen=0.0, background=sky)
    camera = replace(exposed(APERTURE), cam_from_world=back @ VIEW.cam_from_world)
    assert torch.allclose(renderer(camera).rgb, torch.tensor(sky).expand(*camera.hw, 3))


@dataclass(frozen=True)
class WithoutGradients:
    """The eager rasterizer, with no gradients."""

    name: str = "without-gradients"

    def __call__(self, *args, **keywords):
        return Render(*(x.detach() for x in EAGER_TILED(*args, **keywords)))


def test_an_exposure_needs_no_gradients():
    with torch.inference_mode():
        renderer = aaplug.Renderer.of(make_scene(20), [VIEW], "matched", min_seen=0.0, rasterizer="eager")
        drawn = renderer(exposed(APERTURE)).rgb
    again = aaplug.Renderer.of(make_scene(20), [VIEW], "matched", min_seen=0.0, rasterizer="eager")
    assert torch.equal(drawn, again(exposed(APERTURE)).rgb)
    without = replace(again, rasterizer=WithoutGradients())(exposed(APERTURE)).rgb
    assert psnr(without, drawn) > 40


@pytest.mark.parametrize("samples", [1, 16])
def test_defocus_keeps_the_energy_of_a_faint_splat(samples):
    scene = make_scene(1)[:1]
    scene = replace(
        scene, means=torch.zeros(1, 3), logit_opacities=torch.full((1,), 1.0), log_scales=torch.full((1, 3), -2.0)
    )
    renderer = aaplug.Renderer.of(scene, [VIEW], "matched", min_seen=0.0)
    sharp, soft = renderer(VIEW).alpha, renderer(exposed(Aperture(0.6, 3.0), None, samples)).alpha
    assert float(soft.max()) < 0.9 * float(sharp.max())
    assert float(soft.sum()) == pytest.approx(float(sharp.sum()), rel=0.03)


def test_sizes_take_the_exposure_along():
    camera = exposed(APERTURE, (VIEW, MOVED))
    for sized in (camera.scaled(0.5), camera.resized(30, 20), camera.framed(30, 20)):
        opened, closed = sized.exposure.motion
        assert opened.intrinsics == closed.intrinsics == sized.intrinsics


def test_the_shutter_is_open_around_each_frame_at_the_mean_speed_there():
    path = [make_camera((x, -4.0, 0.0)) for x in (0.0, 0.4, 1.2)]
    views = filmed(path, ImageOptions(shutter=0.5), True)
    places = [[camera.centre[0].item() for camera in view.exposure.motion] for view in views]
    assert [x for pair in places for x in pair] == pytest.approx([-0.1, 0.1, 0.25, 0.55, 1.0, 1.4])
    assert filmed(path, ImageOptions(), True) == path


def test_a_frame_on_a_curve_lies_in_the_middle_of_its_motion():
    angles = (0.0, 0.3, 0.6)  # rad around the origin, with a zoom that turns back
    zooms = zip((make_camera((4 * math.sin(a), 4 * math.cos(a), 0.0)) for a in angles), (1.0, 1.5, 1.0), strict=True)
    path = [replace(camera, fx=camera.fx * zoom, fy=camera.fy * zoom) for camera, zoom in zooms]
    for view in filmed(path, ImageOptions(shutter=1.0), True):
        middle = toward(*view.exposure.motion, 0.5)
        torch.testing.assert_close(middle.cam_from_world, view.cam_from_world, rtol=0, atol=1e-3)
        assert middle.intrinsics == pytest.approx(view.intrinsics)


def test_an_f_stop_is_the_focal_length_over_the_diameter():
    [view] = filmed([VIEW], ImageOptions(f_stop=2.0, sensor=0.1, focus_at=(0.0, 0.0, 0.0), blades=5), False)
    assert view.exposure.aperture.radius == pytest.approx(0.1 * VIEW.fx / VIEW.width / 2 / 2)
    assert (view.exposure.aperture.focus, view.exposure.aperture.blades) == (pytest.approx(4.0), 5)
    assert view.exposure.samples == 16
    fast = filmed([VIEW], ImageOptions(f_stop=2.0, focus_distance=1.0, quality="fast"), False)
    assert fast[0].exposure.samples == 5


WRONG = {
    "focus": ({"f_stop": 2.0}, False, "f_stop"),
    "two focuses": ({"f_stop": 2.0, "focus_distance": 1.0, "focus_at": (0.0, 0.0, 0.0)}, False, "focus_distance"),
    "no aperture": ({"focus_distance": 1.0}, False, "focus_distance"),
    "blades": ({"blades": 5}, False, "blades"),
    "two numbers": ({"f_stop": 2.0, "focus_at": (0.0, 0.0)}, False, "focus_at"),
    "behind": ({"f_stop": 2.0, "focus_at": (0.0, -5.0, 0.0)}, False, "behind the camera of view"),
    "no path": ({"shutter": 0.5}, False, "camera_to"),
    "one frame": ({"shutter": 0.5}, True, "one frame"),
    "nothing": ({"samples": 4}, False, "samples"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_options_are_refused(case):
    options, path, says = WRONG[case]
    with pytest.raises(UsageError, match=says):
        filmed([VIEW], ImageOptions(**options), path)


def test_a_lens_that_bends_moves_but_has_no_aperture():
    panorama = replace(VIEW, lens=Lens("equirect"), fx=10.0, fy=10.0)
    for bent, got in ((panorama, "got equirect"), (replace(VIEW, lens=Lens(radial=(0.1,))), "got a distorted pinhole")):
        with pytest.raises(UsageError, match=f"f_stop: an aperture needs .* distortion, {got}; give `lens` pinhole"):
            filmed([bent], ImageOptions(f_stop=2.0, focus_distance=1.0), False)
    renderer = aaplug.Renderer.of(make_scene(30), [VIEW], "matched", min_seen=0.0)
    moving = replace(
        panorama, exposure=Exposure(None, (panorama, replace(panorama, cam_from_world=MOVED.cam_from_world)), 4)
    )
    assert not torch.equal(renderer(moving).rgb, renderer(panorama).rgb)


def test_a_camera_to_is_one_view_for_one():
    frames = [replace(VIEW, name=f"a-{number}") for number in (1, 2)]
    problem = "camera_to: moves one view to one other, not a path or a scene in time; got a-1, a-2 to b"
    with pytest.raises(UsageError, match=problem):
        filmed(frames, ImageOptions(), False, camera_to=[replace(MOVED, name="b")])


@pytest.mark.parametrize(
    ("end", "says"),
    [
        (VIEW, "zero length"),
        (MOVED.scaled(0.5), "different sizes or lenses"),
        (replace(MOVED, lens=Lens("equidistant")), "different sizes or lenses"),
    ],
)
def test_a_motion_has_a_length_and_keeps_size_and_kind_of_lens(end, says):
    with pytest.raises(UsageError, match=f"camera_to.*{says}"):
        filmed([VIEW], ImageOptions(), False, camera_to=[end])
    with pytest.raises(UsageError, match=f"shutter.*{says}"):
        filmed([VIEW, end], ImageOptions(shutter=0.5), True)


def test_through_a_fisheye_of_another_aspect_pixels_are_square_and_a_stretched_view_is_told(cli, monkeypatch):
    """A fisheye shows its angle along the shorter side."""
    shown = []
    monkeypatch.setattr("aaplug.verbs.render.write_frames", lambda renderer, views, *_, **__: shown.extend(views))
    stretched = "resolution: 60x20 px stretches view r_0; -1 on one side keeps its aspect"
    for lens in ("", "--lens fisheye --lens-angle 90"):
        code, _, err = cli(f"render scene.ply --cameras . -o new --resolution 60x20 --rasterizer eager {lens}")
        assert (code, stretched in err) == (0, not lens), err
    plain, fisheye = shown
    assert plain.fx / plain.fy == pytest.approx(60 / 20 * 48 / 64)
    assert fisheye.fx == fisheye.fy == pytest.approx(10 / (math.pi / 4))


def test_nothing_is_drawn_after_a_mistake(tmp_path):
    scene, cameras, how = make_scene(20), CameraSet((VIEW,), (VIEW,)), {"min_seen": 0.0, "views": "all"}
    for options in ({"f_stop": 2.0, "focus_at": (0.0, -9.0, 0.0)}, {"camera_to": VIEW.name}, {"shutter": 0.5}):
        with pytest.raises(UsageError):
            aaplug.render(scene, cameras, tmp_path / "out", **how, **options)
    assert not (tmp_path / "out").exists()


def test_a_still_is_blurred_towards_another_view(tmp_path):
    first, second = replace(VIEW, name="a"), replace(MOVED, name="b")
    scene, cameras = make_scene(20), CameraSet((first, second), (first, second))
    how = {"min_seen": 0.0, "views": "a", "samples": 4}
    [written] = aaplug.render(scene, cameras, tmp_path / "a.png", camera_to="b", **how)
    assert [camera.name for camera in written.view.exposure.motion] == ["a", "b"]


@pytest.mark.parametrize(("samples", "told"), [(1, "frame"), (16, "frames")])
def test_how_many_frames_are_averaged_is_told(samples, told):
    renderer = aaplug.Renderer.of(make_scene(20), [VIEW], "matched", min_seen=0.0)
    assert description(renderer, [exposed(APERTURE, samples=samples)]).endswith(f", mean of {samples} {told}")


def test_a_path_file_brings_its_aperture_and_shutter(tmp_path):
    path = document(shutter=0.5)
    frame = path["camera_path"][0]
    moved = {**frame, "camera_to_world": [1, 0, 0, 1, *frame["camera_to_world"][4:]]}
    path["camera_path"] = [{**f, "aperture": {"radius": 0.02, "focus": 3, "blades": 7}} for f in (frame, moved)]
    (tmp_path / "path.json").write_text(json.dumps(path))
    file = read_camera_path(tmp_path / "path.json")
    views = filmed(file.cameras, ImageOptions(samples=4), True, file.shutter)
    assert views[0].exposure.aperture == Aperture(0.02, 3.0, 7)
    assert views[0].exposure.motion is not None
    assert views[0].exposure.samples == 4
    assert filmed(file.cameras, ImageOptions(samples=0), True, file.shutter)[0].exposure is None
    for still in (views[:1], views[:1] * 2):  # the file's shutter, but no motion
        assert filmed(still, ImageOptions(samples=4), True, file.shutter)[0].exposure.motion is None
    bare = replace(views[0], exposure=None)
    assert filmed([bare], ImageOptions(samples=4), True, file.shutter) == [bare]
    how = {"path": tmp_path / "path.json", "lens": "equirect", "resolution": "16x8", "min_seen": 0.0}
    scene, cameras = make_scene(20), CameraSet((VIEW,), (VIEW,))
    with pytest.raises(UsageError, match=r"lens: an aperture .*; `samples` of 0 leaves out that of"):
        aaplug.render(scene, cameras, tmp_path / "out", **how)
    assert len(aaplug.render(scene, cameras, tmp_path / "out", samples=0, **how)) == 2
