"""Contracts: a signature says what a function takes, and every argument is held to its type hint.

`contract` decorates a public function or method; `check_fields` is called where a public dataclass is made.  A value
that does not fit is a UsageError that names the argument, what is expected and what was given.  A hint may be a class,
a protocol, a union, a literal, a container, a shape of jaxtyping, or `Annotated` with a `Range` or a `LazyType`.  The
name of a dimension means one size in the whole call.  A number is never NaN.  A tensor lies in memory, dense, and its
floating point is float32 or float64.
"""

import inspect
import math
import os
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from functools import cache, wraps
from importlib import import_module
from numbers import Integral, Real
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

from aaplug.system.errors import MAX_VALUE_CHARACTERS, UsageError, one

F = TypeVar("F", bound=Callable[..., Any])
Sizes = dict[Any, Any]  # of the dimensions that a call has named so far

ANY_SIZE = ("_", "...")  # names of dimensions
FLOATS = ("float32", "float64")  # kernels take no other floating point
WORDS = {
    str: "a text",
    bool: "True or False",
    NoneType: "None",
    os.PathLike: "a path",
    float: "a number",
    int: "an integer",
}
SHOWN_TYPES = (str, bytes, bool, int, float, NoneType, list, tuple, dict)  # a message shows their values


@dataclass(frozen=True)
class Range:
    """The numbers that an argument takes.  above: a bound that is left out itself."""

    least: float | int = -math.inf
    most: float | int = math.inf
    above: float | int = -math.inf

    def __contains__(self, value: Any) -> bool:
        return self.above < value and self.least <= value <= self.most

    def __str__(self) -> str:
        low = f"above {self.above:g}" if self.above > -math.inf else f"from {self.least:g}"
        return low if self.most == math.inf else f"{low} to {self.most:g}"


@dataclass(frozen=True)
class LazyType:
    """The type at "module:name", which is imported when a value is held to it."""

    place: str

    def __contains__(self, value: Any) -> bool:
        if value is None or isinstance(value, type | str):  # no reason to import anything
            return False
        return isinstance(value, resolve_name(self.place))

    def __str__(self) -> str:
        return self.place.partition(":")[2]


class Term(NamedTuple):
    """The values that a hint allows: a test of them, and words for a message."""

    holds: Callable[[Any, Sizes], bool]
    words: str


ANYTHING = Term(lambda value, sizes: True, "anything")


def contract(function: F) -> F:
    """The same function in memory and full precision; raises UsageError for an argument that does not fit its hint."""
    names = tuple(inspect.signature(function).parameters)
    terms = dict[str, Term]()  # filled when it is called first: a hint may name a class that stands below

    @wraps(function)
    def checked(*args: Any, **keywords: Any) -> Any:
        if not terms:
            terms.update(terms_of(function))
        sizes: Sizes = {}
        for name, value in (*zip(names, args, strict=False), *keywords.items()):
            if name in terms and not terms[name].holds(value, sizes):
                refuse(name, value, terms[name], sizes)
        with in_memory(), in_full_precision():
            return function(*args, **keywords)

    return checked  # pyright: ignore[reportReturnType]


def in_memory() -> AbstractContextManager[Any]:
    """A block in which new tensors lie in memory, whatever device the program has made the default one."""
    torch = sys.modules.get("torch")
    made = getattr(torch, "empty", None)  # another thread may be importing it
    return nullcontext() if torch is None or made is None or made(0).is_cpu else torch.device("cpu")


def in_full_precision() -> AbstractContextManager[Any]:
    """A block without the program's `torch.autocast`: bfloat16 has too few digits to place a splat."""
    torch = sys.modules.get("torch")
    asked = getattr(torch, "is_autocast_enabled", None)
    return nullcontext() if torch is None or asked is None or not asked("cpu") else torch.autocast("cpu", enabled=False)


def check_fields(noun: Any) -> None:
    """Raise UsageError for a dataclass with a field that does not fit its hint."""
    sizes: Sizes = {}
    values = vars(noun)
    for name, term in _terms_of_fields(type(noun)):
        if not term[0](values[name], sizes):
            refuse(name, values[name], term, sizes)


def refuse(name: str, value: Any, term: Term, sizes: Sizes) -> NoReturn:
    """Raise UsageError for a value that does not fit its term."""
    shape = term.words.partition("[")[2].partition("]")[0]
    known = {dim: size if isinstance(size, int) else [*size] for dim, size in sizes.items() if size != ()}
    said = [f", {dim} = {size}" for dim, size in known.items() if dim in shape]
    raise UsageError(name, f"expected {term.words}, got {described(value)}{''.join(said)}")


def terms_of(owner: Any) -> dict[str, Term]:
    """The terms of a function's parameters, or of a class's fields, by name."""
    return {name: _term(hint) for name, hint in get_type_hints(owner, include_extras=True).items()}


@cache
def _terms_of_fields(noun: type) -> list[tuple[str, Term]]:
    terms = terms_of(noun)
    return [(field.name, terms[field.name]) for field in fields(noun) if field.init]


def described(value: Any) -> str:
    """A refused value in words."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        where = "" if str(getattr(value, "device", "cpu")) == "cpu" else f" on {value.device}"
        kind = "" if str(value.dtype).startswith("torch.") else f"{type(value).__module__}'s "
        if (layout := str(getattr(value, "layout", "torch.strided"))) != "torch.strided":
            kind = f"{layout.removeprefix('torch.')} "
        return f"{kind}{str(value.dtype).removeprefix('torch.')} {list(value.shape)}{where}"
    if isinstance(value, list | tuple) and not all(isinstance(item, SHOWN_TYPES) for item in value):
        return f"{one(type(value).__name__)} of {', '.join(dict.fromkeys(map(described, value)))}"
    if isinstance(value, SHOWN_TYPES):
        text = repr(value)
        return text if len(text) <= MAX_VALUE_CHARACTERS else f"{text[:MAX_VALUE_CHARACTERS]}..."
    return f"the class {value.__name__}" if isinstance(value, type) else one(type(value).__name__)


def _term(hint: Any) -> Term:
    origin, args = get_origin(hint), get_args(hint)
    if hasattr(hint, "array_type"):
        return _tensor_term(hint)
    if origin is Annotated:
        inner, extras = _term(args[0]), [extra for extra in args[1:] if isinstance(extra, Range | LazyType)]
        words = " ".join([inner.words] * (args[0] is not Any) + [str(extra) for extra in extras])
        return Term(lambda value, sizes: inner.holds(value, sizes) and all(value in extra for extra in extras), words)
    if origin in (Union, UnionType):
        terms = [_term(arg) for arg in args]
        words = " or ".join(term.words for term in terms)
        return Term(lambda value, sizes: any(term.holds(value, sizes) for term in terms), words)
    if origin is Literal:
        words = " or ".join(map(repr, args))
        return Term(lambda value, _: any(type(value) is type(arg) and value == arg for arg in args), words)
    if hint in (float, int):
        kind: Any = Real if hint is float else Integral  # NumPy's too
        most = 2.0**63 if hint is float else math.inf  # torch takes no larger integer for a number
        return Term(
            lambda value, _: (
                isinstance(value, kind)
                and not isinstance(value, bool)
                and value == value
                and (abs(value) < most or not isinstance(value, Integral))
            ),
            WORDS[hint],
        )
    if origin in (tuple, list, Sequence, Collection, Mapping, dict):
        return _container_term(origin, args)
    kind = hint if origin is None else origin
    if kind is Callable:
        return Term(lambda value, _: callable(value), "a function")
    if not isinstance(kind, type) or kind in (Any, object, type):
        return ANYTHING
    words = WORDS.get(kind, one(kind.__name__))
    return Term(lambda value, _: isinstance(value, kind) and not isinstance(value, type), words)


def _container_term(kind: Any, args: tuple[Any, ...]) -> Term:
    items = [_term(arg) for arg in args if arg is not ...]
    if kind is tuple and ... not in args:
        return Term(
            lambda value, sizes: (
                isinstance(value, (tuple, list))
                and len(value) == len(items)
                and all(item.holds(one, sizes) for item, one in zip(items, value, strict=True))
            ),
            f"({', '.join(item.words for item in items)})",
        )
    if kind in (Mapping, dict):
        key, item = items
        return Term(
            lambda value, sizes: (
                isinstance(value, Mapping) and all(key.holds(k, {}) and item.holds(v, sizes) for k, v in value.items())
            ),
            f"a mapping from {key.words} to {item.words}",
        )
    kind = (tuple, list) if kind is tuple else kind
    [item] = items
    return Term(
        lambda value, _: (
            isinstance(value, kind) and not isinstance(value, (str, bytes)) and all(item.holds(x, {}) for x in value)
        ),
        f"a sequence, each {item.words}",
    )


def _tensor_term(hint: Any) -> Term:
    """A dense tensor of the precisions and the shape of a jaxtyping hint."""
    torch = import_module(hint.array_type.__module__)  # options take no torch
    dims = [int(dim) if dim.isdigit() else dim for dim in hint.dim_str.split()]
    kinds = () if not isinstance(hint.dtypes, tuple) else [n for n in hint.dtypes if "float" not in n or n in FLOATS]
    dtypes = {getattr(torch, name) for name in kinds if hasattr(torch, name)}
    free = next((i for i, dim in enumerate(dims) if str(dim).startswith(("*", "..."))), None)  # any number of sizes

    def holds(value: Any, sizes: Sizes) -> bool:
        if not isinstance(value, torch.Tensor) or value.is_meta or value.layout is not torch.strided:
            return False
        shape = value.shape
        if free is not None and len(shape) >= len(dims) - 1:
            after = len(shape) - (len(dims) - free - 1)
            shape = (*shape[:free], shape[free:after], *shape[after:])
        if len(shape) != len(dims) or (dtypes and value.dtype not in dtypes):
            return False
        for dim, size in zip(dims, shape, strict=True):
            if dim != size and (dim.__class__ is int or (dim not in ANY_SIZE and sizes.setdefault(dim, size) != size)):
                return False
        return True

    kind = {"Float": " or ".join(FLOATS), "Int": "integers", "Bool": "booleans"}
    numbers = kind.get(hint.__name__.partition("[")[0], "numbers")
    return Term(holds, f"a tensor [{', '.join(map(str, dims))}] of {numbers}")
