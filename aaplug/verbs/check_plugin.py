"""Laws run on what a package adds."""

import inspect
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, NamedTuple

from torch.autograd.gradcheck import GradcheckError

from aaplug.evaluation.laws import LAWS
from aaplug.system.contracts import contract
from aaplug.system.errors import UsageError, failure
from aaplug.system.monitor import SILENT, Monitor
from aaplug.system.registry import REGISTRIES, group_of, of_import, of_unknown_groups, registry_of

MAX_PROBLEM = 300  # characters of a broken law's message


class Verdict(NamedTuple):
    """An object and a law of its kind.  problem: how the law is broken; "" if it holds."""

    kind: str
    name: str
    law: str
    problem: str


@contract
def check_plugin(module: str, *, monitor: Monitor = SILENT) -> list[Verdict]:
    """Run the laws of its kind on each object of a module, and on each that its package's entry points name.

    An entry point whose object is left out, as its name is taken for example, is a broken law.

    Raises:
        UsageError: the module cannot be imported, or there is nothing with laws in it.
    """
    package = module.partition(".")[0]
    left_out = {kind: registry_of(kind).left_out for kind in REGISTRIES} | {"entry point": of_unknown_groups()}
    verdicts = [
        Verdict(kind, point.name, "Its entry point registers it.", problem)
        for kind, points in left_out.items()
        for point, problem in points.items()
        if point.module.partition(".")[0] == package
    ]
    objects = list(_objects(module))
    if not objects and not verdicts:
        problem = f"holds no object that has laws; these are for each {', '.join(LAWS)}"
        raise UsageError(f"module {module}", f"{problem}, with all parts of its interface, and for no class")
    tries = [(kind, name, value, law) for kind, name, value in objects for law in LAWS[kind]]
    with monitor.progress("checking", "laws") as tell:
        for done, (kind, name, value, law) in enumerate(tries, 1):
            problem = ""
            try:
                law(value)
            except (AssertionError, GradcheckError) as error:
                problem = " ".join(str(error).split())[:MAX_PROBLEM] or failure(error, package)
            except Exception as error:  # a plug-in can fail in any way
                problem = failure(error, package)
            verdicts.append(Verdict(kind, name, (law.__doc__ or "").splitlines()[0], problem))
            tell(done, len(tries))
    return verdicts


def _objects(module: str) -> Iterator[tuple[str, str, Any]]:
    """Kind, name and value of all that has laws: what entry points of the package name, then the rest of the module.

    Losses are only those that entry points name.
    """
    package = module.partition(".")[0]
    names: set[tuple[str, int]] = set()
    for kind in LAWS:
        left_out = registry_of(kind).left_out
        for point in entry_points(group=group_of(kind)):
            if point.module.partition(".")[0] == package and point not in left_out:
                value = point.load()
                names.add((kind, id(value)))
                yield kind, point.name, value
    try:
        imported = import_module(module)
    except (Exception, SystemExit) as error:  # a plug-in can fail in any way
        missing = isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}.")
        hint = "; give the name that `import` takes, not that of the installed package" if missing else ""
        raise UsageError(f"module {module}", f"cannot be imported: {of_import(error, module)}{hint}") from error
    for name, value in vars(imported).items():
        for kind in filter("loss".__ne__, LAWS):  # functions of metrics take the same
            if not name.startswith("_") and _is_new(kind, value) and (kind, id(value)) not in names:
                names.add((kind, id(value)))
                yield kind, getattr(value, "name", name), value


def _is_new(kind: str, value: Any) -> bool:
    """True for an object of a kind that is not registered; callables are told apart by the names of their arguments."""
    registry = registry_of(kind)
    if isinstance(value, type) or not isinstance(value, registry.type) or any(v is value for v in registry.values()):
        return False
    if (call := vars(registry.type).get("__call__")) is None:
        return True
    wanted = list(inspect.signature(call).parameters)[1:]
    with suppress(ValueError):  # aliases of types and some functions of C tell no arguments
        return list(inspect.signature(value).parameters)[: len(wanted)] == wanted
    return False
