"""Lenses: their maps, splats through them, and photographs undistorted, against models written out here."""

import math
import pickle
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
import torch

from aaplug import RULES_3DGS, Camera, Renderer, TrainingViews, UsageError
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, EQUISOLID, ORTHO, Lens, opencv_lens
from aaplug.core.light import transmittances
from aaplug.core.projection import project, project_covariances, rotation_matrices
from aaplug.core.splats import concatenated
from aaplug.io.lenses import Distortion, undistorted, with_lenses
from aaplug.io.photographs import read_photo
from aaplug.methods.pixel_kernels.ray import RAY
from tests.conftest import ALL_RASTERIZERS, each, make_camera, make_scene

SIZE = 160, 120
PINHOLE = 130.0, 125.0, 83.0, 57.0  # fx, fy, cx, cy
MODELS = {  # COLMAP's name and OpenCV's coefficients
    "barrel": ("OPENCV", (-0.2, 0.05, 0.0, 0.0)),
    "pincushion": ("OPENCV", (0.15, 0.0, 0.002, -0.004)),
    "full": ("FULL_OPENCV", (-0.2, 0.03, 0.001, 0.002, 0.01, 0.02, 0.01, 0.0)),
    "fisheye": ("OPENCV_FISHEYE", (0.03, -0.01, 0.002, 0.0)),
}


def distortion(model: tuple[str, tuple[float, ...]]) -> Distortion:
    name, coefficients = model
    return Distortion(name, opencv_lens(coefficients, name.endswith("FISHEYE")))


def bend(xy: np.ndarray, model: tuple[str, tuple[float, ...]]) -> np.ndarray:
    """Where a ray (x, y, 1) meets the sensor at focal length 1, by OpenCV."""
    name, coefficients = model
    project = cv2.fisheye.projectPoints if name.endswith("FISHEYE") else cv2.projectPoints
    points, zero = np.pad(xy, ((0, 0), (0, 1)), constant_values=1.0)[:, None], np.zeros((1, 3))
    return project(points, zero, zero, np.eye(3), np.array(coefficients))[0][:, 0]


def plane(xy: np.ndarray) -> np.ndarray:
    """A smooth picture on the plane at depth 1, in three colours."""
    x, y = xy.T
    waves = [np.sin(9 * x + 2 * y), np.sin(7 * y - x), np.cos(5 * x + 5 * y)]
    return 0.5 + 0.4 * np.stack(waves, axis=1)


def centres(width: int, height: int) -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


@cache
def taken_through(lens: tuple[str, tuple[float, ...]], times: int = 1) -> np.ndarray:
    """The plane's photograph, `times` as fine as the camera: each pixel's ray by fixed-point iteration."""
    width, height = (times * side for side in SIZE)
    fx, fy, cx, cy = (times * value for value in PINHOLE)
    target = (centres(width, height) - (cx, cy)) / (fx, fy)
    rays = target.copy()
    for _ in range(30):
        rays += target - bend(rays, lens)
    assert np.abs(bend(rays, lens) - target).max() < 1e-9
    return plane(rays).reshape(height, width, 3)


def camera_of(tmp_path, lens: tuple[str, tuple[float, ...]], times: int = 1) -> Camera:
    pixels = (taken_through(lens, times) * 65535).round().astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), pixels[..., ::-1])
    fx, fy, cx, cy = PINHOLE
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera("a", *SIZE, fx, fy, cx, cy, pose, photo=tmp_path / "a.png")
    return with_lenses([camera], [distortion(lens)], undistort=True)[0][0]


def seen_by(camera: Camera, times: int = 1) -> np.ndarray:
    """What the camera's own pinhole shows of the plane."""
    width, height = times * camera.width, times * camera.height
    pixels = centres(width, height) / times
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return plane(rays).reshape(height, width, 3)


@pytest.mark.parametrize(("name", "times"), [("barrel", 1), ("pincushion", 2), ("full", 1), ("fisheye", 1)])
def test_a_straightened_photograph_is_what_the_pinhole_sees(tmp_path, name, times):
    camera = camera_of(tmp_path, MODELS[name], times)
    view = seen_by(camera, times)
    photo, as_taken = (read_photo(camera.photo, (0.0, 0.0, 0.0), how) for how in (camera.undistortion, None))
    assert photo.shape == view.shape
    error = np.abs(photo.double().numpy() - view)
    assert error.max() < 0.012  # at the edges, where half a pixel is repeated
    assert error.mean() < 0.0015  # bilinear interpolation of these waves, and 8 bits
    left, top, width, height = (times * side for side in camera.undistortion.window)
    assert np.abs(as_taken.numpy()[top : top + height, left : left + width] - view).max() > 0.1


def test_a_barrel_shows_all_of_its_pinhole_and_a_pincushion_most(tmp_path):
    assert camera_of(tmp_path, MODELS["barrel"]).undistortion.window == (0, 0, *SIZE)
    camera = camera_of(tmp_path, MODELS["pincushion"])
    left, top, width, height = camera.undistortion.window
    assert (camera.width, camera.height) == (width, height)
    assert (camera.fx, camera.fy, camera.cx + left, camera.cy + top) == PINHOLE
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
    bent = bend((corners - (camera.cx, camera.cy)) / PINHOLE[:2], MODELS["pincushion"])
    sides = bent * PINHOLE[:2] + PINHOLE[2:]
    assert ((sides > -1) & (sides < np.array(SIZE) + 1)).all()
    assert width * height > 0.7 * SIZE[0] * SIZE[1]


def test_a_lens_that_shows_little_of_its_pinhole_has_no_photograph(tmp_path):
    camera = replace(camera_of(tmp_path, MODELS["barrel"]), undistortion=None)
    strong = distortion(("OPENCV", (30.0, 0.0, 0.0, 0.0)))
    (bare,), _ = with_lenses([camera], [strong], undistort=True)
    assert (bare.photo, bare.undistortion, bare.width) == (None, None, SIZE[0])
    image = torch.rand(4, 5, 3)
    assert undistorted(image, None) is image


THIN_PRISM = Lens("equidistant", (-0.05, 0.01), tangential=(0.01, -0.01), prism=(0.01, 0.0, 0.02, 0.0))
ALL_LENSES = {
    "equidistant": EQUIDISTANT,
    "equisolid": EQUISOLID,
    "equirect": EQUIRECT,
    "ortho": ORTHO,
    "thin-prism": THIN_PRISM,
} | {name: distortion(model).lens for name, model in MODELS.items()}
lens = each(ALL_LENSES)


def view_through(lens: Lens, eye: tuple[float, float, float] = (0.5, -0.3, 0.2), side: int = 64) -> Camera:
    """A view from inside the scene; a panorama shows all around."""
    width, height = (2 * side, side) if lens == EQUIRECT else (side, side)
    focal = width / (2 * math.pi) if lens == EQUIRECT else 0.3 * side
    pose = make_camera(eye).cam_from_world
    return Camera("view", width, height, focal, focal, width / 2, height / 2, pose, lens=lens)


def some_rays(lens: Lens, n: int = 2000) -> torch.Tensor:
    rays = torch.randn(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    if lens.flat:
        rays[:, 2] = rays[:, 2].abs() + 1.5
    return rays / rays[:, 2:] if lens == ORTHO else torch.nn.functional.normalize(rays, dim=1)


def test_rays_of_places_are_the_rays_that_meet_them(lens):
    rays = some_rays(lens)
    back = lens.rays(lens.places(rays))
    seen = back.abs().sum(dim=1) > 0
    assert seen.double().mean() > 0.8
    found, expected = (torch.nn.functional.normalize(each, dim=1)[seen] for each in (back, rays))
    assert (found - expected).abs().max() < 1e-13


@pytest.mark.parametrize("name", MODELS)
def test_places_are_opencvs(name):
    rays = some_rays(distortion(MODELS[name]).lens if name != "fisheye" else opencv_lens((0.1,)))
    expected = bend((rays[:, :2] / rays[:, 2:]).numpy(), MODELS[name])
    np.testing.assert_allclose(distortion(MODELS[name]).lens.places(rays).numpy(), expected, atol=1e-9)


def test_derivatives_are_those_of_places(lens):
    rays = 2.5 * some_rays(lens)
    rays[0] = torch.tensor([0.0, 0.0, 2.0])
    steps = 1e-6 * torch.eye(3, dtype=torch.float64)
    expected = torch.stack([(lens.places(rays + s) - lens.places(rays - s)) / 2e-6 for s in steps], dim=2)
    kept = rays[:, 2] > -2.3 if not lens.flat else torch.ones(len(rays), dtype=torch.bool)  # not right behind
    torch.testing.assert_close(lens.derivatives(rays)[kept], expected[kept], rtol=1e-5, atol=1e-6)


def test_beyond_its_image_a_distorting_pinhole_is_no_steeper():
    """Brown's polynomial grows 8 times as steep at the corners of the box in which slopes are clamped."""
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera("view", 64, 64, 32.0, 32.0, 32.0, 32.0, pose, lens=opencv_lens((-0.25, 0.05)))
    slopes = torch.cartesian_prod(*2 * [torch.linspace(-6, 6, 601, dtype=torch.float64)])
    points = torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1)
    splats = project_covariances(points, torch.eye(3).expand(len(points), 3, 3), points[:, 2], camera)
    spread, inside = splats.covs[:, 0] + splats.covs[:, 2], (camera.lens.places(points).abs() < 1.3).all(dim=1)
    assert spread.max() < 1.1 * spread[inside].max()
    assert spread.max() > 1.5 * spread[(camera.lens.places(points).abs() < 1).all(dim=1)].max(), "the margin counts"


@pytest.mark.parametrize("inside", [False, True], ids=["outside", "inside"])
def test_the_light_of_splats_is_that_of_ellipses_of_the_image(lens, inside, monkeypatch):
    """Their gradients are compiled, and those of splats that a lens bends are not."""
    view = view_through(lens) if inside else replace(make_camera((0.0, -4.0, 0.0)), lens=lens)
    scene, drawn = make_scene(200), []

    def seen(scene, view=view):
        renderer = Renderer.of(scene, [view], "matched", min_seen=0.0)

        def paint(splats):
            drawn.append(splats)
            return renderer.paint(splats, view.hw, (0.0, 0.0, 0.0))

        return transmittances(renderer.splats(view), view, 1 / 255, paint)

    assert seen(replace(scene[:40], logit_opacities=torch.full((40,), -3.0))).nanquantile(0.05) > 0.9, "all is seen"
    found = seen(scene)
    narrow = seen(scene, replace(view, lens=replace(lens, max_angle=10.0)))
    assert lens == ORTHO or narrow.isnan().sum() > found.isnan().sum() + 20, "of what the lens does not see"
    assert all(splats.planes is None for splats in drawn)
    monkeypatch.setattr("aaplug.core.light.in_image", lambda splats: splats)
    bent = seen(scene)
    assert bent.nanquantile(0.1) < 0.6
    assert torch.equal(found.isnan(), bent.isnan())
    assert (found - bent).abs().nanmean() < (0.1 if inside else 0.003 if not lens.flat else 0.02)


def test_a_lens_ends_where_its_radial_map_turns_back():
    lens = opencv_lens((-0.3, 0.0))  # ρ (1 - 0.3 ρ²) grows up to ρ = 1.05
    rays = lens.rays(torch.tensor([[0.69, 0.0], [0.72, 0.0]], dtype=torch.float64))
    assert rays[0, 0] > 0.9
    assert rays[1].abs().sum() == 0
    far = lens.places(torch.tensor([[1.0, 0.0, 1.0], [3.0, 0.0, 1.0]], dtype=torch.float64))
    assert far[1, 0] > far[0, 0]


def test_a_hollow_lens_is_refused_and_any_by_discs():
    renderer = Renderer.of(make_scene(10), [make_camera((0.0, -4.0, 0.0))], "2dgs")
    with pytest.raises(UsageError, match="recipe 2dgs draws pinhole views only"):
        renderer(view_through(EQUIDISTANT))
    with pytest.raises(UsageError, match="leaves no image"):
        opencv_lens((-1e9,)).places(torch.ones(1, 3))
    with pytest.raises(UsageError, match="equirect projection has no distortion"):
        Lens("equirect", radial=(0.1,))


def test_splats_in_their_planes_are_the_derivative_of_the_lens(lens):
    """A step of each Gaussian's axis moves its place as its plane says, by the lens's own derivative."""
    scene = make_scene(60, dtype=torch.float64)
    camera = view_through(lens)
    splats = project(scene, camera)
    assert splats.planes is not None
    assert splats.rates is not None
    local = (scene.means[splats.sources] - camera.centre) @ camera.cam_from_world[:3, :3].T
    ahead = local[:, 2] if lens.flat else local.norm(dim=1)
    torch.testing.assert_close(splats.depths, ahead)
    rays = torch.cat([local[:, :2], torch.ones_like(local[:, 2:])], dim=1) if lens == ORTHO else local
    right, down, along = torch.einsum("nij,nj->in", splats.planes, rays)
    assert torch.stack([right, down]).div(along).abs().max() < 1e-9  # its own ray meets its centre
    axes = rotation_matrices(scene.unit_quats[splats.sources]) * scene.scales[splats.sources][:, None]
    steps = []
    for axis in range(3):
        step = 1e-6 * axes[:, :, axis] @ camera.cam_from_world[:3, :3].T
        moved = rays + (torch.cat([step[:, :2], 0 * step[:, 2:]], dim=1) if lens == ORTHO else step)
        right, down, along = torch.einsum("nij,nj->in", splats.planes, moved)
        steps.append(torch.stack([right / along, down / along], dim=1) / 1e-6)
    factor = torch.stack(steps, dim=2)
    covs = (factor @ factor.mT).flatten(1)[:, [0, 1, 3]]
    inside = (local[:, :2].abs() < local[:, 2:]).all(dim=1) if lens.flat else torch.ones_like(ahead, dtype=torch.bool)
    torch.testing.assert_close(splats.covs[inside], covs[inside], rtol=1e-4, atol=1e-6)


def test_a_pixel_of_a_plane_has_the_area_of_the_images_own(lens):
    """Rates are px of the image per world unit: the square root of the area that a small square at the point covers."""
    if lens.distorts and lens.flat:
        pytest.skip("a flat lens samples as its pinhole does, as training did")
    scene, camera = make_scene(60, dtype=torch.float64), view_through(lens)
    splats = project(scene, camera)
    assert splats.rates is not None
    means, pose = scene.means[splats.sources], camera.cam_from_world
    local = (means - camera.centre) @ pose[:3, :3].T
    unit, ahead, slanted = torch.nn.functional.normalize, *torch.tensor([[0.0, 0.0, 1.0], [0.3, 0.5, 0.1]]).to(local)
    sight = ahead.expand_as(local) if lens == ORTHO else unit(local, dim=1)
    a = unit(torch.linalg.cross(sight, slanted.expand_as(local)), dim=1)
    b = torch.linalg.cross(sight, a)
    places = [camera.pixels(lens.places(local + 1e-6 * step)) - camera.pixels(lens.places(local)) for step in (a, b)]
    area = (places[0][:, 0] * places[1][:, 1] - places[0][:, 1] * places[1][:, 0]).abs()
    torch.testing.assert_close(splats.rates, area.sqrt() / 1e-6, rtol=1e-3, atol=0.0)


def test_tiles_draw_through_a_lens_what_the_reference_does(lens):
    scene, camera = make_scene(300), view_through(lens, side=48)
    training = TrainingViews.of(scene, [make_camera((0.0, -4.0, 0.0))])
    drawn = {
        name: Renderer.of(scene, training, "matched", rasterizer=rasterizer)(camera)
        for name, rasterizer in ALL_RASTERIZERS.items()
    }
    exact = drawn.pop("reference")
    assert exact.alpha.mean() > 0.2
    for name, tiles in drawn.items():
        error = (tiles.rgb.double() - exact.rgb).abs()
        assert error.max() < RULES_3DGS.min_alpha, name  # rounding can carry an alpha across the cut-off
        assert error.mean() < 1e-6, name


def test_bounds_are_found_once_and_forgotten_where_splats_change(lens, monkeypatch):
    renderer = Renderer.of(make_scene(60), [view_through(lens)], "matched", min_seen=0.0)
    splats, how = renderer.splats(view_through(lens)), (RAY, RULES_3DGS)
    found, again = splats.bounds(*how), RAY.bounding_ellipses(splats, RULES_3DGS)
    assert found is not None
    for name in ("means", "covs", "dets", "opacities"):
        torch.testing.assert_close(getattr(found, name), getattr(again, name), rtol=1e-4, atol=1e-3)
    assert torch.equal(splats[3:7].bounds(*how).covs, found.covs[3:7])
    assert splats.with_columns({"rgb": 2 * splats.rgb}).bounds(*how) is not None
    assert concatenated([splats[:3], splats[3:]]).bounds(*how) is not None
    assert concatenated([replace(splats[:3]), splats[3:]]).bounds(*how) is None
    assert splats.bounds(RAY, replace(RULES_3DGS, min_alpha=0.003)) is None
    for changed in (splats.blurred(0.1, compensate=True), replace(splats, opacities=splats.opacities / 2)):
        assert changed.bounds(*how) is None
    monkeypatch.setattr(type(RAY), "bounding_ellipses", lambda *_: pytest.fail("a second time"))
    renderer.paint(splats, (64, 64))


def test_bounding_ellipses_contain_every_pixel_of_a_splat_through_a_lens(lens):
    camera = view_through(lens, side=96)
    scene, sizes = make_scene(200, dtype=torch.float64), torch.linspace(-5.0, 1.0, 200, dtype=torch.float64)[:, None]
    scene = replace(scene, log_scales=scene.log_scales - scene.log_scales.mean(dim=1, keepdim=True) + sizes)
    splats = project(scene, camera).blurred(0.3, compensate=False)
    ellipses = RAY.bounding_ellipses(splats, RULES_3DGS)
    assert ellipses is not None
    y, x = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) + 0.5 for side in camera.hw), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 2)[::3]  # in each row others
    for part in torch.arange(len(splats)).split(50):
        own, around = splats[part], ellipses[part]
        alpha = own.opacities * RAY.exact(own, pixels[:, None] - own.means)
        drawn = alpha >= RULES_3DGS.min_alpha
        turn = camera.fx * lens.period
        x, y = (pixels[:, None] - around.means).unbind(dim=2)
        xx, xy, yy = around.covs.unbind(dim=1)
        across = [x + shift for shift in ((-turn, 0.0, turn) if turn else (0.0,))]
        squares = [(yy * dx**2 - 2 * xy * dx * y + xx * y**2) / around.dets for dx in across]
        nearest = torch.stack(squares).amin(dim=0)
        reach = 2 * (own.opacities / RULES_3DGS.min_alpha).log()
        assert (nearest <= reach)[drawn].all()


def test_a_panorama_has_neither_seam_nor_pole():
    """Turned by a quarter it shows the same, moved by a quarter; turned over, its poles are what the horizon was."""
    scene = make_scene(300)
    training = TrainingViews.of(scene, [make_camera((0.0, -4.0, 0.0))])
    renderer = Renderer.of(scene, training, "classic", rasterizer="eager")
    camera = view_through(EQUIRECT, side=96)
    image = renderer(camera).rgb
    quarter = torch.tensor([[0.0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    turned = renderer(replace(camera, cam_from_world=quarter @ camera.cam_from_world)).rgb
    torch.testing.assert_close(turned, image.roll(-camera.width // 4, dims=1), rtol=0, atol=1e-4)
    over = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    rolled = renderer(replace(camera, cam_from_world=over @ camera.cam_from_world)).rgb
    rays = EQUIRECT.rays(
        (torch.cartesian_prod(torch.arange(96.0), torch.arange(192.0)).flip(1) + 0.5 - torch.tensor([96.0, 48.0]))
        / camera.fx
    )
    there = camera.pixels(EQUIRECT.places(rays @ over[:3, :3].float())).view(96, 192, 2)
    x, y = (there - 0.5).unbind(dim=-1)
    expected = cv2.remap(image.numpy(), (x % 192).numpy(), y.numpy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    error = (torch.from_numpy(expected) - rolled)[8:-8].square().mean().sqrt()
    assert error < 0.02  # interpolation


def test_a_renderer_of_another_process_draws_through_a_lens():
    renderer, view = Renderer.of(make_scene(10), [make_camera((0.0, -4.0, 0.0))], "auto"), view_through(EQUIDISTANT)
    sent = pickle.loads(pickle.dumps(renderer.portable()))
    assert torch.equal(sent(view).rgb, renderer(view).rgb)
