"""Registries: what can be chosen by name, from here and from installed plug-ins.

A package adds an entry by an entry point in the group "aaplug.<kind>", for example in its pyproject.toml:

    [project.entry-points."aaplug.screen_filters"]
    sharp = "their_package.sharp:SHARP"

The entry's name is the name in the registry.  An object with a `name` of its own must agree with it.
"""

from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from aaplug.core.errors import UsageError, listing

T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Named objects of one kind; plug-ins are loaded when the registry is first read.

    kind: in words, singular ("screen filter"); its plural with underscores ends the entry point group's name.
    """

    def __init__(self, kind: str, own: Mapping[str, T], check: Callable[[T], bool] = lambda value: True):
        """own: the entries of aaplug.  check: whether an object is of this kind."""
        self.kind, self._entries, self._check = kind, dict(own), check
        self._loaded = False

    def __getitem__(self, name: str) -> T:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def find(self, name: str, parameter: str | None = None) -> T:
        """An entry by name.

        Raises:
            UsageError: there is none; the error names `parameter`, or else the kind.
        """
        entries = self._all()
        if name not in entries:
            known = listing(list(entries), most=len(entries))
            raise UsageError(parameter or self.kind, f"'{name}' is not one of {known}")
        return entries[name]

    def register(self, name: str, value: T) -> None:
        """Add an entry from Python, for this process.

        Raises:
            UsageError: the name is taken, or the object is not of this kind.
        """
        self._all()
        self._add(name, value, f"{self.kind} {name}")

    @property
    def group(self) -> str:
        """Name of the entry point group."""
        return f"aaplug.{self.kind.replace(' ', '_')}s"

    def _all(self) -> dict[str, T]:
        if not self._loaded:
            self._loaded = True
            for point in entry_points(group=self.group):
                where = f"plug-in {point.value} ({self.group})"
                self._add(point.name, _load(point, where), where)
        return self._entries

    def _add(self, name: str, value: T, where: str) -> None:
        if name in self._entries:
            raise UsageError(where, f"a {self.kind} named '{name}' exists already")
        if not self._check(value):
            raise UsageError(where, f"is not a {self.kind}: {type(value).__name__} lacks its methods")
        own = getattr(value, "name", name)
        if own != name:
            raise UsageError(where, f"is registered as '{name}' but calls itself '{own}'")
        self._entries[name] = value


def _load(point: EntryPoint, where: str) -> Any:
    try:
        return point.load()
    except Exception as error:  # a plug-in can fail in any way
        raise UsageError(where, f"cannot be imported: {error}") from error
