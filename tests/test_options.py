"""Options: every number has a range that --help shows and the library checks; the program answers in one line."""

import dataclasses
import io
import math
import sys
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from aaplug_cli.verbs import VERBS

from aaplug.io.batch_file import read_batch
from aaplug.options.base import Option, Options, names
from aaplug.system.errors import UsageError
from tests.conftest import run_python

NO_NUMBERS = (math.nan, math.inf, -math.inf, -1, 10**30, True, "", "x" * 10_000)


def fits(spec: Option, value: Any) -> bool:
    """True if a value is not refused."""
    try:
        spec.check("option", value)
    except UsageError:
        return False
    return True


def numeric(hint: Any) -> bool:
    return hint in (int, float) or any(numeric(arg) for arg in get_args(hint) if not isinstance(arg, (int, str)))


def numbers(options: type[Options]) -> dict[str, list[Any]]:
    """The options of a class that take numbers, with their ranges: one for each, as the annotation states it."""
    hints, plain = get_type_hints(options, include_extras=True), get_type_hints(options)
    named = [n for n, hint in plain.items() if numeric(hint) and n != "background"]  # a colour or a name
    stated = {name: getattr(hints[name], "__metadata__", ()) for name in named}
    return {n: [p for p in parts if isinstance(p, Option) and ".." in p.takes] for n, parts in stated.items()}


ALL = sorted({group for verb in VERBS.values() for group in verb.classes}, key=lambda c: c.__name__)
NUMERIC = [(group, name, specs) for group in ALL for name, specs in numbers(group).items()]
IDS = [f"{group.__name__}.{name}" for group, name, _ in NUMERIC]


def test_the_options_are_found():
    assert len({name for _, name, _ in NUMERIC}) >= 18


def test_values_stand_between_commas_with_or_without_spaces():
    assert names("a", "b", "c", count=None).value(["a, b", "c,"]) == ("a", "b", "c")


@pytest.mark.parametrize(("group", "name", "specs"), NUMERIC, ids=IDS)
def test_every_number_has_a_range(group, name, specs):
    assert len(specs) == 1, f"{group.__name__}.{name} has no range"
    (spec,) = specs
    span = spec.takes.removesuffix(" ...").rpartition("each ")[2].removeprefix("a whole number ")
    least, most = map(float, span.split(".."))

    def given(value: Any) -> Any:
        return value if spec.count else [value] * (3 if spec.metavar == "X Y Z" else 1)

    for value in NO_NUMBERS:
        inside = isinstance(value, (int, float)) and value is not True and least <= value <= most
        assert fits(spec, given(value)) == inside, value
    default = next(field.default for field in dataclasses.fields(group) if field.name == name)
    assert default is None or fits(spec, default)
    plain = get_type_hints(group)[name]
    value = 10**30 if int in (plain, *get_args(plain)) else math.nan
    with pytest.raises(UsageError, match=rf"takes .*\.\..*, got {value}"):
        group(**{name: given(value)})


REFUSED = {
    "render s.ply": "Missing: -o PATH, --output PATH: A folder for the images, or one file for one view: .png",
    "render --nope": "Unrecognized options: --nope",
    "render s.ply -o out --scal 2": "Unrecognized options: --scal; did you mean --scale?; see",
    "render s.ply -o -": "error: -: is no file: nothing is read from stdin or written to stdout; name a file",
    "info -": "error: -: is no file",
    "info https://a.org/s.ply": "error: https://a.org/s.ply: is an address: nothing is read from or written to",
    "merge s.ply -o S3://b/s.glb": "error: S3://b/s.glb: is an address",
    "render s.ply -o": "Missing value for argument '-o/--output'",
    "render s.ply t.ply -o x": "Unrecognized words: t.ply",
    "render s.ply -o x --json=3": "Unrecognized words: 3; see",
    "convert s.ply -o c.ply --for supersplatt": "--for: 'supersplatt' is not one of classic",
    "lod s.ply -o l.ply --for spark --no-refine": "--for: is what the result is tuned for: leave out --no-refine",
    "render s.ply -o out --scale x": "--scale: takes 0.001..64, got x",
    "render s.ply -o out --passes rgb,depth,rgb": "--passes: names one twice: rgb, depth, rgb",
    "render s.ply -o out --bit-depth 9": "--bit-depth: '9' is not one of 8, 16, 32",
    "render s.ply -o out --scale 2 --resolution 8x8": "--scale: sets the size, as --resolution does; give one",
    "render s.ply -o out --resolution -1x-1": "--resolution: takes sizes such as 400x400, got -1x-1",
    "render s.ply -o out --resolution 99999x-1": "--resolution: would be 99999x99999 px; the limit is 16384 a side",
    "render s.ply -o out --path p.json --views train": "--views: are replaced by --path; give one of the two",
    "render s.ply -o out --camera-to b --samples 0": "--camera-to: opens a shutter, which --samples of 0 ignores",
    "render s.ply -o out --samples 0 --f-stop 2 --focus-distance 1": "--f-stop: is ignored by --samples of 0",
    "video s.ply -o v.mp4 --path orbit --start 0.5": "--start: is for the paths zoom, dolly, not for orbit",
    "video s.ply -o v.mp4 --path a.json --seconds 2": "is for the paths zoom, dolly, orbit, not for a.json",
    "video s.ply -o v.mp4 --path a.json --views b": "--views: is for the paths zoom, dolly, orbit, not for a.json",
    "lod s.ply -o l.ply --steps 3 --no-refine": "--steps: are of tuning, which --no-refine leaves out",
    "convert s.ply -o c.ply --steps 3": "--steps: belongs to the fit to a viewer; name one with --for",
    "convert s.ply -o c.ply --for gsplat --variance 0.1": "--variance: is set by --for; give one of the two",
    "finetune s.ply -o t.ply --learn-filters --method group-training": "is a method of its own, beside group-training",
    "render s.ply -o out --orbit 2.5": "--orbit: takes a whole number 1..10000, got 2.5",
    "render s.ply -o out --up z": "--up: takes X Y Z, each -10000000..10000000, got z",
    "merge s.ply -o m.ply --move 1,a,2": "--move: takes X,Y,Z ..., each -1000000000..1000000000, got 1,a,2",
    "finetune s.ply -o t.ply --scale 1,nan": "--scale: takes 0.001..64 ..., got 1.0, nan",
    "evaluate s.ply --scale": "--scale: takes 0.001..64 ..., got nothing",
    "evaluate s.ply -o out --show 5": "--show: selects views of the report; give --report, too",
    "compare a.ply b.ply --fail-under 30 --metric ssim": "--fail-under: is of PSNR, which --metric leaves out",
    "bench --gaussians 1e5": "takes N ..., each a whole number 1..100000000, got 1e5",
    "view no.ply --no-browser --port 0": "no.ply: cannot be read: no such file",
    "fly s.ply": "there is no verb 'fly'; see `aaplug --help`",
    "rendr s.ply": "there is no verb 'rendr'; did you mean render?",
    "render s.ply -o out --passes keep": "id, samples, bound\n",
    "guide gather": "theory, view, viewers; did you mean theory?",
    "guide stat": "'stat' is not one of architecture, bare",
    "guide strat": "view, viewers; did you mean start?",
    "--colour": "Unrecognized options: --colour",
}


def test_a_path_may_begin_at_home(monkeypatch, tmp_path):
    """A shell replaces ~ at the beginning of a word alone, so not in --output=~/out."""
    monkeypatch.setenv("HOME", str(tmp_path))
    given = VERBS["render"].parse(["~/s.ply", "--output=~/out", "--cameras=~/c", "--path=~/p.json"])
    assert (given.scene, given.output) == (tmp_path / "s.ply", tmp_path / "out")
    assert (given.cameras, given.path) == (tmp_path / "c", tmp_path / "p.json")
    (tmp_path / "b.toml").write_text('[[scene]]\nscene = "~/s.ply"\nlpips = ["~/a", "b"]')
    _, scenes = read_batch(tmp_path / "b.toml")
    assert scenes["s"] == {"scene": str(tmp_path / "s.ply"), "lpips": [str(tmp_path / "a"), str(tmp_path / "b")]}


def test_no_option_takes_an_empty_word():
    """As a variable of a shell leaves it that is not set; a path would be the folder that the program runs in."""
    for command in VERBS.values():
        for option in command.options.values():
            if option.count != 0:
                with pytest.raises(UsageError, match=r"takes .*, got nothing"):
                    option.value([""] * (option.count or 1))


def test_a_refusal_has_no_frame_on_a_terminal_without_unicode(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "ascii"))
    with pytest.raises(UsageError, match=r"aaplug render: Missing: -o PATH"):
        VERBS["render"].parse(["s.ply"])


@pytest.mark.parametrize("words", REFUSED)
def test_a_refusal_is_one_line(words, program):
    code, _, err = program(words)
    assert code == 2
    assert err.startswith("error: ")
    assert err.count("\n") == 1, err
    assert REFUSED[words] in err
    assert not [*Path().iterdir()]


def test_a_share_is_written_as_people_write_it():
    def scale(word: str) -> float:
        return VERBS["render"].parse(["s.ply", "-o", "out", "--scale", word]).scale

    assert [scale(word) for word in ("1/4", "25%", "0.25", "12.5%", "2/1")] == [0.25, 0.25, 0.25, 0.125, 2.0]
    for word in ("1/0", "1/", "%", "1/2/4"):
        with pytest.raises(UsageError, match=f"--scale: takes 0.001..64, got {word}"):
            scale(word)


WRONG = """
from aaplug.options.verbs import *
from aaplug.system.errors import UsageError
for options, name, value in (
    (RenderOptions, "views", ["r_8"]), (RenderOptions, "resolution", (5, 5)), (RenderOptions, "overwrite", 1),
    (RenderOptions, "bit_depth", 7), (RenderOptions, "monitor", 3), (ConvertOptions, "form", 3),
    (EvaluateOptions, "layout", "tree"), (FinetuneOptions, "move", ["colour"]), (VideoOptions, "fps", "24"),
    (EvaluateOptions, "scale", 0.5),
):
    try:
        options(**{name: value})
        print(name, "is taken")
    except UsageError as error:
        if not str(error).startswith(f"{name}: ") or str(value).strip("[]'") not in str(error):
            print(error)
"""


def test_a_value_of_another_type_is_refused_from_python_too():
    """In a process of its own, in which nothing else checks types."""
    done = run_python(WRONG)
    assert (done.stdout, done.stderr) == ("", "")
