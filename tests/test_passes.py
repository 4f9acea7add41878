"""Passes, each against a truth of its own; image files, whose formats give back what they hold and refuse the rest."""

import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import aaplug
from aaplug import Gaussians, Lens, Renderer, UsageError, write_scene
from aaplug.core.imaging import levels, linear
from aaplug.core.passes import PASSES
from aaplug.io.image_formats import IMAGE_FORMATS, PNG, Storage
from aaplug.io.images import read_image, read_rgba
from aaplug.io.layers import write_layers
from aaplug.rasterizers.reference import REFERENCE
from aaplug.rasterizers.tiled.order import Order
from aaplug.rasterizers.tiled.rasterizer import EAGER_TILED
from aaplug.rendering.frames import write_frames
from tests.conftest import SAMPLE, make_camera, make_scene, make_splats, run_python

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


needs_exr = pytest.mark.skipif(find_spec("OpenEXR") is None, reason="the package OpenEXR is not installed")
VIEWS = [make_camera((x / 2, -4.0, 0.3), (40, 30), name=f"v{x}") for x in range(3)]
GREEN = (0.2, 0.9, 0.4)


def storage(name: str, *passes: str, colour: str | None = "srgb", **other) -> Storage:
    return Storage.of(Path(f"a.{name}"), passes=passes or ("rgb",), colour=colour, **other)


def layers(height: int = 5, width: int = 7) -> dict[str, torch.Tensor]:
    """Premultiplied colours, alpha with empty and full pixels, and values of every size."""
    generator = torch.Generator().manual_seed(0)
    alpha = (torch.rand(height, width, generator=generator) * 1.4 - 0.2).clamp(0, 1)
    rgb = torch.rand(height, width, 3, generator=generator) * alpha[..., None]
    normal = torch.nn.functional.normalize(torch.randn(height, width, 3, generator=generator), dim=2)
    depth = 1e4 * torch.rand(height, width, generator=generator)
    return {"rgb": rgb, "alpha": alpha, "depth": depth, "normal": normal, "id": depth.round() - 1}


@pytest.mark.parametrize(("name", "bit_depth"), [("png", 8), ("png", 16), ("webp", 8)])
def test_transparency_is_stored_straight(tmp_path, name, bit_depth):
    drawn = layers()
    write_layers(tmp_path / f"a.{name}", drawn, storage(name, "rgb", "alpha", bit_depth=bit_depth))
    found, alpha = read_rgba(tmp_path / f"a.{name}"), drawn["alpha"][..., None]
    assert torch.equal(found[..., 3:], levels(alpha, bit_depth) / (2**bit_depth - 1))
    straight = levels(torch.where(alpha > 0, drawn["rgb"] / alpha, 0.0), bit_depth) / (2**bit_depth - 1)
    assert torch.equal(found[..., :3][found[..., 3] > 0], straight[found[..., 3] > 0])
    assert (alpha == 0).any()


def test_a_jpg_comes_close_and_alpha_alone_is_gray(tmp_path):
    ramp = torch.linspace(0, 1, 64).expand(48, 64)
    write_layers(tmp_path / "a.jpg", {"rgb": torch.stack([ramp, ramp, 1 - ramp], dim=2)}, storage("jpg"))
    assert (read_image(tmp_path / "a.jpg")[..., 0] - ramp).abs().max() < 0.02
    write_layers(tmp_path / "a.png", {"alpha": ramp}, storage("png", "alpha", colour=None))
    assert cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).shape == (48, 64)


def test_an_npz_holds_every_value(tmp_path):
    drawn = layers()
    write_layers(tmp_path / "a.npz", drawn, storage("npz", *drawn))
    with np.load(tmp_path / "a.npz") as found:
        assert all(np.array_equal(found[name], layer) for name, layer in drawn.items())


@needs_exr
@pytest.mark.parametrize("bit_depth", [16, 32])
def test_exr_layers_come_back_bit_for_bit(tmp_path, bit_depth):
    import OpenEXR

    drawn = layers()
    drawn["rgb"][0, 0] = 1e6  # above the largest finite half
    write_layers(tmp_path / "a.exr", drawn, storage("exr", *drawn, bit_depth=bit_depth))
    file = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True)
    found = {name: channel.pixels for name, channel in file.channels().items()}
    names = "R G B", "A", "depth.Z", "normal.X normal.Y normal.Z", "id.V"
    assert sorted(found) == sorted(" ".join(names).split())
    half = torch.float16 if bit_depth == 16 else torch.float32
    for (name, layer), channels in zip(drawn.items(), names, strict=True):
        dtype = torch.float32 if name in ("depth", "id") else half
        planes = layer.reshape(5, 7, -1).double().clamp(max=torch.finfo(dtype).max).to(dtype).unbind(dim=2)
        for plane, channel in zip(planes, channels.split(), strict=True):
            assert found[channel].dtype == plane.numpy().dtype, channel
            assert np.array_equal(found[channel], plane.numpy()), channel


READ_BY_OPENCV = """
import sys, cv2, numpy as np
if not any(" YES" in line or "build" in line for line in cv2.getBuildInformation().splitlines() if "OpenEXR:" in line):
    sys.exit(77)
np.save(sys.argv[2], cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED))
"""


@needs_exr
@pytest.mark.parametrize("bit_depth", [16, 32])
def test_opencv_reads_the_colours_of_an_exr_bit_for_bit(tmp_path, bit_depth):
    drawn = layers()
    write_layers(tmp_path / "a.exr", drawn, storage("exr", *drawn, bit_depth=bit_depth))
    run = run_python(READ_BY_OPENCV, tmp_path / "a.exr", tmp_path / "a.npy", OPENCV_IO_ENABLE_OPENEXR=1)
    if run.returncode == 77:
        pytest.skip("this build of OpenCV reads no EXR")
    assert run.returncode == 0, run.stderr
    found = np.load(tmp_path / "a.npy")[..., [2, 1, 0, 3]].astype(np.float32)
    expected = torch.cat([drawn["rgb"], drawn["alpha"][..., None]], dim=2)
    assert np.array_equal(found, (expected.half() if bit_depth == 16 else expected).float())


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0), GREEN])
def test_a_transparent_png_over_the_background_is_the_opaque_image(tmp_path, background):
    scene = make_scene(200)
    scene = replace(scene, sh=scene.sh[:, :1].clamp(-1.7, 1.7))  # colours in [0, 1], which a .png can hold
    renderer = Renderer.of(scene, VIEWS, "classic", rasterizer="eager")
    write_layers(tmp_path / "a.png", renderer(VIEWS[0])._asdict(), storage("png", "rgb", "alpha"))
    over = read_image(tmp_path / "a.png", background)
    opaque = replace(renderer, background=background)(VIEWS[0]).rgb
    assert 0.1 < renderer(VIEWS[0]).alpha.mean() < 0.9
    assert (levels(over, 8) - levels(opaque, 8)).abs().max() <= 1


@needs_exr
def test_a_transparent_exr_over_the_background_is_the_opaque_image_where_colours_exceed_1(tmp_path):
    import OpenEXR

    cameras = aaplug.read_cameras(SAMPLE)
    view = cameras.test[0].scaled(0.25)
    options = {"views": view.name, "scale": 0.25, "transparent": True, "colour": "srgb"}
    aaplug.render(SAMPLE / "chair.ply", cameras, tmp_path / "a.exr", **options)
    r, g, b, alpha = (OpenEXR.File(str(tmp_path / "a.exr")).channels()["RGBA"].pixels[..., i] for i in range(4))
    over = torch.from_numpy(np.stack([r, g, b], 2).astype(np.float32))
    over = over + (1 - torch.from_numpy(alpha.astype(np.float32)))[..., None] * torch.tensor(GREEN)
    opaque = Renderer.of(SAMPLE / "chair.ply", cameras, background=GREEN)(view).rgb
    assert (levels(over, 8) - levels(opaque, 8)).abs().max() <= 1


def test_linear_colours_are_decoded_once_from_straight_ones():
    values = torch.tensor([0.0, 0.02, 0.04045, 0.0405, 0.2, 0.5, 1.0, 1.3])
    expected = torch.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    assert torch.allclose(linear(values[:, None].expand(-1, 3))[:, 0], expected, rtol=1e-6)


@needs_exr
@pytest.mark.parametrize("name", ["exr", "npz"])
def test_colours_are_stored_as_asked_and_the_file_says_how(tmp_path, name):
    drawn = layers()
    alpha = drawn["alpha"][..., None]
    for passes, expected in (
        (["rgb"], linear(drawn["rgb"])),
        (["rgb", "alpha"], torch.where(alpha > 0, alpha * linear(drawn["rgb"] / alpha), 0.0)),
    ):
        how = storage(name, *passes, colour="linear", bit_depth=32)
        write_layers(tmp_path / f"a.{name}", drawn, how, overwrite=True)
        rgb, said = rgb_and_space(tmp_path / f"a.{name}")
        assert np.array_equal(rgb, expected)
        assert said == "lin_rec709_display"
    default = Storage.of(Path(f"a.{name}"), bit_depth=32)
    assert default.colour == {"exr": "linear", "npz": "srgb"}[name]
    write_layers(tmp_path / f"s.{name}", drawn, replace(default, colour="srgb"))
    rgb, said = rgb_and_space(tmp_path / f"s.{name}")
    assert (np.array_equal(rgb, drawn["rgb"]), said) == (True, "srgb_rec709_display")


def rgb_and_space(path: Path) -> tuple[np.ndarray, str]:
    """The colours of a file, and how it says that they are stored."""
    if path.suffix == ".npz":
        with np.load(path) as found:
            return found["rgb"], str(found["colorSpace"])
    import OpenEXR

    file = OpenEXR.File(str(path), separate_channels=True)
    return np.stack([file.channels()[c].pixels for c in "RGB"], axis=2), file.header()["colorSpace"]


REFUSED = {
    "a.png --colour linear": "--colour: a .png has no linear colours; .exr, .npz can",
    "a.jpg --transparent": "--transparent: a .jpg cannot hold alpha; .png, .webp, .exr, .npz can",
    "a.jpg --bit-depth 16": "--bit-depth: a .jpg has 8 bits per channel, not 16",
    "a.png --bit-depth 32": "--bit-depth: a .png has 8 or 16 bits per channel, not 32",
    "a.png --format exr": "--format: is exr, but a.png is named as a .png",
    "a.png --transparent --background white": "--background: is not stored where alpha is",
    "a.npz --passes depth --background white": "--background: is of the pass rgb, which --passes leaves out",
    "a.gif": "name a folder, or one .png",
    "a.mp4": "name a folder, or one .png",
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_a_format_cannot_hold_is_refused_before_anything_is_drawn(cli, monkeypatch, words):
    monkeypatch.setattr(Renderer, "__call__", None)
    Path("a.png").write_bytes(b"mine")
    cli.refused(f"render scene.ply --cameras . --overwrite -o {words}", REFUSED[words])


def test_an_exr_without_its_package_names_the_extra(cli, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    cli.refused("render scene.ply --cameras . -o out --format exr", "--format: exr needs OpenEXR: pip install")
    assert not Path("out").exists()


@pytest.mark.parametrize(
    "name", [name for name, each in IMAGE_FORMATS.items() if each.needs is None or find_spec(each.needs)]
)
def test_a_folder_gets_one_file_a_view_in_the_format(cli, name):
    written = []
    for _ in range(2):  # and the same bytes again
        cli.done(f"render scene.ply --cameras . -o out --views train --format {name} --overwrite")
        files = {path.name: path.read_bytes() for path in Path("out").iterdir()}
        assert sorted(files) == [f"r_{i}.{name}" for i in range(3)]
        written.append(files)
    assert written[0] == written[1]
