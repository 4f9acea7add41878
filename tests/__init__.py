"""Tests, and how they check the types and shapes of what aaplug's functions take and return, by jaxtyping and beartype.

Checks took half of the time of all tests.  So those of functions inside functions are left out, which would be compiled
at every call of the outer one, and in each test the first `CHECKS_OF_EACH` of a function are made, and `MOST_CHECKS` in
all.

Tests run side by side, so they and the programs that they start have one thread, and threads that wait do not spin.
"""

import ast
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import Any

import jaxtyping

CHECKS_OF_EACH = 50  # of what a function takes or gives
MOST_CHECKS = 10_000  # twice as many as calls

if "pytest" in sys.modules:  # benches measure without these; torch reads them when it is imported, after this
    os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
_test = 0
_left = MOST_CHECKS


def check_again() -> None:
    """Make the checks of another test."""
    global _test, _left
    _test, _left = _test + 1, MOST_CHECKS
    jaxtyping.config.update("jaxtyping_disable", False)


def with_checks(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its checks: jaxtyping's own, which does nothing else."""
    from beartype import beartype

    check, test, left = None, 0, CHECKS_OF_EACH

    @wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        global _left
        nonlocal check, test, left
        check = check or beartype(function)  # at the first call: most functions are called by few tests
        if test != _test:
            test, left = _test, CHECKS_OF_EACH
        left, _left = left - 1, _left - 1
        if not _left:
            jaxtyping.config.update("jaxtyping_disable", True)
        return check(*args, **options) if left >= 0 else None

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
