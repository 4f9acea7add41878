"""Calls of what plug-ins add: where one fails or breaks its interface, the error names it.

aaplug's own objects are called as they are.
"""

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache, partial
from pathlib import Path
from traceback import walk_tb
from types import NoneType
from typing import Any, TypeVar

from aaplug.system.contracts import WORDS, Term, described, terms_of
from aaplug.system.errors import AaplugError, PlugInError, UsageError, failure, is_lack_of_memory, place_in, top_package
from aaplug.system.registry import registry_of

OURS = "aaplug"
T = TypeVar("T")


def asked(kind: str, plug_in: Any, method: str, *given: Any) -> Any:
    """The answer of an object's method.

    Raises:
        PlugInError: a plug-in raises, changes what it is given, or answers with something else than its interface says.
    """
    ask = plug_in if method == "__call__" else getattr(plug_in, method)
    if package_of(ask) == OURS:
        return ask(*given)
    before = _versions(given)
    with blaming((kind, plug_in), file=next((each for each in given if isinstance(each, Path)), None), code=ask):
        answer = ask(*given)
    after, where = _versions(given), _label(kind, plug_in)
    if changed := [name for name in before if before[name] != after[name]]:
        raise PlugInError(where, f"changes its input: {', '.join(changed)}")
    term = _answer(kind, method)
    if term is not None and not term.holds(answer, {}):
        raise PlugInError(where, f"should return {term.words}, got {described(answer)}")
    return answer


def check_answer(where: str, answer: object, expected: type) -> None:
    """Raise PlugInError for an answer of another type."""
    if not isinstance(answer, expected):
        raise PlugInError(where, f"should return a {expected.__name__}, got {described(answer)}")


def filtered(kind: str, filter: Callable[..., T], thing: T, *given: Any) -> T:
    """A filter's result for a thing, of the same shapes and precision of columns; errors as those of `asked`.

    Raises:
        PlugInError: a plug-in's answer has other columns, or numbers that are NaN or infinite where they were not.
    """
    answer = asked(kind, filter, "__call__", thing, *given)
    if package_of(filter) == OURS:
        return answer
    where = _label(kind, filter)
    for name, before in vars(thing).items():
        after = getattr(answer, name)
        if not hasattr(before, "isfinite") or not hasattr(after, "isfinite"):
            continue
        expected, got = described(before), described(after)
        if got != expected:
            raise PlugInError(where, f"{name}: expected {expected}, as given, got {got}")
        if bad := int((before.isfinite() & ~after.isfinite()).sum()):
            problem = f"{name}: expected finite numbers, got {bad} of {after.numel()} that are NaN or infinite"
            raise PlugInError(where, problem)
    return answer


@contextmanager
def blaming(*parts: tuple[str, object], file: Path | None = None, code: object = None) -> Iterator[list[str]]:
    """Turn what fails inside the block, or ends the program, into an error that names the plug-in that it fails in.

    An error that a plug-in words itself stays, and so does one about a file.  Without plug-ins nothing is changed.
    Yields kind and name of each plug-in among the parts.

    parts: kind and object of all that the block calls, the innermost first.
    file: that it works on.  code: whose package the part is of, if not its object's.

    Raises:
        PlugInError: a plug-in fails.
    """
    theirs = {_label(*part): package for part in parts if (package := package_of(code or part[1])) != OURS}
    try:
        yield [*theirs]
    except (Exception, SystemExit) as error:
        if not theirs or is_lack_of_memory(error) or _is_worded(error, theirs.values()):
            raise
        places = {where: place_in(error, package) for where, package in theirs.items()}
        where = max(places, key=lambda each: places[each])
        if isinstance(error, UsageError) and error.where == where:
            raise
        on = "" if file is None else f" on {file}"
        raise PlugInError(where, f"fails{on} with {failure(error, theirs[where])}") from error


def _is_worded(error: BaseException, packages: Collection[str]) -> bool:
    """True if an error says all: it names a plug-in or a file, or is a plug-in's own words for the user.

    So does the end of a program that no plug-in's code asks for, but, say, a signal's handler.
    """
    if isinstance(error, PlugInError):
        return True
    *_, (last, _) = walk_tb(error.__traceback__)
    if isinstance(error, SystemExit):
        return top_package(last) not in packages
    return isinstance(error, AaplugError) and (type(error) is not UsageError or top_package(last) != OURS)


def package_of(value: Any) -> str:
    """The package whose code an object is: a function, a module, or an instance of a class."""
    while isinstance(value, partial):
        value = value.func
    return (getattr(value, "__module__", None) or getattr(value, "__name__", "")).partition(".")[0]


def _label(kind: str, plug_in: Any) -> str:
    """Kind and name of an object: its own, that of its registry, or that of its class."""
    name = getattr(plug_in, "name", None) or registry_of(kind).name_of(plug_in)
    return f"{kind} {name or getattr(plug_in, '__name__', type(plug_in).__name__)}"


@cache
def _answer(kind: str, method: str) -> Term | None:
    """The type that an interface's method returns; None if it does not say, or nothing or a truth value."""
    function = vars(registry_of(kind).type).get(method)
    term = terms_of(function).get("return") if callable(function) else None
    return None if term is None or term.words in (WORDS[NoneType], WORDS[bool]) else term


def _versions(given: tuple[Any, ...]) -> dict[str, int]:
    """How often each tensor of the arguments was written to, as torch counts it."""
    named = [
        pair
        for place, value in enumerate(given, 1)
        for pair in (vars(value).items() if is_dataclass(value) else [(f"argument {place}", value)])
    ]
    return {name: x._version for name, x in named if hasattr(x, "is_inference") and not x.is_inference()}
