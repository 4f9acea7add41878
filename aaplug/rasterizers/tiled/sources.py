"""The code and constants that a kernel's package is compiled from, as text to hash.

Covered are the fields of the kernel and, from its function on, through globals, closures, defaults, partial arguments
and bound methods:

- the source of every function that covered code names, and of every method of a class that it names;
- the value of every number, string, tuple or other plain constant that covered code names;
- the methods and fields of an instance (a pixel kernel, rules) or module, whose names occur in covered code.

The example's sizes decide which loops use threads.  So the functions and constants that the example names are covered
too, but not the classes and instances.  Not covered are Python's and torch's own code, what a function imports when it
is called, and the values of tensors.
"""

import inspect
import sys
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from functools import cache, partial
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import torch

from aaplug.core.kernels import Kernel

OUTSIDE = sys.stdlib_module_names | {"torch", "numpy", "jaxtyping"}  # top-level packages that are not covered
PLAIN = (type(None), bool, int, float, complex, str, bytes, torch.dtype)
CALLED_BY_SIGNS = ("__call__", "__getitem__", "__iter__", "__len__")  # methods that code need not name


def sources_of(kernel: Kernel) -> str:
    """Return the text of all that the package of a kernel is made of."""
    fields = {name: value for name, value in vars(kernel).items() if name not in ("function", "example")}
    reached = [*_reached(kernel.function, classes=True), *_reached(kernel.example, classes=False)]
    return "\n".join([repr(fields), *sorted(reached)])  # code of each Python names what it uses in another order


def _reached(start: Any, classes: bool) -> Iterator[str]:
    """The texts of all functions and constants that `start` can reach; classes: also through classes and instances."""
    names = dict.fromkeys(CALLED_BY_SIGNS)  # attributes that code names
    holders: list[tuple[Any, set[str]]] = []  # modules and instances, and the names that were looked up there
    waiting, visited = deque([("", start)]), {}
    while waiting:
        where, value = waiting.popleft()
        value = value if isinstance(value, type) else inspect.unwrap(value)
        if isinstance(value, PLAIN):
            yield f"{where} = {value!r}"
        elif id(value) not in visited and _is_covered(value):
            visited[id(value)] = value  # held, so that no other gets its id
            if isinstance(value, FunctionType):
                yield _source(value.__code__)
                names |= dict.fromkeys(_names(value.__code__))
            if isinstance(value, FunctionType | MethodType | partial | Mapping | tuple | list):
                waiting += _parts(value)
            elif isinstance(value, type) and classes:
                yield f"{value.__qualname__} {[*getattr(value, '__annotations__', ())]}"
                waiting += _attributes(value, vars(value).keys())
                waiting += [("", base) for base in value.__bases__]
            elif isinstance(value, ModuleType | Kernel) or classes:
                holders.append((value, set()))
        if not waiting:
            for holder, looked_up in holders:
                waiting += _attributes(holder, names.keys() - looked_up)
                looked_up.update(names)


def _is_covered(value: Any) -> bool:
    if isinstance(value, MethodType | partial | Mapping | tuple | list):
        return True
    owner = value if isinstance(value, FunctionType | type) else type(value)
    module = value.__name__ if isinstance(value, ModuleType) else owner.__module__
    return module.partition(".")[0] not in OUTSIDE


def _parts(value: Any) -> list[tuple[Any, Any]]:
    """The values that a function or a container holds, with their names."""
    if isinstance(value, MethodType):
        return [("", value.__func__), ("self", value.__self__)]
    if isinstance(value, partial):
        return [("", value.func), *enumerate(value.args), *value.keywords.items()]
    if isinstance(value, Mapping):
        return [*value.items()]
    if not isinstance(value, FunctionType):
        return [*enumerate(value)]
    cells = zip(value.__code__.co_freevars, value.__closure__ or (), strict=True)
    scope = {name: value.__globals__[name] for name in _names(value.__code__) if name in value.__globals__}
    scope |= {name: cell.cell_contents for name, cell in cells}
    return [*scope.items(), ("defaults", (*(value.__defaults__ or ()), value.__kwdefaults__ or {}))]


def _attributes(holder: Any, names: Collection[str]) -> list[tuple[str, Any]]:
    """The methods and values that a class, an instance or a module has by these names."""
    attributes = []
    for name in sorted(names):
        value = inspect.getattr_static(holder, name, None)
        value = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
        if value is not None and (isinstance(value, FunctionType) or not name.startswith("__")):
            attributes.append((f"{getattr(holder, '__name__', type(holder).__name__)}.{name}", value))
    return attributes


@cache
def _names(code: CodeType) -> tuple[str, ...]:
    """Globals and attributes that code names, in functions inside it too."""
    inner = (_names(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return tuple(dict.fromkeys([*code.co_names, *(name for names in inner for name in names)]))


@cache
def _source(code: CodeType) -> str:
    """The source of a function; empty for one that a dataclass made."""
    return "" if code.co_filename.startswith("<") else inspect.getsource(code)
