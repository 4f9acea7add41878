"""The parts that options are made of: how values are read from words, checked, and shown by `--help`."""

import ast
import inspect
import os
import re
import textwrap
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import pairwise
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, Literal, cast, dataclass_transform, get_args, get_origin, get_type_hints

from aaplug.system.contracts import check_fields
from aaplug.system.errors import MAX_VALUE_CHARACTERS, UsageError, not_one_of
from aaplug.system.monitor import SILENT, Monitor
from aaplug.system.registry import names_of

ADDRESS = re.compile(r"[a-z][a-z0-9+.-]+://", re.IGNORECASE)  # such as https://; a drive of Windows has one letter


@dataclass(frozen=True)
class Group:
    """A heading of `--help`, which adds "options" to the title; options without one stand first."""

    title: str
    about: str


PYTHON_ONLY = Group("Python", "Options that the command line does not offer.")


@dataclass(frozen=True, kw_only=True)
class Option:
    """An option of a verb: how it is read from words, checked and shown by `--help`.

    default: MISSING if it is needed.
    metavar: stands for the value.  takes: the values that fit, for messages; the metavar if empty.
    read: makes a value of one word, or raises ValueError.
    count: number of words; 0 for a switch, None for one or more.
    also: other names than the field's, such as -m.  by_place: True if it is given without a name.
    check: called with the option's name and a value; raises UsageError for one that does not fit.
    """

    name: str = ""
    help: str = ""
    default: Any = None
    group: Group | None = None
    metavar: str = ""
    takes: str = ""
    read: Callable[[str], Any] = str
    count: int | None = 1
    also: tuple[str, ...] = ()
    by_place: bool = False
    check: Callable[[str, Any], object] = lambda option, value: None

    def named(self, name: str, help: str, **how: Any) -> "Option":
        """The option of this name; how: `default` and `group`."""
        return replace(self, name=name, help=help, **how)

    @property
    def flags(self) -> list[str]:
        """The words that name it, the one for messages first; none for an option without a name."""
        name = ("--no-" if self.default is True else "--") + self.name.replace("_", "-")
        return [] if self.by_place else sorted([name, *self.also], key=lambda one: (one[1] != "-", one == name))

    @property
    def shown(self) -> str:
        """The option as messages name it."""
        return self.flags[0] if self.flags else self.metavar.split()[0].strip("[]")

    def value(self, words: Sequence[str]) -> Any:
        """The value that words give, several of them also between commas; raises UsageError."""
        if self.count == 0 and not words:
            return not self.default
        got = " ".join(words)[:MAX_VALUE_CHARACTERS].strip() or "nothing"
        if self.count is None:
            words = [part for word in words for part in map(str.strip, word.split(",")) if part]
        with suppress(ValueError):
            if words and all(words) and len(words) == (len(words) if self.count is None else self.count):
                values = tuple(map(self.read, words))
                value = values[0] if self.count == 1 else values
                self.check(self.shown, value)
                return value
        raise UsageError(self.shown, f"takes {self.takes or self.metavar}, got {got}")


SWITCH = Option(takes="no value", count=0, default=False)


def flag(metavar: str, *flags: str, parsed: Callable[[str, str], object] | None = None, **how: Any) -> Option:
    """An option that takes text: any, or what `parsed`, which is given it and the option, does not refuse."""

    def check(option: str, value: Any) -> None:
        for each in value if isinstance(value, (list, tuple)) else [value]:
            if parsed is not None and isinstance(each, str):
                parsed(each, option)

    return Option(metavar=metavar, also=flags, check=check, **how)


def as_path(word: str) -> Path:
    """The path that a word names; ~ is the user's home, which shells leave to the program in `--output=~/a.ply`.

    Raises UsageError for "-", which other programs take for their standard input or output, and for an address.
    """
    if word == "-":
        raise UsageError(word, "is no file: nothing is read from stdin or written to stdout; name a file")
    if ADDRESS.match(word):
        raise UsageError(word, "is an address: nothing is read from or written to the network; name a file")
    return Path(os.path.expanduser(word))


def names(*others: Any, kind: str | None = None, metavar: str = "", **how: Any) -> Option:
    """An option that takes a name: one of these, or of those in the registry of a kind, of which it takes objects too.

    A name that is given twice does not fit.
    """
    values = {str(name): name for name in others}

    def known() -> list[str]:
        return [*values, *(names_of(kind) if kind else ())]

    def check(option: str, value: Any) -> None:
        given = value if isinstance(value, (list, tuple)) else [value]
        if len(set(map(str, given))) < len(given):
            raise UsageError(option, f"names one twice: {', '.join(map(str, given))}")
        for each in given:
            name = str(each)[:MAX_VALUE_CHARACTERS]
            if each is not None and name not in known() and (kind is None or isinstance(each, str)):
                raise UsageError(option, not_one_of(name, known()))

    how = {"read": lambda word: values.get(word, word), "metavar": metavar or "|".join(known())} | how
    return Option(check=check, **how)


def number(
    least: int | float,
    most: int | float,
    *,
    whole: bool = False,
    several: bool = False,
    unit: str = "",
    metavar: str = "",
    length: int | None = None,
) -> Option:
    """An option that takes a number from `least` to `most`, or one or more.

    A number that need not be whole may be written as 1/4 or 25%.  unit: may follow it as the word's end.
    metavar: stands for the value in `--help` instead of the range.  length: how many numbers, None for any.
    """
    kind = Integral if whole else Real  # NumPy's too
    span = f"{least:.10g}..{most:.10g}"
    named = f"{metavar}, each " * bool(several and metavar)  # such as X Y Z
    takes = f"{named}{'a whole number ' * whole}{span}" + " ..." * (several and not named)

    def real(word: str) -> float:
        word = word.removesuffix(unit)
        above, slash, below = word.removesuffix("%").partition("/")
        if slash and not float(below):
            raise ValueError(word)
        return float(above) / (float(below) if slash else 1.0) / (100.0 if word.endswith("%") else 1.0)

    def holds(value: Any) -> bool:
        return not isinstance(value, bool) and isinstance(value, kind) and least <= cast(float, value) <= most

    def check(option: str, value: Any) -> None:
        values = value if several else [value]
        listed = isinstance(values, (list, tuple))
        if value is None or (listed and all(map(holds, values)) and len(values) == (length or len(values) or 1)):
            return
        got = ", ".join(map(str, values)) if listed else str(value)
        wanted = takes if listed else f"a list or tuple of {takes.removesuffix(' ...')}"
        raise UsageError(option, f"takes {wanted}, got {got[:MAX_VALUE_CHARACTERS] or 'nothing'}")

    how = {"read": int if whole else real, "count": None if several else 1, "takes": takes, "check": check}
    return Option(metavar=metavar or span + " ..." * several, **how)


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of a verb; a subclass is a dataclass of this kind without being decorated.

    Its `_rules` refuse options that contradict each other, after those of its bases.

    Raises:
        UsageError: a value is not of its option's type, a number is outside of its range, a name is not known, or a
            rule does not hold.
    """

    monitor: Annotated[Monitor, PYTHON_ONLY] = SILENT
    """Receiver of messages and progress."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    def __post_init__(self) -> None:
        for option in options_of(type(self)):
            option.check(option.name, getattr(self, option.name))
        check_fields(self)
        for base in reversed(type(self).__mro__):
            if "_rules" in vars(base):
                vars(base)["_rules"](self)

    def need(self, holds: bool, problem: str, *names: str) -> None:
        """Refuse options that are not as usual, unless a condition holds; raises UsageError."""
        for name in names:
            if not holds and getattr(self, name) != getattr(type(self), name):
                raise UsageError(name, problem)


@cache
def docs_of(options: type) -> dict[str, str]:
    """The docstring of each field of a dataclass, its bases' included, by the field's name."""
    docs: dict[str, str] = {}
    for base in reversed(options.__mro__[:-1]):
        [tree] = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        for statement, after in pairwise(cast(ast.ClassDef, tree).body):
            if isinstance(statement, ast.AnnAssign) and isinstance(after, ast.Expr):
                docs[ast.unparse(statement.target)] = ast.literal_eval(after.value)
    return docs


@cache
def options_of(options: type[Options]) -> tuple[Option, ...]:
    """The options of a class: what a field's annotation states, and its default; `docs_of` has their help.

    A field of a Literal takes one of its values, and one whose annotation states nothing is a switch.
    """
    hints, found = get_type_hints(options, include_extras=True), list[Option]()
    for each in fields(options):
        parts = getattr(hints[each.name], "__metadata__", ())
        kind = get_args(hints[each.name])[0] if parts else hints[each.name]
        usual = names(*get_args(kind)) if get_origin(kind) is Literal else SWITCH
        option = next((part for part in parts if isinstance(part, Option)), usual)
        group = next((part for part in parts if isinstance(part, Group)), None)
        found.append(replace(option, name=each.name, default=each.default, group=group))
    return tuple(found)
