"""Tests.

jaxtyping checks types and shapes of what aaplug's functions take and return, of functions inside functions not: they
are defined, and their checks compiled, at every call of the outer one, which took half of the time of all tests.
"""

import ast
from typing import Any

from jaxtyping._import_hook import JaxtypingTransformer

_visit = JaxtypingTransformer.visit_FunctionDef


def _visit_outermost(self: JaxtypingTransformer, node: ast.FunctionDef) -> Any:
    return node if any(isinstance(parent, ast.FunctionDef) for parent in self._parents) else _visit(self, node)


JaxtypingTransformer.visit_FunctionDef = _visit_outermost
