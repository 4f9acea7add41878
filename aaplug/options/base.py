"""What options are made of: how values are read from words, checked, and shown by `--help`."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral, Real
from typing import Any, TypeVar, cast, get_type_hints

import tyro

from aaplug.core.errors import SHOWN, UsageError, did_you_mean, not_one_of
from aaplug.core.registry import names_of, unknown

Chosen = TypeVar("Chosen", bound="Options")
Verb = TypeVar("Verb", bound=Callable[..., Any])


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


def number(least: int | float, most: int | float, *, whole: bool = False, several: bool = False, unit: str = "") -> Any:
    """An option that takes a number from `least` to `most`, an integer if `whole`, or one or more if `several`.

    `--help` shows the range, and `Options` refuses what is outside of it.  unit: may follow the number as a word's end.
    """
    kind, shown = int if whole else float, f"{least:.10g}..{most:.10g}" + " ..." * several

    def read(words: list[str]) -> Any:
        try:
            values = tuple(kind(word.removesuffix(unit)) for word in words)
        except ValueError as error:
            raise ValueError(f"takes {shown}, got {' '.join(words)[:SHOWN]}") from error
        return values if several else values[0]

    def holds(value: Any) -> bool:
        kinds = Integral if whole else Real  # NumPy's too
        return not isinstance(value, bool) and isinstance(value, kinds) and least <= cast(float, value) <= most

    def fits(value: Any) -> bool:
        values = value if several else [value]
        return isinstance(values, (list, tuple)) and len(values) > 0 and all(map(holds, values))

    return tyro.constructors.PrimitiveConstructorSpec(
        "*" if several else 1,
        shown,
        read,
        fits,
        lambda value: [str(v) for v in (value if several and value else [value])],
    )


UNSET: Any = tyro.conf.arg(help_behavior_hint="")  # an option that is absent unless given: its help shows no default


@dataclass(frozen=True)
class OneOf:
    """The names that an option takes: `others`, and those in the registry of a kind.  Beside them it takes objects."""

    others: tuple[str, ...] = ()
    kind: str | None = None

    def check(self, option: str, value: Any) -> None:
        """Refuse other names; raises UsageError."""
        known = [*self.others, *(names_of(self.kind) if self.kind else ())]
        for name in value if isinstance(value, (list, tuple)) else [value]:
            if isinstance(name, str) and name not in known:
                raise UsageError(option, unknown(name, known) if self.kind else not_one_of(name, known))


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of a verb.

    Raises:
        UsageError: a number is outside of its option's range, or a name is not known.
    """

    def __post_init__(self) -> None:
        for name, check in _checks(type(self)):
            value = getattr(self, name)
            if isinstance(check, OneOf):
                check.check(name, value)
            elif value is not None and not check.is_instance(value):
                got = ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
                raise UsageError(name, f"takes {check.metavar}, got {got[:SHOWN] or 'nothing'}")

    @classmethod
    def of(cls: type[Chosen], given: Mapping[str, Any]) -> Chosen:
        """The options that a caller gave, checked by name, and the defaults."""
        known = [field.name for field in fields(cls)]
        for name in given.keys() - known:
            raise UsageError(name, f"is no option here{did_you_mean(name, known)}")
        return cls(**given)

    @classmethod
    def shown(cls, verb: Verb) -> Verb:
        """Decorate a verb: its signature shows these options instead of `**options`."""
        signature = inspect.signature(verb)
        own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
        options = inspect.signature(cls).parameters.values()
        vars(verb)["__signature__"] = signature.replace(parameters=[*own, *options])
        return verb


@cache
def _checks(options: type[Options]) -> list[tuple[str, Any]]:
    """How values of options are checked, by the option's name."""
    hints = get_type_hints(options, include_extras=True).items()
    found = [(name, check) for name, hint in hints for check in getattr(hint, "__metadata__", ())]
    return [(name, c) for name, c in found if isinstance(c, OneOf | tyro.constructors.PrimitiveConstructorSpec)]
