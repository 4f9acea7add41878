"""Options: every number has a range that --help shows and the library checks; the program answers in one line."""

import dataclasses
import math
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from aaplug_cli.main import main
from aaplug_cli.verbs import VERBS

from aaplug.options.base import Options
from aaplug.system.errors import UsageError

NO_NUMBERS = (math.nan, math.inf, -math.inf, -1, 10**30, True, "", "x" * 10_000)


def range_of(hint: Any) -> list[Any]:
    """The ranges that an annotation states: one for a number, none for others."""
    return [part for part in getattr(hint, "__metadata__", ()) if hasattr(part, "is_instance")]


def numeric(hint: Any) -> bool:
    return hint in (int, float) or any(numeric(arg) for arg in get_args(hint) if not isinstance(arg, (int, str)))


def numbers(options: type[Options]) -> dict[str, list[Any]]:
    """The options of a class that take numbers, with their ranges."""
    hints, plain = get_type_hints(options, include_extras=True), get_type_hints(options)
    named = [n for n, hint in plain.items() if numeric(hint) and n != "background"]  # a colour or a name
    return {name: range_of(hints[name]) for name in named}


ALL = sorted({group for verb in VERBS.values() for group in verb.classes}, key=lambda c: c.__name__)
NUMERIC = [(group, name, specs) for group in ALL for name, specs in numbers(group).items()]
IDS = [f"{group.__name__}.{name}" for group, name, _ in NUMERIC]


def test_the_options_are_found():
    assert len({name for _, name, _ in NUMERIC}) >= 18


@pytest.mark.parametrize(("group", "name", "specs"), NUMERIC, ids=IDS)
def test_every_number_has_a_range(group, name, specs):
    assert len(specs) == 1, f"{group.__name__}.{name} has no range"
    (spec,) = specs
    least, most = map(float, spec.range_text.removesuffix(" ...").split(".."))
    several = spec.nargs == "*"
    for value in NO_NUMBERS:
        inside = isinstance(value, (int, float)) and value is not True and least <= value <= most
        assert spec.is_instance([value] if several else value) == inside, value
    default = next(field.default for field in dataclasses.fields(group) if field.name == name)
    assert default is None or spec.is_instance(default)


@pytest.mark.parametrize(("group", "name", "specs"), NUMERIC, ids=IDS)
def test_a_number_outside_of_its_range_is_refused(group, name, specs):
    spec, plain = specs[0], get_type_hints(group)[name]
    value = 10**30 if int in (plain, *get_args(plain)) else math.nan
    with pytest.raises(UsageError, match=rf"takes .*\.\..*, got {value}"):
        group(**{name: [value] if spec.nargs == "*" else value})


REFUSED = {
    "render --nope": "Missing from aaplug render: -o PATH",
    "render s.ply -o out --scal 2": "Unrecognized options: --scal",
    "render s.ply -o": "Missing value for argument '-o/--output'",
    "render s.ply -o out --scale x": "--scale: takes 0.001..64, got x",
    "render s.ply -o out --bit-depth 9": "invalid choice '9'",
    "render s.ply -o out --threads 99999": "--threads: takes 1..",
    "finetune s.ply -o t.ply --scale 1,nan": "--scale: takes 0.001..64 ..., got 1.0, nan",
    "evaluate s.ply --scale": "--scale: takes 0.001..64 ..., got nothing",
    "compare a.ply b.ply --fail-under 500": "--fail-under: takes 0..200, got 500",
    "bench --gaussians 1e5": "takes 1..100000000 ..., got 1e5",
    "bench --gaussians 10 --resolution 0x0": "--resolution: takes sizes such as 400x400, got 0x0",
    "bench --gaussians 10 --resolution 1000000x1000000": "the limit is 16384 a side",
    "fly s.ply": "there is no verb 'fly'; see `aaplug --help`",
    "rendr s.ply": "there is no verb 'rendr'; did you mean render?",
    "--colour": "Unrecognized options: --colour",
}


@pytest.mark.parametrize("words", REFUSED)
def test_a_refusal_is_one_line(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words.split())
    printed = capsys.readouterr()
    assert stop.value.code == 2
    assert printed.err.startswith("error: ")
    assert printed.err.count("\n") == 1, printed.err
    assert REFUSED[words] in printed.err
    assert not Path("out").exists()


@pytest.mark.parametrize("verb", VERBS)
def test_help_shows_every_range(verb, capsys):
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    shown = "".join(capsys.readouterr().out.split())
    for option in VERBS[verb].options:
        if numeric(get_args(option.annotation)[:1] and get_args(option.annotation)[0]):
            (spec,) = range_of(option.annotation)
            assert f"--{option.name.replace('_', '-')}{spec.metavar}".replace(" ", "") in shown
