"""Scene files are read and written without loss, and damaged ones end in one line of error."""

import gzip
import logging
import random
import re
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from aaplug import Monitor, merge
from aaplug.core.conventions import ANTIALIASED, CLASSIC, CONVENTIONS, MIP, Convention
from aaplug.core.gaussians import MAX_LOG_SCALE, Fusion, Gaussians
from aaplug.io.scenes import find_scene, read_scene, write_parts, write_scene, written_format
from aaplug.io.scenes.ply import EXTRAS
from aaplug.io.values import HEAD_LIMIT
from aaplug.system.errors import FormatError, OutputError, UsageError
from tests.conftest import assert_equal, make_scene

QUICK = 0.5  # s of processor time, for a refusal: others may make the clock run longer
NUMPY = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "short": "<i2", "int32": "<i4"}


def parameters(degree: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    dc = [f"f_dc_{i}" for i in range(3)]
    scales = [f"scale_{i}" for i in range(3)]
    return ["x", "y", "z", *dc, *rest, "opacity", *scales, *(f"rot_{i}" for i in range(4))]


@dataclass(frozen=True)
class File:
    """A .ply file to be made, whole or damaged."""

    columns: Sequence[tuple[str, str]] = tuple(("float", name) for name in parameters(1))
    n: int = 5
    count: str = "5"
    element: str = "vertex"
    top: Sequence[str] = ("format binary_little_endian 1.0",)
    before: tuple[Sequence[str], bytes] = ((), b"")
    after: tuple[Sequence[str], bytes] = ((), b"")
    newline: bytes = b"\n"

    @property
    def rows(self) -> np.ndarray:
        rng = np.random.default_rng(0)
        dtype = [(f"{i}", NUMPY.get(kind, "u1")) for i, (kind, _) in enumerate(self.columns)]
        rows = np.zeros(self.n, dtype)
        for column in rows.dtype.names or ():
            rows[column] = rng.uniform(1, 99, self.n)
        return rows

    @property
    def header(self) -> bytes:
        vertex = [f"element {self.element} {self.count}", *(f"property {t} {n}" for t, n in self.columns)]
        lines = ["ply", *self.top, *self.before[0], *vertex, *self.after[0], "end_header"]
        return b"".join(line.encode() + self.newline for line in lines)

    @property
    def content(self) -> bytes:
        return self.header + self.before[1] + self.rows.tobytes() + self.after[1]

    def save(self, folder: Path) -> Path:
        path = folder / "in.ply"
        path.write_bytes(self.content)
        return path


def plain(*extra: str, degree: int = 1, **changes) -> File:
    """A file with these comments."""
    columns = [("float", name) for name in parameters(degree)]
    top = ["format binary_little_endian 1.0", *(f"comment {text}" for text in extra)]
    return replace(File(), **{"columns": columns, "top": top, **changes})


def filtered(*comments: str) -> File:
    return plain(*comments, columns=[("float", name) for name in [*parameters(1), "filter_3D", "nx"]])


def without(*missing: str) -> File:
    return plain(columns=[(t, n) for t, n in File().columns if n not in missing])


def with_type(kind: str, column: str) -> File:
    return plain(columns=[(kind if n == column else t, n) for t, n in File().columns])


def with_rest(names: Sequence[str]) -> File:
    return plain(columns=[("float", n) for n in [*parameters(0), *names]])


def coloured() -> File:
    floats = [("float", n) for n in parameters(0) if not n.startswith("f_dc")]
    return plain(columns=[*floats[:3], *(("uchar", c) for c in ("red", "green", "blue")), *floats[3:]])


def extended(*names: str) -> File:
    return plain(columns=[*File().columns, *(("float", name) for name in names)])


shuffled = random.Random(0).sample(
    [*File().columns, ("uchar", "red"), ("double", "weight"), ("short", "id"), ("int32", "class")],
    len(File().columns) + 4,
)
byte_last = File(columns=[*File().columns, ("uchar", "red")])  # its rows have an odd number of bytes
box = ["element chunk 2", "comment of a chunk", "property float lo", "property uchar hi"]
faces = ["element face 2", "property list uchar int vertex_indices", "property int flags"]
face_rows = b"\x03" + bytes(range(12)) + bytes(4) + b"\x00" + bytes(4)
tagged = ["comment made  by hand ", "format binary_little_endian 1.0", "obj_info  a b", "comment c"]
ROUND_TRIPS = {
    "plain": File(),
    "no rows": File(n=0, count="0"),
    "odd order and types": File(columns=shuffled),
    "one row, a byte last": replace(byte_last, n=1, count="1"),
    "comments": File(top=[*tagged, " ", "comment last"]),
    "element before": File(before=(box, bytes(range(10)))),
    "element after": File(after=(box, bytes(range(10)))),
    "lists before": File(before=(faces, face_rows)),
    "lists after": File(after=(faces, face_rows)),
    "empty lists": File(after=(faces, bytes(10))),
    "any alphabet": plain("\x85 \xa0", "日本"),
    "CRLF": File(newline=b"\r\n", top=tagged),
    "long type names": plain(columns=[("float32", n) for _, n in File().columns]),
    "filter_3D": filtered("hello"),
    "record": plain("aaplug fused=mip convention=antialiased k=1", "aaplug was here"),
    **{f"degree {d}": plain(degree=d) for d in (0, 3, 4)},
}


def through(scene: Gaussians, folder: Path) -> bytes:
    write_scene(folder / "out.ply", scene, overwrite=True)
    return (folder / "out.ply").read_bytes()


def comments(content: bytes) -> list[str]:
    lines = content.split(b"end_header")[0].decode().split("\n")
    return [line.removeprefix("comment ") for line in lines if line.startswith("comment")]


def values(content: bytes, file: File) -> np.ndarray:
    dtype = [(name, NUMPY[kind]) for kind, name in file.columns]
    return np.frombuffer(content.split(b"end_header\n")[1], dtype)


def refused(path: Path, problem: str) -> str:
    with pytest.raises(FormatError, match=problem) as caught:
        read_scene(path).gaussians()
    return str(caught.value)


# Round trips


@pytest.mark.parametrize("file", ROUND_TRIPS.values(), ids=ROUND_TRIPS.keys())
def test_an_unchanged_scene_is_written_back_to_the_byte(tmp_path: Path, file: File):
    assert through(read_scene(file.save(tmp_path)).gaussians(), tmp_path) == file.content


@given(st.integers(0, 3), st.integers(0, 20), st.sampled_from([*CONVENTIONS.values()]), st.data())
@settings(max_examples=6, deadline=None)
def test_what_was_written_is_read(tmp_path_factory, degree, n, convention, data):
    folder = tmp_path_factory.getbasetemp()
    word = st.text("abcXYZ019._-+", min_size=1, max_size=8)
    pairs = st.dictionaries(word.map(lambda key: "k" + key), word, max_size=3)
    fusion = st.builds(Fusion, word, pairs)
    scene = make_scene(n, n, degree=degree)
    fused = tuple(data.draw(st.lists(fusion, max_size=2)))
    filter_3d = torch.rand(n) if data.draw(st.booleans()) else None
    scene = replace(scene, convention=convention, fused=fused, filter_3d=filter_3d)
    content = through(scene, folder)
    again = read_scene(folder / "out.ply").gaussians()
    assert_equal(again, scene)
    assert (again.convention, again.fused) == (convention, fused)
    assert (again.filter_3d is None) == (filter_3d is None)
    assert comments(content).count("SplatRenderMode: mip") == convention.compensated
    write_scene(folder / "again.ply", again, overwrite=True)
    assert (folder / "again.ply").read_bytes() == content


def test_a_scene_without_origin_has_inrias_columns(tmp_path: Path):
    header = through(make_scene(2, degree=1), tmp_path).split(b"end_header")[0].decode()
    names = re.findall(r"property float (\S+)\n", header)
    order = parameters(1)
    assert names == [*order[:3], "nx", "ny", "nz", *order[3:]]
    assert header.startswith("ply\nformat binary_little_endian 1.0\nelement vertex 2\n")


@pytest.mark.parametrize("index", [[], [4, 4, 0]])
def test_chosen_rows_keep_their_unknown_columns(tmp_path: Path, index: list[int]):
    file = File(columns=shuffled, after=(box, bytes(range(10))))
    scene = read_scene(file.save(tmp_path)).gaussians()[torch.tensor(index, dtype=torch.int64)]
    expected = replace(file, count=str(len(index))).header + file.rows[index].tobytes()
    assert through(scene, tmp_path) == expected + file.after[1]


def test_a_name_without_suffix_is_a_folders():
    formats = {"a.sog": "sog", "meta.json": "meta.json", "a.compressed.ply": "compressed.ply"}
    for name in ("sog", "ply", "a/glb", *formats):
        assert getattr(written_format(name), "name", None) == formats.get(name), name


def test_what_only_a_ply_keeps_is_named(tmp_path: Path, caplog, monkeypatch):
    """Columns and tables of the user's own are not lost without a word; normals and colours in bytes are no loss.

    Nor is the way up, which nerfstudio's comment tells some viewers.
    """
    own = replace(extended("label", "nx"), after=(box, bytes(range(10))))
    own = replace(own, top=[*own.top, *(f"comment {each}" for each in NERFSTUDIO)])
    usual = plain("hello", columns=[*extended("nx", "ny", "nz").columns, *coloured().columns[3:6]])
    said, lost = list[str](), "the columns label and the tables chunk and the comments Vertical Axis: z"
    monkeypatch.setattr(Monitor, "say", lambda self, text: said.append(text))
    for name, file in {"own": own, "usual": usual}.items():
        (tmp_path / f"{name}.ply").write_bytes(file.content)
        scene = read_scene(tmp_path / f"{name}.ply").gaussians()
        for suffix in ("glb", "copy.ply"):
            write_scene(tmp_path / f"{name}.{suffix}", scene)
        merge([scene], None, None)
    warned = [message for message in caplog.messages if "cannot hold" in message]
    assert warned == [f"{tmp_path / 'own.glb'}: a .glb cannot hold {lost}; a .ply can"]
    assert said == [f"own.ply: the merged scene does not have its {lost.removeprefix('the ')}"]


def test_large_scenes_are_copied_in_whole(tmp_path: Path):
    scene = make_scene(70_000, degree=0)
    write_scene(tmp_path / "large.ply", scene)
    assert_equal(read_scene(tmp_path / "large.ply").gaussians(), scene)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "n", "degree"),
    [
        ("chair/chair.ply", 49_295, 3),
        ("snowmiku/snowmiku.ply", 59_953, 3),
        ("splats/train-1000.ply", 1000, 3),
        ("splats/flowers_lod3_sh2.ply", 26_895, 2),
        ("small_splats/metalsplatter/SplatIO/TestData/test-splat.3-points-from-train.ply", 3, 3),
    ],
)
def test_real_scenes_are_written_back_to_the_byte(tmp_path: Path, shared_data: Path, name, n, degree):
    path = next(p for p in (shared_data / name, shared_data / "formats" / name) if p.exists())
    scene = read_scene(path).gaussians()
    assert (len(scene), scene.sh_degree, scene.convention) == (n, degree, CLASSIC)
    assert through(scene, tmp_path) == path.read_bytes()


# Conventions and records


@pytest.mark.parametrize(
    ("file", "convention", "evidence"),
    [
        (plain(), CLASSIC, "no tag in the file: assumed classic"),
        (plain("SplatRenderMode: mip"), MIP, "SplatRenderMode: mip"),
        (plain("SplatRenderMode: antialiased"), ANTIALIASED, "antialiased"),
        (plain("SplatRenderMode: mip", "SplatRenderMode: default"), CLASSIC, "default"),
        (plain("SplatRenderMode: fancy"), CLASSIC, "fancy, is unknown"),
        (plain("antialiased 1", "antialiased 0"), CLASSIC, "antialiased 0"),
        (plain("SplatRenderMode: mip", "antialiased 0"), MIP, "SplatRenderMode"),
        (filtered("SplatRenderMode: default"), MIP, "filter_3D"),
        (filtered("aaplug fused=x convention=antialiased"), ANTIALIASED, "aaplug's record"),
        (plain("aaplug fused=x a=b", "antialiased 1"), ANTIALIASED, "antialiased 1"),
        (plain("aaplug fused=x convention=mip", "aaplug convention=classic"), CLASSIC, "record"),
        (plain("Exported from Brush", "Vertical axis: y", "SH degree: 1", "SplatRenderMode: mip"), MIP, "tag in the"),
        (plain("Exported from Brush", "Vertical axis: y", "SplatRenderMode: default"), CLASSIC, "tag in the file"),
        (plain("Generated by Nerstudio 1.1.5", "Vertical Axis: z"), CLASSIC, "nerfstudio writes none"),
        (plain("antialiased 1"), ANTIALIASED, "antialiased 1"),
    ],
)
def test_the_strongest_evidence_decides_and_is_kept_and_the_user_knows_best(tmp_path, file, convention, evidence):
    scene = read_scene(file.save(tmp_path)).gaussians()
    assert scene.origin
    assert scene.convention == convention
    assert evidence in scene.origin.evidence
    assert through(scene, tmp_path) == file.content
    stated = read_scene(tmp_path / "in.ply", convention=ANTIALIASED).gaussians()
    assert stated.origin
    assert (stated.convention, stated.origin.evidence) == (ANTIALIASED, "stated by the user")


def test_pixel_sizes_are_read_and_kept(tmp_path: Path):
    sizes = [("float", "max_pixel_sizes"), ("float", "min_pixel_sizes"), ("uchar", "base_mask")]
    file = plain(columns=[*File().columns, *sizes])
    opened = read_scene(file.save(tmp_path))
    assert "pixel sizes of Multi-Scale 3DGS, for the recipe multi-scale" in opened.notes
    scene, stored = opened.gaussians(), values(file.content, file)
    assert {name: column.tolist() for name, column in scene.extras.items()} == {n: stored[n].tolist() for n in EXTRAS}
    assert through(scene, tmp_path) == file.content
    part = values(through(scene[torch.tensor([3, 1])], tmp_path), file)
    assert part["base_mask"].tolist() == stored["base_mask"][[3, 1]].tolist()
    lacking = replace(file, columns=file.columns[:-1])
    assert set(read_scene(lacking.save(tmp_path)).gaussians().extras) == {*EXTRAS} - {"base_mask"}


def test_the_filter_column_is_read_dropped_and_written(tmp_path: Path):
    file = filtered()
    scene = read_scene(file.save(tmp_path)).gaussians()
    assert scene.filter_3d is not None
    assert scene.filter_3d.tolist() == values(file.content, file)["filter_3D"].tolist()
    content = through(replace(scene, filter_3d=scene.filter_3d + 1), tmp_path)
    assert values(content, file)["filter_3D"].tolist() == (scene.filter_3d + 1).tolist()
    without_filter = plain("SplatRenderMode: mip", columns=[*File().columns, ("float", "nx")])
    header, fused = through(replace(scene, filter_3d=None), tmp_path).split(b"end_header\n")
    assert header + b"end_header\n" == without_filter.header
    assert len(fused) == len(without_filter.rows.tobytes())


@pytest.mark.parametrize(
    ("before", "convention", "after"),
    [
        (["\x85 日本", "SplatRenderMode: default"], MIP, ["\x85 日本", "SplatRenderMode: mip"]),
        (["antialiased 0", "splatrendermode: x"], MIP, ["SplatRenderMode: mip"]),
        (["antialiased 1", "hi"], CLASSIC, ["hi"]),
        (["SplatRenderMode: mip", "SplatRenderMode: mip"], MIP, None),
        (["SplatRenderMode: MIP"], ANTIALIASED, ["SplatRenderMode: mip", "aaplug convention=antialiased"]),
        (["aaplug convention=antialiased", "SplatRenderMode: mip"], CLASSIC, []),
    ],
)
def test_tags_follow_the_convention(tmp_path, before, convention: Convention, after):
    scene = read_scene(plain(*before).save(tmp_path)).gaussians()
    content = through(replace(scene, convention=convention), tmp_path)
    assert comments(content) == (before if after is None else after)
    assert read_scene(tmp_path / "out.ply").gaussians().convention == convention


def test_a_fusion_is_recorded_and_read_back(tmp_path: Path):
    scene = read_scene(plain("hello", "SplatRenderMode: default").save(tmp_path)).gaussians()
    fusion = Fusion("mip", {"kernel": "0.1", "compensated": "1"})
    content = through(replace(scene, fused=(fusion,)), tmp_path)
    record = "aaplug fused=mip kernel=0.1 compensated=1 convention=classic"
    assert comments(content) == ["hello", "SplatRenderMode: default", record]
    again = read_scene(tmp_path / "out.ply").gaussians()
    assert again.fused == (fusion,)
    (tmp_path / "twice").mkdir()
    twice = through(replace(again, fused=(fusion, Fusion("b")), convention=MIP), tmp_path / "twice")
    records = ["aaplug fused=mip kernel=0.1 compensated=1 convention=mip", "aaplug fused=b convention=mip"]
    assert comments(twice) == ["hello", "SplatRenderMode: mip", *records]


# Dialects of .ply


def coded(folder: Path, file: File, order: str) -> Path:
    """The file in another coding, written by plyfile."""
    whole = PlyData.read(str(file.save(folder)))
    path = folder / "coded.ply"
    text = order == "text"
    others = PlyData(list(whole.elements), text, "=" if text else order, comments=whole.comments)
    others.write(str(path))
    return path


TABLES = File(columns=shuffled, before=(box, bytes(range(10))), after=(faces, face_rows))


@pytest.mark.parametrize(
    ("file", "order"), [*product((filtered("hello"), byte_last, TABLES), (">", "text")), (TABLES, "<"), (File(), "<")]
)
def test_every_coding_gives_the_same_scene(tmp_path: Path, file: File, order: str):
    """Also with an empty line, which is left out, and a comment of any alphabet: plyfile, for lists, takes neither."""
    path = coded(tmp_path, file, order)
    path.write_bytes(path.read_bytes().replace(b"element", "\ncomment 日本\nelement".encode(), 1))
    scene, twin = read_scene(path).gaussians(), read_scene(tmp_path / "in.ply").gaussians()
    assert_equal(scene, twin)
    header, rows = through(scene, tmp_path).split(b"end_header\n", 1)
    assert "\ncomment 日本\n".encode() in header
    assert b"\n\n" not in header
    assert rows == through(twin, tmp_path).split(b"end_header\n", 1)[1]
    coding = {">": "binary_big_endian", "text": "ascii"}.get(order)
    assert coding is None or read_scene(path).notes[0] == f"coding: {coding}"


@pytest.mark.parametrize("column", ["f_rest_3", "scale_1"])
def test_double_columns_are_read_as_float_and_kept_where_unchanged(tmp_path: Path, column: str):
    file = with_type("double", column)
    scene = read_scene(file.save(tmp_path)).gaussians()
    assert through(scene, tmp_path) == file.content
    moved = through(replace(scene, means=scene.means + 1, sh=scene.sh + 1), tmp_path)
    old, new = values(file.content, file), values(moved, file)
    changed = column == "f_rest_3"
    assert (old[column] != new[column]).all() == changed
    assert (old[column] == new[column]).all() != changed


def test_colours_in_bytes_become_harmonics_of_degree_0(tmp_path: Path):
    file = coloured()
    scene = read_scene(file.save(tmp_path)).gaussians()
    rows = values(file.content, file)
    expected = np.stack([rows[c] for c in ("red", "green", "blue")], 1) / 255
    shown = 0.5 + 0.28209479177387814 * scene.sh[:, 0]  # 3DGS's colour of degree 0
    np.testing.assert_allclose(shown.numpy(), expected, atol=1e-6)
    content = through(scene, tmp_path)
    assert b"property uchar red" in content
    assert torch.equal(read_scene(tmp_path / "out.ply").gaussians().sh, scene.sh)


@pytest.mark.parametrize("file", [without("scale_2"), plain("SplatRenderMode: 2DGS")], ids=["two scales", "tag"])
def test_2d_gaussians_are_discs(tmp_path: Path, file: File):
    scene = read_scene(file.save(tmp_path)).gaussians()
    assert (scene.flat, scene.convention) == (True, CLASSIC)
    assert (scene.log_scales[:, 2] == -MAX_LOG_SCALE).all()
    assert "2D Gaussians" in read_scene(tmp_path / "in.ply").evidence
    assert through(scene, tmp_path) == file.content
    assert through(scene[torch.tensor([2])].to(torch.float64), tmp_path).count(b"scale_2") == (
        file.header.count(b"scale_2")
    )
    assert b"scale_2" not in through(replace(make_scene(3, degree=0), flat=True), tmp_path), "without an origin"
    assert read_scene(tmp_path / "out.ply").gaussians().flat


NERFSTUDIO = ("Generated by Nerstudio 1.1.5", "Vertical Axis: z")
CONFIG = "pipeline: !!python/object/apply:os.system [exit 1]\n    model:\n      rasterize_mode: {}\n"


@pytest.mark.parametrize(
    ("config", "convention", "evidence"),
    [
        (CONFIG.format("antialiased"), ANTIALIASED, "config.yml of its run says antialiased"),
        (CONFIG.format("classic"), CLASSIC, "config.yml of its run says classic"),
        (CONFIG.format("fancy"), CLASSIC, "it may be classic or antialiased"),
        (CONFIG.format("classic") + CONFIG.format("antialiased"), CLASSIC, "it may be classic or antialiased"),
        ("x" * HEAD_LIMIT + CONFIG.format("antialiased"), CLASSIC, "it may be classic or antialiased"),
        (None, CLASSIC, "it may be classic or antialiased"),
    ],
)
def test_a_nerfstudio_export_is_what_its_config_says_or_asks(tmp_path: Path, config, convention, evidence):
    """The exporter writes no tag; the configuration may hold Python objects and is never loaded."""
    path = plain(*NERFSTUDIO).save(tmp_path)
    if config is not None:
        (tmp_path / "config.yml").write_text(config)
    opened = read_scene(path)
    assert opened.convention == convention
    assert evidence in opened.evidence
    assert any("state `convention`" in note for note in opened.notes) == ("may be" in evidence)
    (tmp_path / "elsewhere").mkdir()
    write_scene(tmp_path / "elsewhere" / "out.ply", opened.gaussians())
    assert read_scene(tmp_path / "elsewhere" / "out.ply").convention == convention
    for tag in ("SplatRenderMode: default", "aaplug convention=classic"):  # is stronger
        assert read_scene(plain(*NERFSTUDIO, tag).save(tmp_path)).convention == CLASSIC


@pytest.mark.parametrize("folder", ["ply", "elsewhere"])
def test_a_gsplat_export_is_what_the_cfg_of_its_run_says(tmp_path: Path, folder: str):
    (tmp_path / "cfg.yml").write_text("antialiased: true\napp_opt: false\n")
    (tmp_path / folder).mkdir()
    opened = read_scene(plain().save(tmp_path / folder))
    assert opened.convention == (ANTIALIASED if folder == "ply" else CLASSIC)


@pytest.mark.parametrize("kind", ["binary", ">", "text", "double", "bytes", "filter", "disc"])
def test_every_kind_of_ply_keeps_the_convention(tmp_path: Path, kind: str):
    """Antialiased is the one that needs both a viewer's tag and aaplug's own comment."""
    files = {"double": with_type("double", "x"), "bytes": coloured(), "filter": filtered(), "disc": without("scale_2")}
    file = files.get(kind, plain("hello"))
    path = coded(tmp_path, file, kind) if kind in (">", "text") else file.save(tmp_path)
    through(replace(read_scene(path).gaussians(), convention=ANTIALIASED), tmp_path)
    again = read_scene(tmp_path / "out.ply").gaussians()
    assert again.convention == ANTIALIASED
    write_scene(tmp_path / "twice.ply", again)
    assert (tmp_path / "twice.ply").read_bytes() == (tmp_path / "out.ply").read_bytes()


# Parts


@pytest.mark.parametrize("file", [plain(), File(columns=shuffled, after=(box, bytes(range(10))))])
def test_parts_make_the_whole(tmp_path: Path, file: File):
    opened = read_scene(file.save(tmp_path))
    parts = list(opened.parts(size=2))
    assert [len(part) for part in parts] == [2, 2, 1]
    assert_equal(parts[1], opened.gaussians()[2:4])
    write_parts(tmp_path / "out.ply", iter(parts), 5)
    assert (tmp_path / "out.ply").read_bytes() == file.content


def test_rows_that_are_left_out_are_counted_aloud_and_stay_so_also_in_parts(tmp_path: Path, caplog):
    file = plain(n=12, count="12")
    path = damaged(tmp_path, file, x=([3, 9], np.nan), y=(9, np.inf))
    rows = values(path.read_bytes(), file)
    refused(path, r"row 3 \(and 1 more\) has NaN in x, row 9 has Inf in y")
    with caplog.at_level(logging.WARNING, logger="aaplug"):
        write_parts(tmp_path / "parts.ply", read_scene(path, drop_bad=True).parts(size=3), 12)
        content = through(read_scene(path, drop_bad=True).gaussians(), tmp_path)
    assert caplog.text.count("left out 2 of 12 Gaussians (NaN in x: 2, Inf in y: 1)") == 2
    assert (tmp_path / "parts.ply").read_bytes() == content
    assert b"element vertex 10\n" in content
    assert content.endswith(b"end_header\n" + np.delete(rows, [3, 9]).tobytes())
    path = damaged(tmp_path, file, **{c: (r, np.nan) for c, r in zip("xyz", range(3), strict=True)})
    write_parts(tmp_path / "fewer.ply", read_scene(path, drop_bad=True).parts(size=3), 12)
    assert len(read_scene(tmp_path / "fewer.ply").gaussians()) == 9
    assert len(PlyData.read(str(tmp_path / "fewer.ply"))["vertex"].data) == 9


def test_a_file_that_changes_while_it_is_read_is_noticed(tmp_path: Path):
    path = File().save(tmp_path)
    opened = read_scene(path)
    path.write_bytes(File().content[:-92] + bytes(91))
    with pytest.raises(FormatError, match="changed while"):
        opened.gaussians()


# Damaged files


BAD_HEADERS = {
    "count 10^12": (File(count=str(10**12)), "promises .* bytes and it has"),
    "count -5": (File(count="-5"), "impossible count '-5'"),
    "one row too many promised": (File(count="6"), "5 of 6 Gaussians are whole"),
    "one row too few promised": (File(count="4"), "92 bytes more"),
    "missing columns": (without("x", "rot_3", "opacity"), "lacks x, opacity, rot_3, which"),
    "int harmonics": (with_type("int32", "f_rest_3"), "f_rest_3 must be float"),
    "duplicate property": (extended("x"), "property of vertex 'x' is declared twice"),
    "8 f_rest": (with_rest([f"f_rest_{i}" for i in range(8)]), "8 f_rest"),
    "f_rest with a gap": (with_rest([f"f_rest_{i}" for i in range(1, 10)]), "not f_rest_0"),
    "ascii that is binary": (File(top=["format ascii 1.0"]), "is damaged and cannot be read"),
    "big endian": (File(top=["format binary_big_endian 1.0"]), "quaternion"),
    "version": (File(top=["format binary_little_endian 2.0"]), "2.0; known are"),
    "no format": (File(top=[]), "its format is none"),
    "unknown type": (File(after=(["element a 1", "property half b"], b"")), "not PLY"),
    "name not ASCII": (extended("é"), "line 27 of the header is not ASCII"),
    "1001 lines": (plain(*["c"] * 1000), "lines, more than the 1000"),
    "long header": (plain(*["c" * 1000] * 200), "no line 'end_header' in its first 131,072"),
    "old Mac line ends": (File(newline=b"\r"), "first line"),
    "trailing after lists": (File(after=(faces, face_rows + b"x")), "1 bytes after"),
    "short lists": (File(after=(faces, face_rows[:-1])), "is damaged and cannot be read"),
    "convention": (plain("aaplug fused=mip convention=fancy"), "convention=fancy; known are classic"),
    "record": (plain("aaplug fused=mip kernel"), "expected key=value"),
    "empty vertex": (File(columns=[]), "lacks x"),
    "a list": (File(columns=[("list uchar float", "x")], n=9), "vertex property x is a list"),
    "no vertex": (File(element="face"), "no element 'vertex'"),
}


@pytest.mark.parametrize(("file", "problem"), BAD_HEADERS.values(), ids=BAD_HEADERS.keys())
def test_bad_headers_are_one_quick_line(tmp_path: Path, file: File, problem: str):
    path = file.save(tmp_path)
    start = time.process_time()
    said = refused(path, problem)
    assert time.process_time() - start < QUICK
    assert "\n" not in said
    assert said.startswith(str(path))


@pytest.mark.parametrize(("kept", "whole"), [(0, 0), (91, 0), (459, 4)])
def test_a_cut_body_says_how_much_is_whole(tmp_path: Path, kept: int, whole: int):
    file, path = File(before=(box, bytes(10))), tmp_path / "in.ply"
    path.write_bytes(file.header + file.before[1] + file.rows.tobytes()[:kept])
    sizes = f"{len(file.content)} bytes and it has {len(file.header) + 10 + kept}"
    assert sizes in refused(path, f"{whole} of 5 Gaussians are whole").replace(",", "")


def test_more_gaussians_than_allowed_or_than_memory_holds_are_refused(tmp_path: Path, monkeypatch):
    path = File().save(tmp_path)
    monkeypatch.setenv("AAPLUG_GAUSSIANS", "5")
    assert len(read_scene(path).gaussians()) == 5
    monkeypatch.setenv("AAPLUG_GAUSSIANS", "4")
    refused(path, "holds 5 Gaussians and the limit is 4; AAPLUG_GAUSSIANS")
    monkeypatch.setenv("AAPLUG_GAUSSIANS", "many")
    with pytest.raises(UsageError, match="AAPLUG_GAUSSIANS: should be a number above 0"):
        read_scene(path).gaussians()
    monkeypatch.delenv("AAPLUG_GAUSSIANS")
    monkeypatch.setenv("AAPLUG_MEMORY_SHARE", "1e-9")
    refused(path, "info and convert read it in parts")
    assert [len(part) for part in read_scene(path).parts(size=2)] == [2, 2, 1]


# Unusable values


def damaged(folder: Path, file: File, **cells: tuple[int | list[int], float]) -> Path:
    path = folder / "in.ply"
    rows = values(file.content, file).copy()
    for column, (row, value) in cells.items():
        rows[column][row] = value
    path.write_bytes(file.header + rows.tobytes())
    return path


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", ["x", "f_dc_1", "f_rest_8", "opacity", "scale_2", "rot_0", "filter_3D"])
def test_a_bad_number_is_found_in_every_kind_of_column(tmp_path: Path, column: str, value: float):
    path = damaged(tmp_path, filtered(), **{column: (3, value)})
    if (column, value) in {("scale_2", -np.inf), ("opacity", -np.inf), ("opacity", np.inf)}:  # flat; invisible; opaque
        scene = read_scene(path).gaussians()
        assert scene.scales.isfinite().all()
        assert scene.opacities.max() <= 1
        assert through(scene, tmp_path) == path.read_bytes()
        return
    what = "NaN" if np.isnan(value) else "Inf"
    refused(path, f"in.ply: row 3 has {what} in {column}[;,].*pass `drop_bad`")
    origin = read_scene(path, drop_bad=True).gaussians().origin
    assert origin is not None
    assert origin.rows.tolist() == [0, 1, 2, 4]
    path = damaged(tmp_path, filtered(), nx=(3, value))
    assert through(read_scene(path).gaussians(), tmp_path) == path.read_bytes(), "a column that aaplug does not use"


@pytest.mark.parametrize(("length", "problem"), [(1e-20, "length zero"), (3e38, "too long")])
def test_a_quaternion_without_direction_is_refused(tmp_path: Path, length: float, problem: str):
    cells = {f"rot_{i}": (1, length) for i in range(4)}
    path = damaged(tmp_path, File(), **cells)
    refused(path, f"row 1 has a quaternion.*{problem}")
    assert len(read_scene(path, drop_bad=True).gaussians()) == 4


# Files and folders


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("missing.ply", "cannot be read: no such file"),
        (".", "holds no point_cloud/iteration_<N>"),
        ("empty.ply", "is empty"),
        ("junk.ply", r"no known scene format; aaplug reads \.compressed\.ply, \.ply, \.spz"),
        ("nul\0.ply", "cannot be read"),
        ("scene.zip", "is an archive without meta.json, which a .sog has; if a scene's file is in it, unpack it"),
        ("scene.ply.gz", "is an archive; unpack it, and name the scene's file"),
    ],
)
def test_what_is_no_scene_file_is_refused(tmp_path: Path, name: str, problem: str):
    (tmp_path / "empty.ply").touch()
    (tmp_path / "junk.ply").write_bytes(b"junk")
    (tmp_path / "scene.ply.gz").write_bytes(gzip.compress(File().content))
    with zipfile.ZipFile(tmp_path / "scene.zip", "w") as archive:
        archive.writestr("scene.ply", File().content)
    refused(tmp_path / name, problem)
    assert len(read_scene(File().save(tmp_path).rename(tmp_path / "scene.dat")).gaussians()) == 5, "told by content"


def test_a_scene_is_never_written_over_its_own_file(tmp_path: Path):
    path = File().save(tmp_path)
    (tmp_path / "link.ply").symlink_to(path)
    scene = read_scene(path).gaussians()
    for output in (path, tmp_path / "link.ply"):
        with pytest.raises(OutputError, match="is also the input"):
            write_scene(output, scene, overwrite=True)
    assert path.read_bytes() == File().content


def test_a_failure_while_writing_leaves_the_old_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from aaplug.io.scenes import ply

    path = tmp_path / "out.ply"
    write_scene(path, make_scene(1, degree=0))
    before = path.read_bytes()
    monkeypatch.setattr(ply, "_records", lambda *_: np.zeros(4, np.uint8))
    with pytest.raises(OutputError, match=r"bytes were written instead of"):
        write_scene(path, make_scene(2, degree=0), overwrite=True)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_model_folder_means_its_last_iteration(tmp_path: Path):
    model = tmp_path
    for iteration in ("7000", "30000", "best", "99999"):
        folder = model / "point_cloud" / f"iteration_{iteration}"
        folder.mkdir(parents=True)
        if iteration != "99999":
            (folder / "point_cloud.ply").write_bytes(File().content)
    assert find_scene(model).parent.name == "iteration_30000"
    assert find_scene(model, 7000).parent.name == "iteration_7000"
    assert read_scene(model).title == model.name
    scene = read_scene(str(model), iteration=7000).gaussians()
    write_scene(str(tmp_path / "text.ply"), scene)
    write_parts(str(tmp_path / "parts.ply"), [scene], 5, [str(tmp_path / "in.ply")])
    assert (tmp_path / "text.ply").read_bytes() == (tmp_path / "parts.ply").read_bytes() == File().content
    with pytest.raises(FormatError, match="no iteration 5; it has 7000, 30000"):
        find_scene(model, 5)
