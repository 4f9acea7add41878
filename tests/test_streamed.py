"""Streamed levels: the files of `aaplug lod --to`, what interrupts them, and what is refused."""

import json
import math
import re
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import aaplug
from aaplug import SH_C0, VIEWERS
from aaplug.core.camera_paths import up_of
from aaplug.core.conventions import ANTIALIASED
from aaplug.core.orbits import frame_of
from aaplug.core.sampling import median_rates
from aaplug.io import rad, streamed
from aaplug.io.scenes import pyramid_folder, read_scene
from aaplug.io.streamed import MAX_SCREEN_ERROR, TILE_SWITCH
from aaplug.system.errors import FormatError, OutputError, UsageError
from tests.conftest import make_camera, make_scene, moved

LEVELS = 2
HOW = {"levels": LEVELS, "refine": False, "min_seen": 0.0}
SCENE = make_scene(200)
CAMERAS = aaplug.CameraSet(tuple(make_camera(eye, (64, 48)) for eye in ((0.0, -4.0, 0.0), (3.0, -2.0, 1.0))), ())
UTM = torch.tensor([5e5, 4.2e6, 100.0], dtype=torch.float64)
FAR_SCENE = replace(SCENE.to(torch.float64), means=SCENE.means + UTM)


@pytest.fixture
def small_leaves(monkeypatch):
    monkeypatch.setattr(streamed, "LEAF_GAUSSIANS", 50)
    monkeypatch.setattr("aaplug.verbs.lod.MAX_CHUNK_GAUSSIANS", 25)


def made(folder, to, scene=SCENE, cameras=CAMERAS, **how):
    return aaplug.lod(scene, cameras, folder, to=to, **HOW | how)


def all_moved(cameras, by):
    """The cameras in the place of a scene that was moved."""
    return replace(cameras, train=tuple(moved(camera, by) for camera in cameras.train))


def test_streamed_sog_lists_every_part(tmp_path, small_leaves):
    levels = made(tmp_path / "out", "sog")
    index = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert (index["version"], index["lodLevels"]) == (1, LEVELS + 1)
    assert index["counts"] == [len(level.scene) for level in levels]
    assert read_scene(tmp_path / "out").count == index["counts"][0]
    leaves = index["tree"]["children"]
    assert len(leaves) > 1
    for number in range(LEVELS + 1):
        parts = [leaf["lods"][str(number)] for leaf in leaves if str(number) in leaf["lods"]]
        assert sum(part["count"] for part in parts) == index["counts"][number]
        for part in parts:
            assert part["offset"] == 0
            assert read_scene(tmp_path / "out" / index["filenames"][part["file"]]).count == part["count"]
    assert all(level.scene.sh.shape == (len(level.scene), *SCENE.sh.shape[1:]) for level in levels)
    assert all(level.scene.sh.untyped_storage().nbytes() == 4 for level in levels), "harmonics stay in the files"
    means = torch.cat([level.scene.means for level in levels])
    low, high = (torch.tensor(index["tree"]["bound"][end]) for end in ("min", "max"))
    torch.testing.assert_close(torch.stack([low, high]), torch.stack([means.amin(dim=0), means.amax(dim=0)]))


@pytest.mark.parametrize("to", streamed.STREAMS)
def test_a_complete_stream_is_refused_and_complete_only_for_as_many_levels(tmp_path, to):
    made(tmp_path / "out", to)
    for how, said in (
        ({}, "already holds"),
        ({"resume": True}, "out: is of a run that is complete"),
        ({"resume": True, "levels": LEVELS + 1}, "already holds"),
    ):
        with pytest.raises(OutputError, match=said):
            made(tmp_path / "out", to, **how)


@pytest.mark.parametrize("far", [False, True])
def test_3d_tiles_refine_where_a_level_is_no_longer_right(tmp_path, small_leaves, far):
    """By the specification: an error over distance in px, and a child's box and error within its parent's."""
    whole = FAR_SCENE if far else SCENE
    levels = made(tmp_path / "out", "3dtiles", whole, all_moved(CAMERAS, UTM * far))
    index = json.loads((tmp_path / "out" / "tileset.json").read_text())
    required = index["extensions"]["3DTILES_content_gltf"]["extensionsRequired"]
    assert (index["asset"]["version"], required) == ("1.1", streamed.SPLATS)
    transform = torch.tensor(index["root"]["transform"], dtype=torch.float64).view(4, 4).T
    assert torch.equal(transform[:3, :3], torch.eye(3, dtype=torch.float64))
    assert far or index["root"]["transform"] == torch.eye(4).flatten().tolist()
    rates = median_rates(SCENE.means, CAMERAS.train)
    rate, counts = float(rates[rates > 0].median()), [0] * (LEVELS + 1)
    for tile in index["root"]["children"]:
        level = LEVELS
        while tile:
            scene = read_scene(tmp_path / "out" / tile["content"]["uri"]).gaussians()
            counts[level] += len(scene)
            middle, half = torch.tensor(tile["boundingVolume"]["box"]).split([3, 9])
            local = -scene.means[:, [0, 2, 1]]
            inside = local - middle
            placed = -(local + transform[:3, 3])[:, [0, 2, 1]]
            errors = (placed[:, None] - levels[level].scene.means).abs().amax(dim=2)
            assert errors.amin(dim=1).max() < 1e-5
            assert (inside.abs() <= half.reshape(3, 3).diagonal() + 1e-3).all()
            assert (tile["refine"], "transform" in tile) == ("REPLACE", False)
            expected = MAX_SCREEN_ERROR / (TILE_SWITCH * rate * 0.5**level) if level else 0.0
            assert math.isclose(tile["geometricError"], expected, rel_tol=1e-5)
            [tile] = tile.get("children", [None])
            level -= 1
        assert level == -1
    assert counts == index["asset"]["extras"]["counts"]


@pytest.mark.parametrize(("to", "viewer"), [("sog", "playcanvas"), ("rad", "spark")])
def test_a_viewer_without_transforms_is_told_to_move_far_gaussians(tmp_path, caplog, to, viewer):
    streamed.check_positions(tmp_path, to, replace(SCENE, log_scales=SCENE.log_scales - 20))
    made(tmp_path / "near", to)
    assert not caplog.messages, "moving would not help"
    made(tmp_path / "far", to, FAR_SCENE, all_moved(CAMERAS, UTM))
    said = "of 200 Gaussians by more than their size, so far from the origin; move the scene by aaplug merge, or write "
    assert re.fullmatch(rf"{tmp_path / 'far'}: {viewer} moves \d+ {said}3dtiles", caplog.messages[0])


def test_3d_tiles_refuse_what_lies_too_far_apart_before_anything_is_written(tmp_path):
    apart = replace(SCENE, means=SCENE.means.index_fill(0, torch.tensor(7), 5e6))
    with pytest.raises(OutputError, match=r"out: 3D Tiles cannot hold a position 5e\+06 units from the scene's middle"):
        made(tmp_path / "out", "3dtiles", apart)
    assert not list(tmp_path.iterdir())


def read_rad(path):
    """Properties by name, one row a Gaussian, read chunk by chunk as Spark does."""

    def headed(at):
        (length,) = struct.unpack_from("<I", data, at + 4)
        header = json.loads(data[at + 8 : at + 8 + length], parse_constant=pytest.fail)
        return data[at : at + 4], header, at + 8 + -(-length // 8) * 8

    def values(about, packed, count):
        raw = np.frombuffer(zlib.decompress(packed, -15), np.uint8)
        if about["encoding"] == "f32_lebytes":
            return raw.reshape(4, 3, count).transpose(2, 1, 0).copy().view("<f4")[..., 0]
        kind = {"f16": "<f2", "f32": "<f4", "ln_f16": "<f2", "s8": "i1", "u16": "<u2", "u32": "<u4"}[about["encoding"]]
        return raw.view(kind).reshape(-1, count).T * (about.get("max", 127) / 127)

    data = path.read_bytes()
    magic, facts, start = headed(0)
    assert (magic, facts["version"], facts["type"], facts["lodTree"]) == (b"RAD0", 1, "gsplat", True)
    properties = {}
    for place, chunk in enumerate(facts["chunks"]):
        magic, about, at = headed(start + chunk["offset"])
        assert (magic, about["base"], about["maxSh"]) == (b"RADC", place * facts["chunkSize"], facts["maxSh"])
        at += 8
        assert at + about["payloadBytes"] == start + chunk["offset"] + chunk["bytes"]
        for entry in about["properties"]:
            packed = data[at + entry["offset"] : at + entry["offset"] + entry["bytes"]]
            properties.setdefault(entry["property"], []).append(values(entry, packed, about["count"]))
    whole = {name: np.concatenate(parts) for name, parts in properties.items()}
    assert len(whole["center"]) == facts["count"]
    return whole


def test_a_rad_is_a_tree_of_the_levels(tmp_path, monkeypatch):
    """Spark draws the leaves nearby, and the coarsest level at its rate: it exchanges what is larger than a pixel."""
    monkeypatch.setattr(rad, "CHUNK_GAUSSIANS", 100)
    monkeypatch.setattr(rad, "MAX_CHILDREN", 99)
    scene = make_scene(400)
    seen = scene[median_rates(scene.means, CAMERAS.train) > 0]
    small = replace(seen, log_scales=seen.log_scales - 2)
    made(tmp_path, "rad", small)
    levels, found = made(None, "rad", small), read_rad(tmp_path / "scene.rad")
    assert len(levels[0].scene) > len(levels[1].scene) > len(levels[2].scene)
    counts, starts = (found[name][:, 0].astype(int) for name in ("child_count", "child_start"))
    children = [np.arange(start, start + count) for start, count in zip(starts, counts, strict=True)]
    assert sorted([0, *np.concatenate(children)]) == [*range(len(counts))]
    assert 1 < max(counts) <= 99
    sizes = 2 * np.exp(found["scales"].astype(float)).mean(axis=1)
    rates = median_rates(torch.from_numpy(found["center"].astype(np.float32)), CAMERAS.train).numpy()
    span = float(np.abs(found["sh1"]).max())
    for number, level in (0, levels[0]), (LEVELS, levels[-1]):
        replaced = (counts > 0) & (sizes * rates * 0.5**number > (1.1 if number else 0))  # conversion widens
        front, drawn = [0], []
        while front:
            place = front.pop()
            if replaced[place] or found["alpha"][place] == 0:
                front.extend(children[place])
            else:
                drawn.append(place)
        assert len(drawn) == len(level.scene)
        order, expected = (np.lexsort(means.T) for means in (found["center"][drawn], level.scene.means.numpy()))
        rows, scene = np.array(drawn)[order], level.scene[torch.from_numpy(expected)]
        for name, values, error in (
            ("center", scene.means, 0.0),
            ("alpha", scene.opacities[:, None], 1e-3),
            ("rgb", 0.5 + SH_C0 * scene.sh[:, 0], 2e-3),
            ("scales", scene.log_scales, 5e-3),
            ("orientation", scene.unit_quats[:, 1:] * scene.quats[:, :1].sign(), 1e-6),
            ("sh1", scene.sh[:, 1:4].flatten(1).clamp(-span, span), span / 253),
        ):
            torch.testing.assert_close(torch.from_numpy(found[name][rows]).float(), values, atol=error, rtol=0.0)


@pytest.mark.parametrize("to", streamed.STREAMS)
def test_a_run_that_was_cut_short_is_resumed(tmp_path, small_leaves, monkeypatch, to):
    def contents(folder):
        return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    tuned = {} if to == "3dtiles" else {"refine": True, "steps": 1}
    made(tmp_path / "whole", to, **tuned)
    writer, number_at = ("write_front", 1) if to == "rad" else ("write_level", 2)
    written, resumed, read, opened = getattr(streamed, writer), [], pyramid_folder.ply.open_scene, set()

    def cut(*args):
        last = args[number_at] == LEVELS
        written(*args[:3], list(args[3])[:1]) if last and to != "rad" else written(*args)
        if last:
            raise KeyboardInterrupt

    def recorded(*args):
        resumed.append(args[number_at])
        written(*args)

    monkeypatch.setattr(f"aaplug.io.streamed.{writer}", cut)
    with pytest.raises(KeyboardInterrupt):
        made(tmp_path / "out", to, **tuned)
    assert not (tmp_path / "out" / streamed.STREAMS[to].index).exists()
    monkeypatch.setattr(f"aaplug.io.streamed.{writer}", recorded)
    monkeypatch.setattr(pyramid_folder.ply, "open_scene", lambda path, how: opened.add(path.name) or read(path, how))
    made(tmp_path / "out", to, resume=True, **tuned)
    assert resumed == [LEVELS]
    assert {f"scene_lod{level}.ply" for level in range(LEVELS)} - opened == {"scene_lod0.ply"}  # the scene itself
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


@pytest.mark.parametrize("to", streamed.STREAMS)
def test_nothing_is_left_of_a_longer_run_that_was_cut_short_and_parts_are_for_their_viewer(tmp_path, monkeypatch, to):
    """Also without tuning.  Files whose names are like a front's stay."""
    out, stream, written = tmp_path / "out", streamed.STREAMS[to], streamed.write_index
    mine = [out / name / streamed.TREE for name in ("mine_0", "2_0/deeper") if to == "rad"]
    for path in mine:
        path.parent.mkdir(parents=True)
        path.write_text("keep")
    monkeypatch.setattr("aaplug.io.streamed.write_index", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        made(out, to)
    assert (out / "lod.json").exists()
    monkeypatch.setattr("aaplug.io.streamed.write_index", written)
    made(out, to, levels=LEVELS - 1, overwrite=True)
    found = {path for path in out.rglob("*") if path.is_file() and (to == "rad" or path.parent == out)}
    assert found == {*mine, out / streamed.SETTINGS, out / stream.index}
    assert {"sog": "sog", "3dtiles": "spz.glb", "rad": "ply"}[to] in VIEWERS[stream.viewer].formats
    for folder in streamed.part_folders(out, to):
        assert read_scene(folder / stream.content).convention == VIEWERS[stream.viewer].convention
    if to != "sog":
        for path in (out, out / stream.index):
            with pytest.raises(FormatError, match=f"{stream.index}: holds levels for a web viewer"):
                read_scene(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[]", ": is damaged"),
        ("[[1, 2], []]", "parts_1.json: is damaged"),
        ("", "parts_1.json: should be JSON"),
        ("[[]]", ": is damaged"),
        ("[[], [1, 0, 0, 0, 1, 1, 1]]", "1_1/meta.json: is missing: parts_1.json lists it; .*--overwrite"),
    ],
)
def test_damaged_facts_of_parts_are_refused(tmp_path, text, said):
    streamed.write_level(tmp_path, "sog", 0, [SCENE, SCENE])
    streamed.write_level(tmp_path, "sog", 1, [SCENE[:1], SCENE[:0]])
    streamed.facts_file(tmp_path, 1).write_text(text)
    with pytest.raises(FormatError, match=said):
        streamed.write_index(tmp_path, "sog", 2, 1.0, frame_of(SCENE))


def test_every_gaussian_of_a_tree_has_its_parent_however_many_siblings(monkeypatch):
    monkeypatch.setattr(rad, "MAX_CHILDREN", 5)
    generator = torch.Generator().manual_seed(0)
    parents = torch.cat([torch.randint(180, 200, (180,), generator=generator), torch.full((20,), -1)])
    tree = rad.tree_of(SCENE, parents)
    assert tree.counts.max() <= 5
    above = torch.full((len(tree.scene),), -1)
    for place, (count, start) in enumerate(zip(tree.counts.tolist(), tree.starts.tolist(), strict=True)):
        assert (above[start : start + count] == -1).all()
        above[start : start + count] = place
    assert (above[1:] >= 0).all()
    written = {tuple(mean): place for place, mean in enumerate(tree.scene.means.tolist())}
    for mean, parent in zip(SCENE.means.tolist(), parents.tolist(), strict=True):
        place = above[written[tuple(mean)]]
        while tree.scene.opacities[place] == 0 and place > 0:
            place = above[place]
        assert place == (written[tuple(SCENE.means[parent].tolist())] if parent >= 0 else 0)


def test_spark_draws_a_small_gaussian_below_large_ones():
    def descend(place: int) -> set[int]:
        children = [child for child, parent in enumerate(parents) if parent == place]
        if sizes[place] <= rad.MAX_NODE_SIZE or not children:
            return {place}
        return set().union(*map(descend, children))

    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        parents = [int(torch.randint(i + 1, 60, (), generator=generator)) for i in range(59)] + [-1]
        sizes = (2 * torch.rand(60, generator=generator) + torch.arange(60) / 60).tolist()
        found = rad.shown_of(torch.tensor(sizes), torch.tensor(parents))
        assert set(found.tolist()) == descend(59)
    assert rad.shown_of(torch.tensor([9.0, 1.0]), torch.tensor([-1, -1])).tolist() == [0, 1]


FAINT = replace(SCENE, log_scales=SCENE.log_scales - 8, logit_opacities=SCENE.logit_opacities - 20)
LARGE = replace(make_scene(200, degree=4), log_scales=SCENE.log_scales + 3)
FLAT = replace(LARGE, log_scales=LARGE.log_scales + torch.tensor([0.0, 0.0, -math.inf]), convention=ANTIALIASED)
THIN = replace(FLAT[:1], log_scales=torch.full((1, 3), -math.inf))


@pytest.mark.parametrize("scene", [FAINT, LARGE, SCENE.to(torch.float64), LARGE[:1], FLAT, THIN], ids=range(6))
def test_levels_that_add_nothing_to_a_tree(tmp_path, scene):
    for tuning in {}, {"refine": True, "steps": 1, "overwrite": True}:
        levels = made(tmp_path, "rad", scene, **tuning)
        assert len(levels[0].scene) == len(scene)
    assert bool(read_rad(tmp_path / "scene.rad")["child_count"].max() > 0) is (len(scene) > 1)
    assert {path.name for path in tmp_path.iterdir()} == {"scene.rad", streamed.SETTINGS}


def test_settings_are_of_the_rule_that_levels_are_for(tmp_path):
    for viewer, blur in ("spark-mip", (0.0, 0.1)), ("spark-classic", (0.3, 0.0)):
        options = {"viewer": viewer, "refine": True, "steps": 1, "overwrite": True}
        made(tmp_path, "rad", levels=1, **options)
        found = json.loads((tmp_path / streamed.SETTINGS).read_text())["SparkRenderer"]
        assert (found["preBlurAmount"], found["blurAmount"]) == blur


def test_a_damaged_tree_is_refused(tmp_path):
    front = streamed.Front.of(SCENE)
    streamed.write_front(tmp_path, 0, front, 0)
    assert torch.equal(streamed.read_front(tmp_path, 0).parents, front.parents)
    streamed.write_front(tmp_path, 0, front, len(SCENE))  # nothing new: the file of before is gone
    with pytest.raises(FormatError, match="to the 0 Gaussians"):
        streamed.read_front(tmp_path, 0)
    streamed.write_front(tmp_path, 0, front._replace(parents=torch.arange(len(SCENE)) - 1), 0)
    with pytest.raises(FormatError, match=r"tree\.npz.*does not belong to the 200 Gaussians"):
        streamed.read_front(tmp_path, 0)
    (tmp_path / "0_0" / streamed.TREE).write_bytes(b"PK")
    with pytest.raises(FormatError, match=r"tree\.npz.*is damaged"):
        streamed.read_front(tmp_path, 0)


@pytest.mark.parametrize("to", ["sog", "3dtiles"])
def test_parts_of_an_earlier_run_are_removed_and_nothing_else(tmp_path, small_leaves, monkeypatch, to):
    made(tmp_path / "out", to)
    many = streamed.part_folders(tmp_path / "out", to)
    mine = sorted(many)[-1] / "notes.txt"
    mine.write_text("keep")
    monkeypatch.setattr(streamed, "LEAF_GAUSSIANS", 1000)
    made(tmp_path / "out", to, overwrite=True)
    few = streamed.part_folders(tmp_path / "out", to)
    assert len(few) == LEVELS + 1 < len(many)
    assert set((tmp_path / "out").glob("*_*")) == few | {mine.parent}
    assert list(mine.parent.iterdir()) == [mine]


def test_a_page_has_the_viewer_beside_it(tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="does not hold playcanvas/build"):
        made(tmp_path / "out", "sog", page=tmp_path)
    assert not (tmp_path / "out").exists()
    program = tmp_path / "modules" / "playcanvas" / "build" / "playcanvas.min.mjs"
    program.parent.mkdir(parents=True)
    program.write_text("export {};")
    with monkeypatch.context() as patch:
        patch.setattr("aaplug.io.streamed.write_page", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            made(tmp_path / "out", "sog", page=tmp_path / "modules")
    made(tmp_path / "out", "sog", page=tmp_path / "modules", resume=True)  # it is not complete without its page
    page = (tmp_path / "out" / "index.html").read_text()
    assert (tmp_path / "out" / "viewer" / program.name).read_text() == program.read_text()
    assert f"./viewer/{program.name}" in page
    assert "http" not in page
    assert "width=device-width" in page  # else a phone lays it out for 980 px
    assert all((tmp_path / "out" / script).is_file() for script in ("orbit.js", "problems.js"))
    view = json.loads((tmp_path / "out" / "settings.json").read_text())["view"]
    assert view["up"] == pytest.approx(up_of(CAMERAS).tolist())
    assert math.dist(view["centre"], SCENE.means.median(dim=0).values.tolist()) < view["radius"]
    assert not list((tmp_path / "out").glob("*.ply"))


def test_beside_a_page_is_no_more_than_it_needs(tmp_path):
    cesium = tmp_path / "modules" / "cesium" / "Build" / "Cesium"
    needed = {"Cesium.js", "Assets/a.json", "ThirdParty/a.wasm", "Workers/a.js"}
    for name in {*needed, "index.js", "index.cjs", "Widgets/widgets.css"}:
        (cesium / name).parent.mkdir(parents=True, exist_ok=True)
        (cesium / name).touch()
    made(tmp_path / "out", "3dtiles", page=tmp_path / "modules")
    viewer = tmp_path / "out" / "viewer"
    assert {path.relative_to(viewer).as_posix() for path in viewer.rglob("*") if path.is_file()} == needed
    assert [path.name for path in (tmp_path / "out").glob("*.js")] == ["problems.js"]


def test_what_does_not_belong_together_is_refused(tmp_path):
    (tmp_path / "tileset.json").touch()
    for overwrite in (False, True):
        with pytest.raises(OutputError, match=r"holds levels for another viewer \(tileset.json\); name another folder"):
            aaplug.lod(make_scene(9), CAMERAS, tmp_path, to="sog", overwrite=overwrite)
    with pytest.raises(UsageError, match="belongs to `to`"):
        aaplug.lod(make_scene(9), CAMERAS, tmp_path, page=Path())
    with pytest.raises(UsageError, match="belongs to levels"):
        aaplug.lod(make_scene(9), CAMERAS, tmp_path / "a.ply", to="sog", simplify=0.5)
