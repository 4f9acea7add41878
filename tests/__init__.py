"""Tests, and how they check the types and shapes of what aaplug's functions take and return, by jaxtyping and beartype.

Checks took half of the time of all tests.  So functions inside functions are left out, whose checks would be compiled
at every call of the outer one, and each test checks the first `CHECKED_CALLS` of a function.

Tests run side by side, so they and the programs that they start have one thread, and threads that wait do not spin.
"""

import ast
import inspect
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial, wraps
from typing import Any, get_args

import jaxtyping

CHECKED_CALLS = 3

if "pytest" in sys.modules:  # benches measure without these; torch reads them when it is imported, after this
    os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
_test = 0


def check_again() -> None:
    """Check the calls of another test."""
    global _test
    _test += 1


def _has_shapes(hint: Any) -> bool:
    """True for arrays, whatever holds them, and for names, of which that is not known."""
    arrays = isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)
    return arrays or isinstance(hint, str) or any(map(_has_shapes, get_args(hint)))


def limited(jaxtyped: Callable[..., Any]) -> Callable[..., Any]:
    """jaxtyping's decorator, whose functions check their first calls in each test."""

    def decorate(function: Callable[..., Any] | None = None, *, typechecker: Callable[..., Any]) -> Any:
        if function is None:
            return partial(decorate, typechecker=typechecker)
        if not inspect.isfunction(function):
            return jaxtyped(function, typechecker=typechecker)
        checked, test, left = None, 0, 0

        @wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            nonlocal checked, test, left
            if test != _test:
                test, left = _test, CHECKED_CALLS
            if not left or jaxtyping.config.jaxtyping_disable:
                return function(*args, **options)
            left -= 1
            if checked is None:  # most functions are called by few tests
                shaped = any(map(_has_shapes, function.__annotations__.values()))
                generates = inspect.isgeneratorfunction(function)
                plain = not shaped and not generates  # beartype alone takes a 25th of the time
                checked = typechecker(function) if plain else jaxtyped(function, typechecker=typechecker)
            return checked(*args, **options)

        return call

    return decorate


def _leave_inner_functions_out() -> None:
    with suppress(ImportError):  # in a version without this name they are checked too
        from jaxtyping._import_hook import JaxtypingTransformer

        visit = JaxtypingTransformer.visit_FunctionDef

        def visit_outermost(self: JaxtypingTransformer, node: ast.FunctionDef) -> Any:
            inner = any(isinstance(parent, ast.FunctionDef) for parent in self._parents)
            return node if inner else visit(self, node)

        JaxtypingTransformer.visit_FunctionDef = visit_outermost


_leave_inner_functions_out()
jaxtyping.jaxtyped = jaxtyping._decorator.jaxtyped = limited(jaxtyping.jaxtyped)
