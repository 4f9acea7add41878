"""Registries of everything that is chosen by name, from aaplug and from installed plug-ins.

A package adds an entry by an entry point in the group of its kind (examples/guides/contributing.md).  The entry's name
is the name in the registry.  An object with a `name` of its own must agree with it.  A plug-in that cannot be used is
left out with a warning, so that it does not stop everything else.  An entry is imported when it is first used, so that
names can be listed without importing anything.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pkgutil import resolve_name
from threading import get_ident
from typing import Any, TypeVar

from aaplug.system.contracts import contract, described
from aaplug.system.errors import UsageError, did_you_mean, failure, not_one_of, one

PREFIX = "aaplug."
REGISTRIES = {  # place of each kind's registry; a kind's plural, with underscores, is an entry point group
    "world filter": "aaplug.methods:WORLD_FILTERS",
    "screen filter": "aaplug.methods:SCREEN_FILTERS",
    "selection": "aaplug.methods:SELECTIONS",
    "pixel kernel": "aaplug.methods:PIXEL_KERNELS",
    "compositor": "aaplug.methods:COMPOSITORS",
    "recipe": "aaplug.methods:RECIPES",
    "viewer": "aaplug.methods.viewers:VIEWERS",
    "rasterizer": "aaplug.rasterizers:RASTERIZERS",
    "metric": "aaplug.evaluation:METRICS",
    "protocol": "aaplug.evaluation:PROTOCOLS",
    "method": "aaplug.finetuning:METHODS",
    "loss": "aaplug.finetuning:LOSSES",
    "scene format": "aaplug.io.scenes:SCENE_FORMATS",
    "camera format": "aaplug.io.cameras:CAMERA_FORMATS",
}

log = logging.getLogger("aaplug")
T = TypeVar("T")


class NoEntryError(UsageError, KeyError):
    """A name that a registry does not have: an error of a user, and of a mapping."""

    __str__ = Exception.__str__


class Registry(Mapping[str, T]):
    """Named objects of one kind.

    kind: one of `REGISTRIES`.
    """

    def __init__(self, kind: str, type_at: str, own: Mapping[str, T | str]):
        """type_at: place of the entries' type, as "module:name".  own: aaplug's entries, or their places."""
        assert kind in REGISTRIES, kind
        self.kind, self._type_at = kind, type_at
        self._built_in: dict[str, T | str] = dict(own)
        self._entries: dict[str, T] = {}  # loaded
        self._left_out: dict[EntryPoint, str] = {}
        self._plug_ins_loaded = False
        self._loading = set[int]()  # threads that load plug-ins; no lock, as an import that waits for it would not end

    @property
    def names(self) -> list[str]:
        """All names, also of plug-ins that cannot be used; nothing is imported."""
        return list(dict.fromkeys([*self._built_in, *(p.name for p in _points_of(self.kind)), *self._entries]))

    @property
    def type(self) -> Any:
        """The type of the entries."""
        return resolve_name(self._type_at)

    def __getitem__(self, name: Any) -> T:
        if not isinstance(name, str):
            raise NoEntryError(self.kind, f"expected a name, got {described(name)}")
        if name not in self._entries:
            if name not in self._built_in:
                self._load_plug_ins()
            else:
                value: Any = self._built_in[name]
                self._add(name, resolve_name(value) if isinstance(value, str) else value, f"{self.kind} {name}")
        if name not in self._entries:
            raise NoEntryError(self.kind, not_one_of(name, self, "; if a package adds it, is that installed?"))
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        self._load_plug_ins()
        return iter(dict.fromkeys([*self._built_in, *self._entries]))

    def __len__(self) -> int:
        return len(list(iter(self)))

    @property
    def left_out(self) -> Mapping[EntryPoint, str]:
        """The plug-ins that cannot be used, and why."""
        self._load_plug_ins()
        return self._left_out

    def __repr__(self) -> str:
        return f"Registry({self.kind}: {', '.join(self.names)})"

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        """A registry is its process's own; a copy is that of the process that makes it."""
        return resolve_name, (REGISTRIES[self.kind],)

    def name_of(self, value: object) -> str | None:
        """The name of an entry that is in use; None if there is no such entry."""
        return next((name for name, entry in self._entries.items() if entry is value), None)

    @contract
    def find(self, name: str, parameter: str | None = None) -> T:
        """An entry by name.

        Raises:
            UsageError: there is none; the error names `parameter`, or else the kind, and the closest names.
        """
        try:
            return self[name]
        except NoEntryError as error:
            raise UsageError(parameter or self.kind, error.problem) from None

    @contract
    def register(self, name: str, value: T) -> None:
        """Add an entry from Python, for this process.

        Raises:
            UsageError: the name is taken, or the object is not of this kind.
        """
        self._load_plug_ins()
        where = f"{self.kind} {name}"
        self._check_new(name, self._entries, where)
        self._add(name, value, where)

    def _check_new(self, name: str, entries: Iterable[str], where: str) -> None:
        """Raise UsageError if aaplug has an entry of that name, or these do; case and spaces tell none apart."""
        for known in (*self._built_in, *entries):
            if spelt(known) == spelt(name):
                raise UsageError(where, f"{one(self.kind)} named '{known}' exists already")

    def _load_plug_ins(self) -> None:
        thread = get_ident()
        if self._plug_ins_loaded or thread in self._loading:
            return
        self._loading.add(thread)
        try:
            self._load_points()
        finally:
            self._loading.discard(thread)
        self._plug_ins_loaded = True

    def _load_points(self) -> None:
        _warn_of_unknown_groups()
        for point in _points_of(self.kind):
            package = f" of package {point.dist.name}" if point.dist else ""
            where = f"plug-in {point.value}{package} ({point.group})"
            try:
                if point.dist and point.dist.name == "aaplug" and find_spec(point.module.rpartition(".")[0]) is None:
                    continue  # the folder for comparisons may be deleted
                self._check_new(point.name, self._entries.keys() - {point.name}, where)
                try:
                    value = point.load()
                except (Exception, SystemExit) as error:  # a plug-in can fail in any way
                    raise UsageError(where, f"cannot be imported: {of_import(error, point.module)}") from error
                self._add(point.name, value, where)
            except UsageError as error:
                self._left_out[point] = error.problem
                log.warning("%s; it is left out", error)

    def _add(self, name: str, value: T, where: str) -> None:
        if self._entries.get(name, value) is not value:  # it is itself where another thread was first
            raise UsageError(where, f"{one(self.kind)} named '{name}' exists already")
        if isinstance(value, type) or not isinstance(value, self.type):
            noun = f"the class {value.__name__}" if isinstance(value, type) else one(type(value).__name__)
            lacking = [] if isinstance(value, type) else [m for m in _members(self.type) if not hasattr(value, m)]
            lacks = f" as it lacks {', '.join(lacking)}" if lacking else ""
            raise UsageError(where, f"is {noun}, which is not a {self.kind}{lacks}; see `aaplug guide contributing`")
        name_inside = getattr(value, "name", name)
        if name_inside != name:
            raise UsageError(where, f"is registered as '{name}' but calls itself '{name_inside}'")
        self._entries[name] = value


def spelt(name: str) -> str:
    """A name as an option's value: in any case, with "-" for a space."""
    return name.casefold().replace(" ", "-")


def _members(interface: Any) -> list[str]:
    """Names of what an object of a kind has; none if objects are told by their class."""
    if not getattr(interface, "_is_protocol", False):
        return []
    return [name for name in vars(interface) if name == "__call__" or not name.startswith("_")]


def of_import(error: BaseException, module: str) -> str:
    """Why a module cannot be imported."""
    return str(error) if isinstance(error, ImportError | SyntaxError) else failure(error, module.partition(".")[0])


def named(objects: Iterable[T]) -> dict[str, T]:
    """Objects by their `name`."""
    return {getattr(value, "name"): value for value in objects}  # noqa: B009


def names_of(kind: str, comparisons: bool = True) -> list[str]:
    """Names in the registry of a kind; nothing that takes long is imported.

    comparisons: also those that aaplug adds by entry points, which are there for comparison.
    """
    names = registry_of(kind).names
    if comparisons:
        return names
    ours = {p.name for p in _points_of(kind) if p.module.startswith("aaplug.")}
    return [name for name in names if name not in ours]


def registry_of(kind: str) -> Any:  # a run-time check of a registry would load its entries
    """The registry of a kind."""
    return resolve_name(REGISTRIES[kind])


def group_of(kind: str) -> str:
    """Name of the entry point group of a kind."""
    return f"{PREFIX}{kind.replace(' ', '_')}{'es' if kind.endswith('s') else 's'}"


@cache
def _points_of(kind: str) -> tuple[EntryPoint, ...]:
    return tuple(_points().select(group=group_of(kind)))


@cache
def _warn_of_unknown_groups() -> None:
    """Tell of entry point groups that look like ours, once."""
    for problem in dict.fromkeys(of_unknown_groups().values()):
        log.warning("entry point %s", problem)


def of_unknown_groups() -> dict[EntryPoint, str]:
    """Entry points of groups that look like ours, and why nothing reads them."""
    known = set(map(group_of, REGISTRIES))
    unknown = [group for group in sorted(_points().groups) if group.startswith(PREFIX) and group not in known]
    problems = {group: f"group {group} is not known{did_you_mean(group, known)}" for group in unknown}
    return {point: problem for group, problem in problems.items() for point in _points().select(group=group)}


@cache
def _points() -> Any:
    """Entry points of all installed packages; reading them takes milliseconds, and none comes while a process runs."""
    return entry_points()
