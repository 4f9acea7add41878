"""All scene formats: laws over the registry, and each against the scene that it was made of, within its steps."""

import base64
import io
import json
import re
import struct
import zipfile
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import torch

from aaplug import Scene, SceneFileOptions, WritableFormat, read_scene, write_scene
from aaplug.core.conventions import ANTIALIASED, CLASSIC, MIP
from aaplug.core.gaussians import MAX_LOG_SCALE, Fusion, Gaussians, joined
from aaplug.core.spherical_harmonics import sh_colour
from aaplug.io.gltf import Gltf, glb_start
from aaplug.io.scenes import HEAD_BYTES, OWN, SCENE_FORMATS, codebooks, find_scene, ply, sog, usd
from aaplug.io.scenes import gltf as scene_gltf
from aaplug.io.scenes.spz import AXES, packed
from aaplug.system.errors import FormatError, OutputError, UsageError
from aaplug.system.registry import Registry, named
from tests.conftest import SAMPLE, assert_equal, make_scene, memory_taken, needs_peak_memory
from tests.scene_files import DATA, MADE, STORED, ksplat, oracle, splat, splats, write_file, write_json

MADE_SPZ = ("v1.spz", "v2.spz", "raw.spz", "degree4.spz")
CARRY_A_TAG = dict.fromkeys((*STORED, *MADE_SPZ, "lod-meta.json"), MIP)
TAGLESS = ("plain.splat", "level0.ksplat", "level1.ksplat", "level2.ksplat", "run.pt", "scene.lcc", "scene.lcc2")
# largest errors of position, log-scale, opacity, colour and harmonics: a step of each format
STEPS = {
    "ply": (0.0, 0.0, 0.0, 0.0, 0.0),
    "compressed.ply": (3e-3, 3e-3, 3e-3, 0.02, 0.02),
    **dict.fromkeys(MADE_SPZ, (3e-4, 0.04, 3e-3, 0.02, 6e-3)),
    "v1.spz": (2e-3, 0.04, 3e-3, 0.02, 6e-3),
    "spz": (3e-4, 0.04, 3e-3, 0.02, 0.07),  # its writers keep 4 or 5 bits of harmonics
    "lcc2": (3e-4, 0.04, 3e-3, 0.02, 6e-3),
    "sog": (2e-4, 0.03, 4e-3, 0.03, 0.7),  # 256 values a codebook; harmonics share a palette
    "lod-meta.json": (2e-4, 0.03, 4e-3, 0.03, 0.7),
    "splat": (0.0, 1e-5, 3e-3, 8e-3, 0.0),
    "level0.ksplat": (0.0, 1e-5, 3e-3, 8e-3, 0.0),
    "level1.ksplat": (2e-4, 1e-3, 3e-3, 8e-3, 1e-3),
    "level2.ksplat": (2e-4, 1e-3, 3e-3, 8e-3, 8e-3),
    "pt": (0.0, 0.0, 1e-6, 0.0, 0.0),
    "lcc": (0.0, 2e-3, 3e-3, 8e-3, 2e-3),
}


@pytest.mark.parametrize(("suffix", "far"), [("compressed.ply", 3e2), ("spz", 2e6), ("sog", 3e30)])
def test_a_gaussian_far_away_that_moves_others_is_told(tmp_path: Path, caplog, suffix: str, far: float):
    scene = replace(oracle(), origin=None)
    write_scene(tmp_path / f"a.{suffix}", scene)
    assert "moves" not in caplog.text
    scene.means[3, 0] = far
    write_scene(tmp_path / f"b.{suffix}", scene)
    assert re.search(r"b\.\S+: the steps of .*, move \d+ of \d+ Gaussians by more than their size", caplog.text)


@pytest.mark.parametrize(
    ("suffix", "ends"), [("spz", (-10, 5.9375)), ("spz.glb", (-10, 5.9375)), ("compressed.ply", (-20, 20))]
)
def test_a_scene_of_units_that_a_format_has_no_sizes_for_is_told(tmp_path: Path, caplog, suffix: str, ends):
    scene = replace(oracle(), origin=None)
    for number, end in enumerate(ends):
        for beyond in (False, True):
            caplog.clear()
            scene.log_scales[:] = torch.tensor([end, -40.0, -40.0])
            scene.log_scales[:, 0] += (-0.01, 0.01)[number] if beyond else 0
            write_scene(tmp_path / f"a.{suffix}", scene, overwrite=True)
            assert ("cannot hold 40 of 40 Gaussians of another size than" in caplog.text) is beyond


@pytest.fixture
def expected() -> Gaussians:
    return oracle()


def kind_of(name: str) -> str:
    longest = sorted((format.name for format in OWN), key=len, reverse=True)
    return "sog" if "sog" in name else next(kind for kind in longest if f".{name}".endswith("." + kind))


def refused(path: Path, problem: str, **how: bool) -> None:
    with pytest.raises(FormatError, match=problem):
        read_scene(path, **how).gaussians()


def in_the_same_order(scene: Gaussians, expected: Gaussians) -> Gaussians:
    """The expected scene's rows as the file has them: writers sort, so nearest positions pair up."""
    nearest = torch.cdist(scene.means, expected.means).argmin(dim=1)
    assert len(nearest.unique()) == len(expected)
    return expected[nearest]


@pytest.mark.parametrize("name", [*CARRY_A_TAG, *TAGLESS])
def test_each_format_gives_the_scene_within_its_steps(tmp_path: Path, expected, name: str):
    """Recognized by its content, as a whole and in parts, and once more from a .ply that it is written to."""
    axes = "opencv" if name.startswith("oracle_v") else "auto"  # splat-transform turns none
    path, kind = write_file(tmp_path, name), kind_of(name)
    assert [format.name for format in OWN if format.sniff(path, path.read_bytes()[:HEAD_BYTES])] == [kind]
    opened = read_scene(path, allow_checkpoint=True, spz_axes=axes)
    scene, parts = opened.gaussians(), list(opened.parts(size=16))
    position, scale, opacity, colour, rest = STEPS.get(name) or STEPS[kind]
    assert len(scene) == len(expected)
    twin = in_the_same_order(scene, expected)
    k = min(scene.sh.shape[1], twin.sh.shape[1])
    # most formats store a range; values of the scene beyond it are cut off
    colours = [(0.5 + 0.2821 * s.sh[:, 0]).clamp(0, 1) for s in (scene, twin)]
    for actual, wanted, step in (
        (scene.means, twin.means, position),
        (scene.log_scales, twin.log_scales, scale),
        (scene.opacities, twin.opacities, opacity),
        (*colours, colour),
        (scene.sh[:, 1:k].clamp(-0.99, 0.99), twin.sh[:, 1:k].clamp(-0.99, 0.99), rest),
    ):
        torch.testing.assert_close(actual, wanted, rtol=1e-6, atol=step + 1e-6)
    both = torch.stack([scene.sh[:, 1:k].flatten(), twin.sh[:, 1:k].flatten()])
    assert k == 1 or torch.corrcoef(both)[0, 1] > 0.9
    alignment = (scene.unit_quats * twin.unit_quats).sum(dim=1).abs()
    assert alignment.min() > (0.997 if name in MADE and name.endswith("spz") else 0.9998)
    assert (opened.format, scene.convention, scene.flat) == (kind, CARRY_A_TAG.get(name, CLASSIC), False)
    assert [len(part) for part in parts] == [16, 16, 8]
    write_scene(tmp_path / "out.ply", scene)
    again = read_scene(tmp_path / "out.ply").gaussians()
    assert again.convention == scene.convention
    for same in (joined(parts), again):
        assert_equal(scene, same)


@pytest.mark.parametrize(
    ("name", "old", "new", "match"),
    [
        ("scene.lcc", '"Quality"', '"Best"', "fileType should be Portable or Quality, not 'Best'"),
        ("scene.lcc", 'Level": 2', 'Level": 3', "Index.bin: has 72 bytes, not a multiple of 52 for 3 levels"),
        ("scene.lcc", "envscale", "sky", "attributes: envscale is missing"),
        ("lod-meta.json", '"version": 1', '"version": 2', "version should be 1, not 2"),
        ("lod-meta.json", "0_0/meta", "../meta", "names '../meta.json', which leads out of its folder"),
        ("lod-meta.json", '"count": 25', '"count": 41', "count should be a whole number from 0 to 40, not 41"),
        ("lod-meta.json", '25, "count": 15', '0, "count": 16', "names 41 Gaussians in files that hold 40"),
        ("lod-meta.json", '"0":', '"2":', "names 0 Gaussians in files that hold 0"),
        (
            "lod-meta.json",
            '1_0/meta.json"], "tree": {"children": [',
            '0_0/../0_0/meta.json"], "tree": {"children": [{"lods": {"0": {"file": 1}}}, ',
            "names 80 Gaussians in files that hold 40",
        ),
        ("scene.lcc2", '"name": 0', '"name": 7', "name should be a whole number from 0 to 2, not 7"),
        ("scene.lcc2", "b.spz", "scene.lcc2", "names 'scene.lcc2', which is neither a SOG nor a .spz"),
    ],
)
def test_an_index_that_its_files_do_not_bear_out_is_refused(tmp_path: Path, name: str, old: str, new: str, match: str):
    path = write_file(tmp_path, name)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(FormatError, match=match):
        read_scene(path)


def test_files_of_an_index_have_a_limit_in_all_before_the_next_is_unpacked(tmp_path: Path, monkeypatch):
    path, opened = write_file(tmp_path, "lod-meta.json"), list[Path]()
    original = sog.open_scene
    monkeypatch.setattr(sog, "open_scene", lambda file, options: opened.append(file) or original(file, options))
    for copy in "bcdef":
        copytree(tmp_path / "0_0", tmp_path / copy)
    files = [f"{folder}/meta.json" for folder in ("0_0", *"bcdef")]
    children = [{"lods": {"0": {"file": place}}} for place in range(len(files))]
    write_json(path, {"version": 1, "filenames": files, "tree": {"children": children}})
    assert (read_scene(path).count, len(opened)) == (240, 6)
    monkeypatch.setenv("AAPLUG_GAUSSIANS", "100")
    with pytest.raises(FormatError, match="holds 120 Gaussians and the limit is 100"):
        read_scene(path)
    assert len(opened) == 6 + 3


WRITABLE = [f.name for f in OWN if isinstance(f, WritableFormat) and find_spec(getattr(f, "needs", None) or "aaplug")]


# largest errors of what is written: position, log-scale, opacity, colour (harmonic of degree 0), harmonics, and how far
# a quaternion's cosine may lie below 1
WRITTEN = {
    "ply": (0.0, 0.0, 0.0, 0.0, 0.0, 1e-6),
    "compressed.ply": (2e-3, 2e-3, 2e-3, 0.01, 0.016, 3e-6),
    "spz": (5e-7, 1 / 32, 0.5 / 255, 0.5 / 255 / 0.15, 1 / 256, 1e-5),
    "sog": (1e-4, 0.03, 0.5 / 255, 0.03, 0.02, 3e-5),
    "splat": (0.0, 1e-6, 0.5 / 255, 0.5 / 255 / 0.28, 0.0, 2e-4),
    "glb": (0.0, 1e-6, 1e-6, 0.0, 0.0, 1e-6),
    "spz.glb": (5e-7, 1 / 32, 0.5 / 255, 0.5 / 255 / 0.15, 1 / 256, 1e-4),
}
WRITTEN |= {"gltf": WRITTEN["glb"], "meta.json": WRITTEN["sog"]} | dict.fromkeys(usd.SUFFIXES, WRITTEN["glb"])
RANGES = {"spz": (-1, 127 / 128), "spz.glb": (-1, 127 / 128), "compressed.ply": (-4, 4)}  # of harmonics
SORTED = ("sog", "meta.json", "compressed.ply")  # formats whose writer sorts


def half_turned(quats: torch.Tensor) -> torch.Tensor:
    """The quaternions, wxyz, of the Gaussian as it is and after half a turn about each of its own axes, [n, 4, 4]."""
    w, x, y, z = quats.T
    turned = ((w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w))
    return torch.stack([torch.stack(each, dim=1) for each in turned], dim=1)


HELD = [(0, CLASSIC), (1, CLASSIC), (2, MIP), (3, ANTIALIASED), (3, MIP)]
# these hold the tables of another in other files, so one scene is enough
ALIKE = ("gltf", "meta.json", *usd.SUFFIXES[1:])
WRITES = [(n, *held) for n in WRITABLE for held in HELD if n not in ALIKE or held == (3, ANTIALIASED)]


@pytest.mark.parametrize(("name", "degree", "convention"), WRITES)
def test_what_is_written_is_read_within_steps_and_written_again_as_it_is(
    tmp_path: Path, expected, name, degree, convention, caplog
):
    """Writing rounds once: what is read back is a scene that the format holds exactly."""
    fused = (Fusion("matched-energy", {"variance": "0.2"}),) * (degree == 3)
    scene = replace(expected, sh=expected.sh[:, : (degree + 1) ** 2], convention=convention, fused=fused, origin=None)
    (tmp_path / "again").mkdir()
    first, second = tmp_path / f"a.{name}", tmp_path / "again" / f"a.{name}"
    if name == "meta.json":
        first, second = tmp_path / name, tmp_path / "again" / name.upper()
    write_scene(first, scene)
    again = read_scene(first).gaussians()
    assert (len(again), again.sh_degree) == (len(scene), 0 if name == "splat" else degree)
    kept = name not in ("spz", "splat")
    flagged = MIP if name == "spz" and convention.compensated else CLASSIC
    assert (again.convention, again.fused) == ((convention, fused) if kept else (flagged, ()))
    lost = (again.convention, again.fused) != (convention, fused) or again.sh_degree < degree
    assert ("cannot hold" in caplog.text) == lost
    twin = in_the_same_order(again, scene) if name in SORTED else scene
    k, ends = again.sh.shape[1], RANGES.get(name, (-torch.inf, torch.inf))
    position, scale, opacity, colour, rest, turn = WRITTEN[name]
    for actual, wanted, step in (
        (again.means, twin.means, position),
        (again.log_scales, twin.log_scales, scale),
        (again.opacities, twin.opacities, opacity),
        (again.sh[:, 0].clamp(-1.7, 1.7), twin.sh[:, 0].clamp(-1.7, 1.7), colour),
        (again.sh[:, 1:], twin.sh[:, 1:k].clamp(*ends), rest),
    ):
        torch.testing.assert_close(actual, wanted, rtol=1e-6, atol=step + 1e-6)
    alike = half_turned(twin.unit_quats)[:, : 4 if name == "spz.glb" else 1]
    assert 1 - (again.unit_quats[:, None] * alike).sum(dim=2).abs().amax(dim=1).min() <= turn
    write_scene(second, replace(again, convention=convention, fused=fused, origin=None))
    twice = read_scene(second).gaussians()
    twice = in_the_same_order(twice, again) if name in SORTED else twice
    torch.testing.assert_close(in_the_same_order(again, twice).means, twice.means, rtol=0, atol=position / 100)
    torch.testing.assert_close(twice.log_scales, again.log_scales, rtol=0, atol=1e-6)
    torch.testing.assert_close(twice.sh, again.sh, rtol=0, atol=2e-6)


@dataclass(frozen=True)
class Toy:
    """A plug-in: a .ply by another suffix, and any .ply that is called so."""

    name: str = "toy"
    needs: str | None = None

    def sniff(self, path: Path, head: bytes) -> bool:
        return path.name.startswith("toy")

    def open_scene(self, path: Path, options: SceneFileOptions) -> Scene:
        return replace(ply.open_scene(path, options), format=self.name)

    def write(self, path, parts, count, overwrite, options) -> None:
        ply.write(path, parts, count, overwrite, options)


def test_a_plug_in_is_asked_before_the_own_formats_and_written_by_its_suffix(tmp_path: Path, expected, monkeypatch):
    formats = Registry("scene format", "aaplug.io.scenes:SceneFormat", named(OWN))
    formats.register("toy", Toy())
    monkeypatch.setattr("aaplug.io.scenes.SCENE_FORMATS", formats)
    write_scene(tmp_path / "toy.ply", expected)
    assert read_scene(tmp_path / "toy.ply").format == "toy"
    write_scene(tmp_path / "a.toy", expected)
    assert read_scene(tmp_path / "a.toy").format == "ply"
    with pytest.raises(UsageError, match="is not a scene format"):
        SCENE_FORMATS.register("wrong", object())  # pyright: ignore[reportArgumentType]


def test_a_format_that_is_not_written_says_which_are(tmp_path: Path, expected):
    for name in ("a.ksplat", "a.pt", "a"):
        with pytest.raises(OutputError, match=r"can be written: \.compressed\.ply, \.ply, \.spz, \.sog, \.splat"):
            write_scene(tmp_path / name, expected)


@pytest.mark.parametrize("name", WRITABLE)
def test_no_format_is_written_with_what_it_cannot_hold(tmp_path: Path, expected, name):
    path = tmp_path / (name if name == "meta.json" else f"a.{name}")
    for column in expected.columns:
        values = getattr(expected, column).clone()
        values[2] = torch.nan
        with pytest.raises(OutputError, match=r"the scene to write cannot be used: row 2 has NaN in"):
            write_scene(path, replace(expected, **{column: values}))
    if name not in ("ply", "spz"):
        with pytest.raises(OutputError, match="cannot hold a scene without Gaussians"):
            write_scene(path, expected[:0])
        assert not path.exists()
    else:
        write_scene(path, expected[:0])
        assert len(read_scene(path).gaussians()) == 0
    tracked = {name: column.double().requires_grad_() for name, column in expected.columns.items()}
    write_scene(path, replace(expected, **tracked), overwrite=True)
    assert len(read_scene(path).gaussians()) == len(expected)


@pytest.mark.parametrize("name", ["splat", "toy"])
def test_a_format_says_what_it_loses(tmp_path: Path, expected, caplog, monkeypatch, name):
    """The seam says it for a plug-in, too."""
    monkeypatch.setitem(SCENE_FORMATS._entries, "toy", Toy())
    write_scene(tmp_path / f"plain.{name}", replace(expected, sh=expected.sh[:, :1], convention=CLASSIC))
    assert not caplog.text
    write_scene(tmp_path / f"rich.{name}", replace(expected, convention=MIP))
    [record] = caplog.records
    lost = "harmonics above degree 0 and the record of its training (mip)"
    assert f"a .{name} cannot hold {lost}; a .ply can" in record.message
    caplog.clear()
    write_scene(tmp_path / "flagged.spz", replace(expected, convention=MIP, fused=(Fusion("finetune"),)))
    assert "a .spz cannot hold the record of what was fused; a .ply can" in caplog.text


def test_spz_is_written_in_the_axes_asked_for(tmp_path: Path, expected):
    write_scene(tmp_path / "a.spz", expected, spz_axes="opencv")
    same = read_scene(tmp_path / "a.spz", spz_axes="opencv").gaussians()
    torch.testing.assert_close(same.means, expected.means, rtol=0, atol=2e-6)
    assert "axes as stored" in read_scene(tmp_path / "a.spz", spz_axes="opencv").notes[1]
    stated = read_scene(tmp_path / "a.spz")
    assert stated.other is None
    assert "RDF, which the file states" in stated.notes[1]
    assert torch.equal(stated.gaussians().means, same.means)
    write_scene(tmp_path / "a3.spz", expected, spz_axes="opencv", spz_version=3)
    assumed = read_scene(tmp_path / "a3.spz")
    assert assumed.other is not None
    assert torch.equal(assumed.gaussians().means, same.means * torch.tensor([1.0, -1.0, -1.0]))


@pytest.mark.parametrize("axes", AXES[1:])
def test_axes_that_a_spz_states_are_turned_into_ours(tmp_path: Path, expected, axes: str):
    data = bytearray(packed(Path("a"), expected, 4, "RDF"))
    struct.pack_into("<I", data, 40, 9)
    (tmp_path / "a.spz").write_bytes(data)
    refused(tmp_path / "a.spz", "states the coordinate system 9; known are")
    struct.pack_into("<I", data, 40, AXES.index(axes))
    (tmp_path / "a.spz").write_bytes(data)
    scene = read_scene(tmp_path / "a.spz").gaussians()
    signs = torch.tensor([1.0 if a == b else -1.0 for a, b in zip(axes, "RDF", strict=True)])
    torch.testing.assert_close(scene.means, expected.means * signs, rtol=0, atol=2e-6)
    directions = torch.nn.functional.normalize(torch.randn(40, 3), dim=1)
    colours = sh_colour(scene.sh, directions * signs), sh_colour(expected.sh.clamp(-1, 127 / 128), directions)
    torch.testing.assert_close(*colours, rtol=0, atol=0.05)


def test_spz_holds_the_ends_of_its_ranges(tmp_path: Path, expected):
    ends = replace(
        expected[:2],
        means=torch.tensor([[3e6, -3e6, 0.0], [0.0, 1.0, 2.0]]),
        log_scales=torch.tensor([[-torch.inf, 0.0, 50.0], [-10.0, 5.9375, 0.0]]),
        logit_opacities=torch.tensor([torch.inf, -200.0]),
    )
    write_scene(tmp_path / "a.spz", ends)
    again = read_scene(tmp_path / "a.spz").gaussians()
    torch.testing.assert_close(again.means, ends.means, rtol=0, atol=0.25)
    assert again.log_scales.tolist() == [[-10, 0, 5.9375], [-10, 5.9375, 0]]
    assert again.opacities.tolist() == pytest.approx([1, 0], abs=1e-6)
    farthest = replace(expected, origin=None, means=expected.means.clone())
    farthest.means[3] = torch.tensor([1.0, -1.0, 1.0]) * (1024 - 2**-14)  # half a step below what the format holds
    write_scene(tmp_path / "b.spz", farthest)
    means = read_scene(tmp_path / "b.spz").gaussians().means
    torch.testing.assert_close(means, farthest.means, rtol=0, atol=1e-4)  # each stays on its side


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"flat": True}, "2D Gaussians"),
        ({"filter_3d": torch.ones(40)}, "filter_3D"),
        ({"means": torch.full((40, 3), 1e9)}, r"as far as 1e\+09 from the origin; move the scene by aaplug merge, or"),
    ],
)
def test_spz_says_what_it_cannot_hold(tmp_path: Path, expected, changes, problem):
    with pytest.raises(OutputError, match=problem):
        write_scene(tmp_path / "a.spz", replace(expected, **changes))
    fourth = replace(expected, sh=torch.zeros(40, 25, 3))
    with pytest.raises(OutputError, match="harmonics of degree 4, only up to 3"):
        write_scene(tmp_path / "a.spz", fourth, spz_version=3)
    assert not list(tmp_path.iterdir())
    write_scene(tmp_path / "a.spz", fourth)
    assert read_scene(tmp_path / "a.spz").sh_degree == 4


def test_a_sog_folder_is_a_scene(expected):
    assert find_scene(DATA / "oracle_sog").name == "meta.json"
    assert read_scene(DATA / "oracle_sog").title == "oracle_sog"
    assert read_scene(SAMPLE / "chair.ply").title == "chair.ply"
    assert read_scene(find_scene(DATA / "oracle_sog")).count == len(expected)


def sog_folder(folder: Path, **changes: object) -> Path:
    for file in (DATA / "oracle_sog").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    meta = json.loads((folder / "meta.json").read_text()) | changes
    return write_json(folder / "meta.json", {k: v for k, v in meta.items() if v is not None})


def test_version_1_of_sog(tmp_path: Path, expected):
    """Bytes between least and most, the logit of opacity among them."""
    meta = json.loads((DATA / "oracle_sog" / "meta.json").read_text())
    first = {
        "means": {**meta["means"], "shape": [40, 3]},
        "scales": {"mins": [-5.0] * 3, "maxs": [0.0] * 3, "files": ["scales.webp"]},
        "sh0": {"mins": [-1.0] * 3 + [-4.0], "maxs": [1.0] * 3 + [4.0], "files": ["sh0.webp"]},
        "quats": meta["quats"],
        "shN": {"mins": -2.0, "maxs": 2.0, "files": meta["shN"]["files"]},
    }
    path = write_json(sog_folder(tmp_path), first)
    scene, second = read_scene(path).gaussians(), read_scene(DATA / "oracle_sog" / "meta.json").gaussians()
    assert torch.equal(scene.means, second.means)
    assert scene.sh_degree == 3
    steps = (scene.log_scales + 5) / 5 * 255
    torch.testing.assert_close(steps, steps.round(), atol=1e-3, rtol=0)
    assert scene.logit_opacities.abs().max() <= 4
    assert scene.convention == CLASSIC


def test_sog_of_discs(tmp_path: Path):
    scene = read_scene(sog_folder(tmp_path, model="2dgs")).gaussians()
    assert scene.flat
    assert (scene.log_scales[:, 2] == -MAX_LOG_SCALE).all()
    assert read_scene(sog_folder(tmp_path, model=None)).convention == CLASSIC


# Hostile files


def test_sog_reads_nothing_elsewhere(tmp_path: Path):
    for file in ("../secret.webp", "/etc/passwd", "C:\\x.webp", "", 3, "x\0"):
        refused(sog_folder(tmp_path, quats={"files": [file]}), "files should be names of plain files")
    (tmp_path / "scene").mkdir()
    path = sog_folder(tmp_path / "scene")
    inside, outside = tmp_path / "scene" / "quats.webp", tmp_path / "outside.webp"
    inside.rename(outside)
    inside.symlink_to(outside)
    refused(path, "leads out of its folder")


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"count": 10**12}, "limit is 100,000,000"),
        ({"count": 90_000_000}, "bomb"),
        ({"count": -1}, "whole number"),
        ({"count": True}, "number"),
        ({"version": 3}, "version should be 2"),
        ({"means": None}, "means is missing"),
        ({"scales": {"codebook": [1.0], "files": ["scales.webp"]}}, "codebook should be 256"),
        ({"quats": {"files": ["quats.webp", "quats.webp"]}}, "files should be 1 names"),
        ({"quats": {"files": ["meta.json"]}}, "cannot be read"),
        ({"quats": 5}, "quats should be an object"),
    ],
    ids=str,
)
def test_odd_sogs_are_refused(tmp_path: Path, changes: dict[str, object], problem: str):
    refused(sog_folder(tmp_path, **changes), problem)


def test_spz_streams_are_held_to_their_size_and_a_damaged_byte_in_them_is_noticed(tmp_path: Path):
    data = bytearray((DATA / "oracle_v4.spz").read_bytes())
    for wrong in (0, 2**63, 361):
        struct.pack_into("<Q", data, 32 + 8, wrong)
        (tmp_path / "a.spz").write_bytes(data)
        refused(tmp_path / "a.spz", r"lists a stream|announce")
    whole = (DATA / "oracle_v4.spz").read_bytes()
    (tmp_path / "a.spz").write_bytes(whole[:-1])
    refused(tmp_path / "a.spz", f"is cut short: {len(whole):,} bytes promised, {len(whole) - 1:,} there")
    write_scene(tmp_path / "b.spz", replace(oracle(), origin=None))
    whole = (tmp_path / "b.spz").read_bytes()
    for place in range(len(whole) // 2, len(whole), 37):  # beyond the header and the list of streams
        (tmp_path / "b.spz").write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        refused(tmp_path / "b.spz", r"b\.spz")


@pytest.mark.parametrize("level", [0, 2])
def test_ksplat_counts_that_lie_do_no_harm(tmp_path: Path, level: int):
    for offset in (4, 16, 20, 4096, 4104, 4108, 4128, 4132, 4136):
        data = bytearray(ksplat(level))
        struct.pack_into("<H" if offset in (20, 4136) else "<I", data, offset, 65000)
        (tmp_path / "a.ksplat").write_bytes(data)
        try:
            scene = read_scene(tmp_path / "a.ksplat").gaussians()
        except FormatError:
            continue
        # more room in buckets and in blocks is no harm: what is there is read
        assert offset in (4104, 4128) or level == 0
        assert len(scene) == 40


@pytest.mark.parametrize(("stated", "convention"), [("true", ANTIALIASED), ("false", CLASSIC), ("[]", CLASSIC)])
def test_a_checkpoint_is_what_the_cfg_of_its_run_says(tmp_path: Path, stated, convention):
    (tmp_path / "cfg.yml").write_text(f"ssim_lambda: 0.2\nantialiased: {stated}\nports: !!python/tuple [1]\n")
    (tmp_path / "ckpts").mkdir()
    opened = read_scene(write_file(tmp_path / "ckpts", "run.pt"), allow_checkpoint=True)
    assert opened.convention == convention
    assert ("cfg.yml of its run says" in opened.evidence) == (stated != "[]")


@pytest.mark.parametrize("kind", ["2dgs", "2dgs-inria"])
def test_a_checkpoint_of_gsplats_2dgs_trainer_holds_discs(tmp_path: Path, kind):
    (tmp_path / "cfg.json").write_text(f'{{"antialiased": false, "model_type": "{kind}"}}')
    (tmp_path / "ckpts").mkdir()
    opened = read_scene(write_file(tmp_path / "ckpts", "run.pt"), allow_checkpoint=True)
    assert opened.evidence == "cfg.json of its run says 2D Gaussians (2DGS), treated as classic"
    discs, stored = opened.gaussians(), splats()["scales"]
    assert discs.flat
    assert discs.log_scales.equal(torch.cat([stored[:, :2], torch.full((40, 1), -MAX_LOG_SCALE)], dim=1))


class Trap:
    def __reduce__(self):
        return Path.touch, (Path("trap"),)


def test_a_checkpoint_is_not_inflated(tmp_path: Path):
    stream = io.BytesIO()
    torch.save({"splats": {}}, stream)
    with zipfile.ZipFile(tmp_path / "a.pt", "w", zipfile.ZIP_DEFLATED) as new:
        for member in zipfile.ZipFile(stream).infolist():
            new.writestr(member.filename, zipfile.ZipFile(stream).read(member))
    refused(tmp_path / "a.pt", "compressed members", allow_checkpoint=True)


GOOD = splats()
WRONG_COLUMNS = (
    ("means", torch.zeros(())),
    ("means", GOOD["means"].to("meta")),
    ("opacities", GOOD["opacities"].to_sparse()),
    ("quats", torch.zeros(40, 3)),
    ("scales", torch.zeros(40, 3, dtype=torch.int32)),
    ("shN", torch.zeros(40, 5, 3)),
    ("opacities", torch.zeros(39)),
    ("opacities", torch.zeros(1).expand(10**9)),
    ("sh0", torch.zeros(1).expand(40, 1, 3)[:, :, :2]),
)
ODD_COLUMNS = [{"splats": GOOD | {name: column}} for name, column in WRONG_COLUMNS]
ODD = [Trap(), {"splats": Trap()}, [1], {"splats": {"means": 3}}, *ODD_COLUMNS]


@pytest.mark.parametrize("content", ODD, ids=range(len(ODD)))
def test_a_checkpoint_of_something_else_is_refused_and_runs_nothing(tmp_path: Path, monkeypatch, content: object):
    monkeypatch.chdir(tmp_path)
    torch.save(content, tmp_path / "a.pt")
    refused(tmp_path / "a.pt", r"a\.pt", allow_checkpoint=True)
    assert not (tmp_path / "trap").exists()


def test_a_checkpoint_needs_the_users_word_and_a_safe_torch(tmp_path: Path, monkeypatch):
    path = write_file(tmp_path, "run.pt")
    refused(path, "pass `allow_checkpoint`")
    monkeypatch.setattr(torch, "__version__", "2.9.1")
    refused(path, r"needs torch 2\.10", allow_checkpoint=True)


def test_time_and_memory_for_gltf_grow_with_the_file_alone(tmp_path: Path, monkeypatch):
    calls = Counter[str]()

    def counting(home, name):
        function = getattr(home, name)
        monkeypatch.setattr(home, name, lambda *args, **kw: calls.update([name]) or function(*args, **kw))

    counting(base64, "b64decode")
    counting(scene_gltf, "local")
    counting(scene_gltf.spz, "parsed")
    write_scene(tmp_path / "a.gltf", make_scene(30))
    document = json.loads((tmp_path / "a.gltf").read_text())
    data = base64.b64encode((tmp_path / document["buffers"][0]["uri"]).read_bytes()).decode()
    document["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
    document["nodes"] = [{"mesh": 0, "children": [i + 1]} for i in range(20)] + [{"mesh": 0}]
    assert read_scene(write_json(tmp_path / "a.gltf", document)).count == 21 * 30
    assert calls == {"b64decode": 1, "local": 21}
    write_scene(tmp_path / "a.spz.glb", make_scene(30))
    whole = Gltf(tmp_path / "a.spz.glb")
    nodes = {**whole.root.fields, "nodes": [{"mesh": 0}] * 20}
    blob = whole.binary.read(0, whole.binary.size)
    (tmp_path / "a.spz.glb").write_bytes(glb_start(nodes, len(blob)) + blob)
    monkeypatch.setenv("AAPLUG_GAUSSIANS", "100")
    with pytest.raises(FormatError, match="holds 120 Gaussians and the limit is 100"):
        read_scene(tmp_path / "a.spz.glb")
    assert calls["parsed"] == 4


def test_bytes_of_an_opaque_gaussian_stay_finite(tmp_path: Path):
    data = bytearray(splat())
    data[24:28] = b"\xff" * 4
    data[32 + 24 : 32 + 28] = b"\0" * 4
    (tmp_path / "a.splat").write_bytes(data)
    scene = read_scene(tmp_path / "a.splat").gaussians()
    assert scene.logit_opacities.isfinite().all()
    assert scene.opacities[0] > 0.999999 > 1e-6 > scene.opacities[1]


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "n", "degree"),
    [
        ("splats/guitar.compressed.ply", 90_854, 0),
        ("splats/flowers_lod3_sog/meta.json", 26_895, 2),
        ("small_splats/splat-transform_fixtures/minimal-v4.spz", 4, 0),
        ("small_splats/splat-transform_fixtures/minimal.splat", 4, 0),
        ("small_splats/splat-transform_fixtures/minimal.ksplat", 4, 0),
    ],
)
def test_real_compressed_scenes_are_read(shared_data, name: str, n: int, degree: int):
    scene = read_scene(shared_data / "formats" / name).gaussians()
    assert (len(scene), scene.sh_degree) == (n, degree)
    assert scene.means.isfinite().all()


@pytest.mark.parametrize("suffix", ["compressed.ply", "sog"])
def test_the_size_of_blocks_changes_nothing_that_is_written(tmp_path: Path, monkeypatch, suffix: str):
    scene = make_scene(300, degree=2)
    write_scene(tmp_path / f"whole.{suffix}", scene)
    rows = torch.randn(1000, 24, generator=torch.Generator().manual_seed(0)) * torch.linspace(1, 5, 24)
    along = codebooks._along(rows)
    monkeypatch.setattr("aaplug.io.scenes.codebooks.BLOCK_ROWS", 7)
    monkeypatch.setattr("aaplug.io.scenes.compressed_ply.PART", 7)
    assert torch.equal(codebooks._along(rows), along)
    write_scene(tmp_path / f"blocks.{suffix}", scene)
    assert_equal(*(read_scene(tmp_path / f"{name}.{suffix}").gaussians() for name in ("whole", "blocks")))


COUNT = 80_000  # Gaussians of degree 3: 19 MB
LARGE = """
from aaplug.evaluation.laws.base import make_scene
from aaplug.io.scenes import compressed_ply, write_scene
path = {path!r}
write_scene(path, make_scene(2000, degree=3))
compressed_ply.PART = 4096
large = make_scene({count}, degree=3)
"""


@needs_peak_memory
def test_memory_holds_harmonics_few_times_while_a_compressed_ply_is_written(tmp_path: Path):
    prepare = LARGE.format(path=str(tmp_path / "a.compressed.ply"), count=COUNT)
    [taken] = memory_taken(prepare, "write_scene(path, large, overwrite=True)")
    assert taken < 5.5 * 4 * 59 * COUNT


@pytest.mark.parametrize("name", ["a.glb", "a.spz"])
def test_sizes_do_not_depend_on_how_long_numpys_integers_are(tmp_path, name, monkeypatch):
    """Those of numpy 1 on Windows have 32 bits, which files of some gigabytes exceed; here 16 stand for them."""
    monkeypatch.setattr(np, "cumsum", partial(np.cumsum, dtype=np.int16))
    scene = make_scene(2000)
    write_scene(tmp_path / name, scene, spz_version=3)
    again = read_scene(tmp_path / name, spz_axes="opengl").gaussians()
    assert again.sh.clamp(-1, 1).allclose(scene.sh.clamp(-1, 1), atol=0.1)  # what a .spz holds
