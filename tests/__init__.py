"""Tests, and how they check the types and shapes of what aaplug's functions take and return, by jaxtyping and beartype.

Checks took half of the time of all tests.  So those of functions inside functions are left out, which would be compiled
at every call of the outer one, and of each test the first `MOST_CHECKS` are made.
"""

import ast
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import Any

import jaxtyping

MOST_CHECKS = 5000  # of a test: twice as many as calls

_left = MOST_CHECKS


def check_again() -> None:
    """Make the checks of another test."""
    global _left
    _left = MOST_CHECKS
    jaxtyping.config.update("jaxtyping_disable", False)


def with_checks(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its checks."""
    from beartype import beartype

    check = beartype(function)

    @wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        global _left
        _left -= 1
        if not _left:
            jaxtyping.config.update("jaxtyping_disable", True)
        return check(*args, **options)

    return call


def _leave_inner_functions_out() -> None:
    with suppress(ImportError):  # in a version without this name they are checked too
        from jaxtyping._import_hook import JaxtypingTransformer

        visit = JaxtypingTransformer.visit_FunctionDef

        def visit_outermost(self: JaxtypingTransformer, node: ast.FunctionDef) -> Any:
            inner = any(isinstance(parent, ast.FunctionDef) for parent in self._parents)
            return node if inner else visit(self, node)

        JaxtypingTransformer.visit_FunctionDef = visit_outermost


_leave_inner_functions_out()
