"""Sparse gradients, for optimizers that move only the Gaussians in sight, such as `torch.optim.SparseAdam`."""

from typing import Any

import torch
from torch import Tensor

from aaplug.core.errors import UsageError


def with_sparse_gradient(x: Tensor, rows: list[Tensor]) -> Tensor:
    """The same tensor, whose gradient in the backward pass has values at `rows[0]` alone, which is filled in later.

    Raises:
        UsageError: the tensor has batch dimensions.
    """
    if x.dim() > 2:
        raise UsageError("sparse_grad", "has no batch dimensions")
    return _Sparse.apply(x, rows)  # pyright: ignore[reportReturnType]


class _Sparse(torch.autograd.Function):
    """The identity."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, rows: list[Tensor]) -> Tensor:
        ctx.rows = rows
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (grad,), (rows,) = grads, ctx.rows
        found = torch.sparse_coo_tensor(rows[None], grad[rows], grad.shape, is_coalesced=True, check_invariants=False)
        return found, None
