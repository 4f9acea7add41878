"""Odd inputs and surroundings: each ends with a result or with one line, never with a traceback or a stray file."""

import errno
import os
import re
import sys
from io import StringIO
from pathlib import Path
from unittest.mock import Mock

import pytest
from aaplug_cli import console
from aaplug_cli.console import TERMINAL, refuse, show, table
from aaplug_cli.main import main
from rich.console import Console

from aaplug import read_cameras, write_scene
from aaplug.evaluation.data_sets import status_table
from aaplug.evaluation.results import Report, grid
from aaplug.system.errors import FormatError, printable
from tests.conftest import exit_code, make_scene

LONG = "n" * 300
FULL = Path("/dev/full")


def with_comment(path: Path, comment: bytes) -> None:
    data = path.read_bytes()
    after = data.index(b"\n", data.index(b"format")) + 1
    path.write_bytes(data[:after] + b"comment " + comment + b"\n" + data[after:])


def test_escapes_of_a_file_do_not_reach_the_terminal(cli):
    with_comment(Path("scene.ply"), b"SplatRenderMode: \x1b[31mred")
    out, err = cli.done("info scene.ply")
    assert "\x1b[31m" not in out + err
    assert r"\x1b[31mred" in err
    with_comment(Path("scene.ply"), b"aaplug fused=\x1b[31m")
    code, _, err = cli("info scene.ply")
    assert (code, "is damaged: expected key=value pairs" in err, "\x1b[31m" in err) == (2, True, False)


@pytest.mark.skipif(not FULL.exists(), reason="there is no device that is always full")
@pytest.mark.parametrize("words", ["info scene.ply --json", "recipes", "--version"])
def test_a_full_disk_behind_stdout_is_one_line(cli, words):
    def run() -> None:
        with FULL.open("w") as sys.stdout, Path("err").open("w") as sys.stderr:
            main(words.split())

    assert exit_code(run) == 2
    err = Path("err").read_text()
    assert err.splitlines()[-1] == "error: output: no space left on device"
    assert "Traceback" not in err


@pytest.mark.parametrize("words", ["render -o LONG/x", "evaluate --recipe classic -o LONG", "convert -o LONG.ply"])
def test_names_longer_than_the_file_system_takes(cli, words):
    cli.refused(f"info {LONG}.ply", "name too long")
    words = words.replace("LONG", LONG)
    cli.refused(f"{words} --cameras . scene.ply", f" {words.split()[-1]}: cannot be written: file name too long")


@pytest.mark.parametrize("words", ["render", "evaluate --recipe classic", "compare scene.ply", "lod"])
def test_a_folder_that_cannot_be_looked_into(cli, words):
    Path("loop").symlink_to("loop")
    cli.refused(f"{words} scene.ply --cameras . -o loop", " loop: cannot be written: too many levels of symbolic links")


@pytest.mark.parametrize("words", ["evaluate", "compare scene.ply"])
def test_a_folder_of_results_is_refused_before_anything_is_read(cli, words):
    Path("out").mkdir()
    Path("out/progress.jsonl").touch()
    code, _, err = cli(f"{words} scene.ply --cameras . -o out")
    assert (code, err.count("\n"), "--overwrite starts anew" in err) == (2, 1, True)


@pytest.mark.skipif(os.name == "nt", reason="a folder that a program works in cannot be removed there")
def test_a_folder_that_was_removed(cli):
    data, gone = Path().absolute(), Path("gone").absolute()
    gone.mkdir()
    os.chdir(gone)
    gone.rmdir()
    words = f"render {data}/scene.ply --cameras {data} -o {data}/out"
    cli.refused(words, "current folder: cannot be used: no such file")


def test_names_that_are_not_utf_8(cli, plots_drawn_once):
    odd = os.fsdecode(b"\xff\xfe")
    Path("scene.ply").rename(f"{odd}.ply")
    cli.done(f"info {odd}.ply")
    cli.done(f"convert {odd}.ply --cameras . -o c{odd}.ply")
    cli.done(f"evaluate {odd}.ply --cameras . -o r{odd} --recipe classic --scale 0.5 --report")
    assert Path(f"r{odd}/report.html").exists()


def test_a_folder_may_have_a_dot_and_a_view_a_long_name(cli):
    cameras = Path("transforms_test.json")
    cameras.write_text(cameras.read_text().replace("r_0", LONG))
    cli.done("render scene.ply --cameras transforms_test.json -o results_v1.0 --scale 0.5")
    assert [path.name for path in Path("results_v1.0").iterdir()] == [f"{LONG[:200]}.png"]
    assert "name a folder" in cli("render scene.ply --cameras . -o new.tiff --scale 0.5")[2]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("Cannot allocate memory", "cannot allocate memory"),
        ("/Lib/C.so: version `GLIBC_2.38' not found", "/Lib/C.so: version `GLIBC_2.38' not found"),  # names keep case
    ],
)
def test_an_error_of_the_system_is_told_by_what_it_is(monkeypatch, capsys, words, told):
    monkeypatch.setattr("aaplug_cli.main.run", Mock(side_effect=OSError(errno.ENOMEM, words)))
    with pytest.raises(SystemExit, match="2"):
        main(["info"])
    assert capsys.readouterr().err == f"error: unexpected OSError: {told}\n"


def test_an_empty_scene_is_neither_tuned_nor_measured(cli):
    write_scene("scene.ply", make_scene(0), overwrite=True)
    for words, use in (
        ("finetune scene.ply -o t.ply --steps 1", "tune"),
        ("convert scene.ply -o t.ply --for gsplat --steps 0", "measure"),
        ("compare scene.ply scene.ply", "measure"),
    ):
        cli.refused(f"{words} --cameras . --rasterizer eager", f"has no Gaussians to {use}")
    cli.done("render scene.ply --cameras . -o new --recipe mip-splatting --scale 0.5")


def test_a_principal_point_far_away_is_refused(tmp_path):
    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 80 80 100 100 1e308 40\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 4 1 a.png\n\n")
    with pytest.raises(FormatError, match=r"camera a\.png: cx: expected a number from -1e"):
        read_cameras(tmp_path)


NAMES = ("{x}", "[/x]", "[red]x", ":bomb:", "x\\", "{task.fields}", "a\x1b[31m")  # fields, markup, an emoji, commands


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_no_markup_field_or_command_of_the_terminal(monkeypatch, name):
    written = StringIO()
    terminal = Console(file=written, force_terminal=True, color_system=None, width=100)
    monkeypatch.setattr(console, "log", lambda: terminal)
    with TERMINAL.progress(f"evaluating {name}", "views") as tell:
        tell(1, 2)
    refuse(f"scene {name}")
    terminal.print(table([[f"row {name}"]]), status_table("why", [(f"cell {name}", "done", "")]))
    shown = [part + printable(name) for part in ("evaluating ", "error: scene ", "row ", "cell ")]
    assert [part for part in shown if not re.search(re.escape(part) + r"(?!\\)", written.getvalue())] == []
    assert "\x1b[31m" not in written.getvalue()


def test_numbers_are_whole_where_they_do_not_fit_side_by_side(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    scales = [1 / n for n in range(1, 13)]
    cells = [f"{41 + scale:.4f}" for scale in scales]
    report = Mock(Report, row_title="recipe", scales=scales, recipes=["playcanvas-classic"])
    show([grid("PSNR", report, [cells])])
    assert {*cells, "playcanvas-classic"} <= {*capsys.readouterr().out.split()}


def test_a_rate_of_progress_is_in_plain_digits(capsys):
    with TERMINAL.progress("merging", "Gaussians") as tell:
        tell(0, 64_000)
        tell(64_000, 64_000)
    assert re.search(r"64,000 of 64,000 Gaussians, [\d,]+ a second", capsys.readouterr().err)
