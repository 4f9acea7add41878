"""Image files of rendered views: every format gives back what it can hold, and refuses the rest before it draws."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import aaplug
from aaplug.core.imaging import levels, linear
from aaplug.io.image_formats import IMAGE_FORMATS, Storage
from aaplug.io.images import read_image, read_rgba
from aaplug.io.layers import write_layers
from aaplug.rendering.renderer import Renderer
from tests.conftest import SAMPLE, make_camera, make_scene, run_python

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
