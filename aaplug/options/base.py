"""The parts that options are made of: how values are read from words, checked, and shown by `--help`."""

import ast
import inspect
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from itertools import pairwise
from numbers import Integral, Real
from typing import Annotated, Any, TypeVar, cast, get_type_hints

import tyro

from aaplug.system.contracts import check_fields
from aaplug.system.errors import MAX_VALUE_CHARACTERS, UsageError, did_you_mean, not_one_of
from aaplug.system.monitor import SILENT, Monitor
from aaplug.system.registry import names_of

Chosen = TypeVar("Chosen", bound="Options")


@dataclass(frozen=True)
class Group:
    """A heading of `--help`, under which an option stands; options without one stand first.

    title: `--help` adds "options".
    """

    title: str
    about: str


CAMERAS = Group("camera", "How the camera files are read, and which of the scene's Gaussians they must see.")
ORBIT = Group("orbit", "Without cameras: views on an orbit around the scene, and the training that is assumed.")
DRAWING = Group("drawing", "How images are drawn: programs, memory and machines.")
REPORT = Group("report", "Files beside the figures.")
TUNING = Group("tuning", "The optimization, of which the defaults were measured.")


def flag(metavar: str, *aliases: str, kind: Any = None) -> Any:
    """An option whose help shows `metavar` and no default, for what is absent unless given."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases, help_behavior_hint="", constructor=kind)


def choice(names: Iterable[str]) -> Any:
    """An option that takes one of these names, or in Python an object; the library refuses other names."""
    return tyro.constructors.PrimitiveConstructorSpec(
        1, "|".join(names), "".join, lambda _: True, lambda one: [str(one)]
    )


def choices(names: Iterable[str]) -> Any:
    """An option that takes some of these names, or in Python objects."""
    return tyro.constructors.PrimitiveConstructorSpec(
        "*", "|".join(names), tuple, lambda _: True, lambda some: [*map(str, some)]
    )


def number(
    least: int | float,
    most: int | float,
    *,
    whole: bool = False,
    several: bool = False,
    unit: str = "",
    metavar: str | None = None,
) -> Any:
    """An option that takes a number from `least` to `most`, an integer if `whole`, or one or more if `several`.

    `Options` refuses what is outside of the range.  unit: may follow the number as a word's end.
    metavar: shown by `--help` instead of the range.
    """
    kind, range_text = int if whole else float, f"{least:.10g}..{most:.10g}" + " ..." * several

    def read(words: list[str]) -> Any:
        try:
            values = tuple(kind(word.removesuffix(unit)) for word in words)
        except ValueError as error:
            raise ValueError(f"takes {range_text}, got {' '.join(words)[:MAX_VALUE_CHARACTERS]}") from error
        return values if several else values[0]

    def holds(value: Any) -> bool:
        kinds = Integral if whole else Real  # NumPy's too
        return not isinstance(value, bool) and isinstance(value, kinds) and least <= cast(float, value) <= most

    def fits(value: Any) -> bool:
        values = value if several else [value]
        return isinstance(values, (list, tuple)) and len(values) > 0 and all(map(holds, values))

    def words(value: Any) -> list[str]:
        return [str(v) for v in (value if several and value else [value])]

    return Numbers("*" if several else 1, metavar or range_text, read, fits, words, range_text=range_text)


@dataclass(frozen=True)
class Numbers(tyro.constructors.PrimitiveConstructorSpec[Any]):
    """How an option reads and checks numbers; range_text: for messages."""

    range_text: str = ""


UNSET: Any = tyro.conf.arg(help_behavior_hint="")  # an option that is absent unless given: its help shows no default


@dataclass(frozen=True)
class OneOf:
    """The names that an option takes: `others`, and those in the registry of a kind.  Beside them it takes objects."""

    others: tuple[str, ...] = ()
    kind: str | None = None

    def check(self, option: str, value: Any) -> None:
        """Refuse other names; raises UsageError."""
        names = [*self.others, *(names_of(self.kind) if self.kind else ())]
        for name in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(name, str) and name not in names:
                closest = did_you_mean(name, names) if self.kind else ""
                raise UsageError(option, not_one_of(name, names) + closest)


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of a verb.

    Raises:
        UsageError: a number is outside of its option's range, or a name is not known.
    """

    monitor: Annotated[Monitor, tyro.conf.Suppress] = SILENT
    """Receiver of messages and progress."""

    def __post_init__(self) -> None:
        for name, check in _checks(type(self)):
            value = getattr(self, name)
            if isinstance(check, OneOf):
                check.check(name, value)
            elif value is not None and not check.is_instance(value):
                got = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
                takes = check.range_text if isinstance(check, Numbers) else check.metavar
                raise UsageError(name, f"takes {takes}, got {got[:MAX_VALUE_CHARACTERS] or 'nothing'}")
        check_fields(self)

    @classmethod
    def of(cls: type[Chosen], given: Mapping[str, Any]) -> Chosen:
        """The options that a caller gave, checked by name, and the defaults."""
        names = [field.name for field in fields(cls)]
        for name in given.keys() - names:
            raise UsageError(name, f"is no option here{did_you_mean(name, names)}")
        return cls(**given)


@cache
def docs_of(options: type) -> dict[str, str]:
    """The docstring of each field of a dataclass, its bases' included, by the field's name."""
    found: dict[str, str] = {}
    for base in reversed(options.__mro__[:-1]):
        [tree] = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        body = cast(ast.ClassDef, tree).body
        for statement, after in pairwise(body):
            if isinstance(statement, ast.AnnAssign) and isinstance(after, ast.Expr):
                found[ast.unparse(statement.target)] = ast.literal_eval(after.value)
    return found


@cache
def _checks(options: type[Options]) -> list[tuple[str, Any]]:
    """The checks of values, each with its option's name."""
    hints = get_type_hints(options, include_extras=True).items()
    pairs = [(name, check) for name, hint in hints for check in getattr(hint, "__metadata__", ())]
    return [(name, c) for name, c in pairs if isinstance(c, OneOf | tyro.constructors.PrimitiveConstructorSpec)]


def documented(text: str | None, options: type[Options]) -> str:
    """A verb's docstring with its options, a line each."""
    lines = [f"    {name}: {doc}" for name, doc in docs_of(options).items()]
    return "\n".join([inspect.cleandoc(text or ""), "", "Options:", *lines])
