"""Many scenes in one evaluation: files, isolation of failures, continuing after a kill."""

import json
import shutil
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from aaplug.evaluation.journal import JOURNAL, Journal
from aaplug.evaluation.report.files import RESULTS
from aaplug.evaluation.results import Measurement, Report
from aaplug.io.batch_file import read_batch
from aaplug.system.errors import ClusterError, FormatError, UsageError
from aaplug.verbs.batch import batch as evaluate_all

SETTINGS = """
output = "out"
recipe = ["classic", "matched"]
scale = [0.5]
views = "train"
rasterizer = "eager"

[[scene]]
name = "whole"
scene = "scene.ply"
cameras = "."

[[scene]]
scene = "broken.ply"
cameras = "."
recipe = ["classic"]
"""


@pytest.fixture
def batch(cli):
    """The program, in a folder that holds batch.toml, a whole scene and a broken one."""
    data = Path("scene.ply").read_bytes()
    Path("broken.ply").write_bytes(data[:-100])
    Path("batch.toml").write_text(SETTINGS)
    return cli


def timeless(folder: Path) -> dict[str, Any]:
    """Every file of results without its times."""
    found = {}
    for path in sorted(path for path in folder.rglob("*") if "plots" not in path.parts):
        if path.suffix == ".json":
            data = json.loads(path.read_text())
            content = json.dumps({n: {**v, "seconds": 0} if isinstance(v, dict) else v for n, v in data.items()})
        elif path.suffix == ".csv":
            rows = [line.split(",") for line in path.read_text().splitlines()]
            seconds = rows[0].index("seconds") - len(rows[0])  # from the end: names may hold commas
            content = [row[:seconds] + row[len(row) + seconds + 1 :] for row in rows]
        elif path.suffix == ".png":
            content = path.read_bytes()
        else:
            continue
        found[str(path.relative_to(folder))] = content
    return found


def test_a_broken_scene_stops_no_other_and_is_named_and_added_by_resuming_when_it_is_mended(batch):
    code, out, err = batch("evaluate --batch batch.toml")
    assert (code, "failed" in out, "broken" in out, "failed: broken" in err) == (1, True, True, True)
    results = json.loads(Path("out/whole/results.json").read_text())
    assert {"classic@0.5", "matched@0.5", "_aaplug"} <= set(results)
    summary = json.loads(Path("out/batch.json").read_text())
    assert {name: facts["status"] for name, facts in summary["scenes"].items()} == {"whole": "done", "broken": "failed"}
    assert "bytes" in summary["scenes"]["broken"]["error"]
    assert summary["mean_over"] == ["whole"]
    assert summary["mean"]["matched@0.5"] == results["matched@0.5"]
    assert not Path("out/broken").exists()
    lines = Path("out/results.csv").read_text().splitlines()
    assert len(lines) == 1 + 3 * 3  # ceiling and two recipes, three views
    assert "r_0" in lines[1]
    before = Path("out/whole/progress.jsonl").read_bytes()
    batch.refused("evaluate --batch batch.toml")  # there are results already
    shutil.copy("scene.ply", "broken.ply")
    batch.done("evaluate --batch batch.toml --resume")
    assert Path("out/whole/progress.jsonl").read_bytes() == before
    assert Path("out/broken/results.json").is_file()
    assert "broken" in Path("out/results.csv").read_text()


@pytest.mark.parametrize("verb", ["evaluate", "convert"])
def test_errors_of_a_scene_name_options_as_they_are_typed(batch, monkeypatch, verb):
    Path("one.toml").write_text('[[scene]]\nscene = "scene.ply"\ncameras = "."\nmin_seen = 1.0')
    code, out, err = batch(f"{verb} --batch one.toml -o out --json")
    assert code == 1
    assert "lower --min-seen" in json.loads(out)["scenes"]["scene"]["error"]
    assert "min_seen" not in out + err + Path("out/batch.json").read_text()

    monkeypatch.setattr(f"aaplug.{verb}", Mock(side_effect=MemoryError))
    code, out, err = batch(f"{verb} --batch one.toml -o out --json --overwrite")
    assert "fewer --threads" in json.loads(out)["scenes"]["scene"]["error"]


def test_scenes_of_the_command_line_share_cameras_and_overwriting_removes_those_that_it_has_no_more(batch):
    for name in ("b.ply", "c.ply"):
        shutil.copy("scene.ply", name)
    words = "--cameras . -o out --rasterizer eager --recipe matched --scale 0.5"
    found = json.loads(batch.done(f"evaluate scene.ply b.ply c.ply {words} --json")[0])
    assert set(found["scenes"]) == {"scene", "b", "c"}
    assert found["mean"]["matched@0.5"]["SSIM"] > 0.5
    Path("out/c/note.txt").touch()
    assert batch(f"evaluate scene.ply broken.ply {words} --overwrite")[0] == 1
    left = {str(path.relative_to("out")) for path in Path("out").glob("*/*")}
    assert left == {"c/note.txt", *(f"scene/{name}" for name in (JOURNAL, *RESULTS))}


def test_a_killed_batch_continues_to_the_same_bytes(batch, monkeypatch):
    words = "evaluate --batch batch.toml --layout inria"
    Path("batch.toml").write_text(SETTINGS.replace('"train"', '"r_1,r_2"'))
    shutil.copy("scene.ply", "broken.ply")
    batch.done(words)
    whole = timeless(Path("out"))
    for stop in (0, 3):  # before the first view, and in the second scene
        shutil.rmtree("out")
        with monkeypatch.context() as patch:
            patch.setattr(Journal, "add", killed_at(stop))
            assert batch(words)[0] == 130
        if (journal := Path("out/whole/progress.jsonl")).exists():
            with journal.open("ab") as stream:
                stream.write(b'{"view": 1, "meas')  # what a kill leaves
            batch.refused(words)  # without --resume nothing is lost
        batch.done(words + " --resume")
        assert timeless(Path("out")) == whole


def killed_at(stop: int):
    """`Journal.add`, interrupted at the call of that number."""
    calls, add = count(), Journal.add

    def adding(journal, view, measurements):
        if next(calls) == stop:
            raise KeyboardInterrupt
        add(journal, view, measurements)

    return adding


REFUSED = [
    ("scene = [", "should be TOML"),
    ("output = 'out'", "names no scene"),
    ("[[scene]]\ncameras = '.'", "names no scene; add scene"),
    ("[[scene]]\nscene = 'a.ply'\n[[scene]]\nscene = 'b/A.ply'", "name of its own"),
    (SETTINGS.replace("scale", "scales"), "scales is no setting here; did you mean scale?"),
    (SETTINGS.replace("[0.5]", "['big']"), "--scale: takes 0.001..64 ..., got big"),
    ("min-seen = 2" + SETTINGS, "at the top: --min-seen: takes 0..1, got 2"),
    (SETTINGS + "report = []", "--report: takes no value, got []"),
    (SETTINGS + "output = 'elsewhere'", "scene 'broken': output is no setting here"),
    (SETTINGS + "truth = 'other'", "--truth: 'other' is not one of auto"),
]


@pytest.mark.parametrize(("text", "named"), REFUSED, ids=range(len(REFUSED)))
def test_a_batch_file_that_does_not_fit_is_refused_by_key(batch, text, named):
    Path("bad.toml").write_text(text)
    batch.refused("evaluate --batch bad.toml", "bad.toml", named)


def test_paths_start_at_the_file_and_names_at_the_scenes(tmp_path):
    path = tmp_path / "b.toml"
    path.write_text("cull_margin = 0.3\n[[scene]]\nscene = 'x/a.ply'\ncameras = '/abs'\ntest-every = 8")
    shared, scenes = read_batch(path)
    assert shared == {"cull_margin": 0.3}
    expected = {"scene": str(tmp_path / "x/a.ply"), "cameras": "/abs", "test_every": 8}
    assert scenes == {"a": expected}
    with pytest.raises(FormatError, match="no such file"):
        read_batch(tmp_path / "gone.toml")


def test_a_file_can_take_back_what_the_command_line_sets(batch):
    Path("batch.toml").write_text(
        SETTINGS.split("[[scene]]")[0]
        + '[[scene]]\nscene = "scene.ply"\ncameras = "."\nreport = false\ndrop-bad = false\n'
    )
    batch.done("evaluate --batch batch.toml --report --drop-bad")
    assert Path("out/scene/results.json").is_file()
    assert not Path("out/scene/report.html").exists()


def report_of(scale: float = 1.0, protocol: Mapping[str, Any] | None = None, **values: float | None):
    """A run that measures these values without rendering."""
    measured = Measurement("auto", scale, "view", values, 1, 0.1)
    return lambda **settings: Report((measured,), protocol or {"recipes": {}})


def test_a_lost_cluster_ends_the_batch(tmp_path):
    lost = Mock(side_effect=ClusterError("scheduler tcp://a:1", "the connection is lost"))
    with pytest.raises(ClusterError):
        evaluate_all([("x", lost), ("y", report_of(PSNR=30.0))], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_no_failure_of_a_scene_costs_another(tmp_path):
    failing = [Mock(side_effect=error) for error in (ValueError("oh"), MemoryError)]
    runs = [*zip("xy", failing, strict=True), ("x", report_of(PSNR=30.0)), ("z", report_of(PSNR=None))]
    found = evaluate_all(runs, tmp_path / "out")
    assert list(found.names.values()) == ["x", "y", "x", "z"]
    assert len(set(found.names)) == 4  # folders of their own
    memory = "scene: out of memory; a smaller `scale`, fewer `threads` or fewer Gaussians need less"
    assert list(found.failures.values()) == ["unexpected ValueError: oh", memory]
    assert [report.recipes for report in found.reports.values()] == [("auto",), ("auto",)]
    # a mean over fewer scenes would not compare
    assert found.summary()["mean"] == {"auto@1": {"PSNR": None}}
    assert json.loads((tmp_path / "out/batch.json").read_text()) == found.summary()


def test_a_resumed_batch_of_another_request_leaves_the_summary_and_tables_name_other_scales(tmp_path):
    refused = Mock(side_effect=UsageError("progress.jsonl", "is of another request"))
    found = evaluate_all([("x", report_of(PSNR=30.0)), ("y", report_of(0.5, PSNR=30.0))], tmp_path / "out")
    assert "no PSNR at 1: some scenes have other scales" in found.tables()
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir() if path.is_file()}
    found = evaluate_all([("x", refused), ("y", refused)], tmp_path / "out", resume=True)
    assert len(found.failures) == 2
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir() if path.is_file()} == before


@pytest.mark.parametrize(
    ("part", "words"),
    [("protocol", "protocols"), ("truth", "truths"), ("downscale", "ways of downscaling"), ("metrics", "flavours")],
)
def test_figures_of_several_protocols_are_not_averaged(tmp_path, part, words):
    runs = [(name, report_of(protocol={part: {"SSIM": name}}, SSIM=0.9, PSNR=30.0)) for name in ("wang", "3dgs")]
    found = evaluate_all(runs, tmp_path / "out")
    assert found.summary()["mean"] == {"auto@1": {"SSIM": None, "PSNR": 30.0 if part == "metrics" else None}}
    assert f"no SSIM at 1: the scenes' {words} differ" in found.tables()


MANY = """
[[scene]]
scene = "scene.ply"
cameras = "."

[[scene]]
name = "wide"
scene = "scene.ply"
cameras = "."
{own}

[[scene]]
scene = "broken.ply"
cameras = "."
"""


@pytest.mark.parametrize(
    ("verb", "own", "outputs"),
    [
        ("convert", "variance = 0.1", ("scene.ply", "wide.ply")),
        ("lod --no-refine", "levels = 1\nrefine = true\nsteps = 0", ("scene", "wide")),
        ("lod --no-refine --to 3dtiles", "levels = 1", ("scene", "wide")),
    ],
)
def test_many_scenes_are_made_and_a_broken_one_is_named(batch, verb, own, outputs):
    Path("many.toml").write_text(MANY.format(own=own))
    code, out, err = batch(f"{verb} --batch many.toml -o out --json")
    assert code == 1, err
    found = json.loads(out)["scenes"]
    assert {name: facts["status"] for name, facts in found.items()} == {
        "scene": "done", "wide": "done", "broken": "failed",
    }  # fmt: skip
    assert "broken.ply: is cut short" in found["broken"]["error"]
    assert json.loads(Path("out/batch.json").read_text())["scenes"] == found
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(["batch.json", *outputs])
    batch.refused(f"{verb} --batch many.toml -o out")  # nothing is replaced unasked
    code, out, _ = batch(f"{verb} --batch many.toml -o out --resume --json")
    assert [facts["status"] for facts in json.loads(out)["scenes"].values()] == ["kept", "kept", "failed"]
    if (levels := Path("out/wide/lod.json")).exists():
        levels.write_text("{")
        code, out, _ = batch(f"{verb} --batch many.toml -o out --resume --json")
        assert [facts["status"] for facts in json.loads(out)["scenes"].values()] == ["kept", "failed", "failed"]
