"""Registries: what can be chosen by name, from aaplug and from installed plug-ins.

A package adds an entry by an entry point in the group "aaplug.<kind>s", for example in its pyproject.toml:

    [project.entry-points."aaplug.screen_filters"]
    sharp = "their_package.sharp:SHARP"

The entry's name is the name in the registry.  An object with a `name` of its own must agree with it.  A plug-in that
cannot be used is left out with a warning, so that it does not stop everything else.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from aaplug.core.choices import NAMES
from aaplug.core.errors import UsageError, closest, did_you_mean, not_one_of

KINDS = (  # each is a registry and, with underscores and an s, an entry point group
    *("world filter", "screen filter", "selection", "pixel kernel", "compositor", "recipe", "viewer", "form"),
    *("rasterizer", "metric", "protocol", "method", "scene format", "camera format"),
)
PREFIX = "aaplug."

_registered: dict[str, list[str]] = {kind: [] for kind in KINDS}  # names added from Python

log = logging.getLogger("aaplug")
T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Named objects of one kind; plug-ins are loaded when the registry is first read.

    kind: one of `KINDS`.
    """

    def __init__(self, kind: str, own: Mapping[str, T], check: type | Callable[[T], bool] = object):
        """own: the entries of aaplug, by name.  check: the type of such objects, or a test of them."""
        assert kind in KINDS, kind
        self.kind, self._entries = kind, dict(own)
        self._fits = (lambda value: isinstance(value, check)) if isinstance(check, type) else check
        self._loaded = False
        assert kind not in NAMES or NAMES[kind] == tuple(own), f"choices.NAMES has other names of a {kind}"

    def __getitem__(self, name: str) -> T:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def find(self, name: str, parameter: str | None = None) -> T:
        """An entry by name.

        Raises:
            UsageError: there is none; the error names `parameter`, or else the kind, and the closest names.
        """
        entries = self._all()
        if name not in entries:
            raise UsageError(parameter or self.kind, unknown(name, entries))
        return entries[name]

    def register(self, name: str, value: T) -> None:
        """Add an entry from Python, for this process.

        Raises:
            UsageError: the name is taken, or the object is not of this kind.
        """
        self._all()
        self._add(name, value, f"{self.kind} {name}")
        _registered[self.kind].append(name)

    def _all(self) -> dict[str, T]:
        if not self._loaded:
            self._loaded = True
            _warn_of_unknown_groups()
            group = group_of(self.kind)
            for point in _points().select(group=group):
                package = f" of package {point.dist.name}" if point.dist else ""
                where = f"plug-in {point.value}{package} ({group})"
                try:
                    self._add(point.name, _load(point, where), where)
                except UsageError as error:
                    log.warning("%s; it is left out", error)
        return self._entries

    def _add(self, name: str, value: T, where: str) -> None:
        if name in self._entries:
            raise UsageError(where, f"a {self.kind} named '{name}' exists already")
        if isinstance(value, type) or not self._fits(value):
            found = f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__}"
            raise UsageError(where, f"is {found}, which is not a {self.kind}; see examples/guides/contributing.md")
        own = getattr(value, "name", name)
        if own != name:
            raise UsageError(where, f"is registered as '{name}' but calls itself '{own}'")
        self._entries[name] = value


def named(objects: Iterable[T]) -> dict[str, T]:
    """Objects by their `name`."""
    return {getattr(value, "name"): value for value in objects}  # noqa: B009


def names_of(kind: str) -> list[str]:
    """Names of a kind in `choices.NAMES`, and plug-ins', also of such as cannot be used: nothing is imported."""
    points = _points().select(group=group_of(kind))
    return list(dict.fromkeys([*NAMES[kind], *(point.name for point in points), *_registered[kind]]))


def unknown(name: str, known: Collection[str]) -> str:
    """Message for a name that is none of the known ones, with the closest of them."""
    close = closest(name, known)
    return not_one_of(name, known) + (f" (did you mean '{close}'?)" if close else "")


def group_of(kind: str) -> str:
    """Name of the entry point group of a kind."""
    return f"{PREFIX}{kind.replace(' ', '_')}s"


def _warn_of_unknown_groups() -> None:
    known = set(map(group_of, KINDS))
    for group in sorted(_points().groups):
        if group.startswith(PREFIX) and group not in known:
            log.warning("entry point group %s is not known%s", group, did_you_mean(group, known))


@cache
def _points() -> Any:
    """Of all installed packages; reading them takes milliseconds, and no plug-in comes while a process runs."""
    return entry_points()


def _load(point: EntryPoint, where: str) -> Any:
    try:
        return point.load()
    except Exception as error:  # a plug-in can fail in any way
        raise UsageError(where, f"cannot be imported: {error}") from error
