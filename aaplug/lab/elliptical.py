"""Alpha from nodes inside the pixel: MipSLAM's elliptical adaptive anti-aliasing (Li et al. 2026, eqs. 5 and 6).

The paper publishes neither its nodes nor its constants, and its code lacks the method.  This follows what a third party
reads in it: alpha = o Σ w g / Σ w over n × n nodes, in the principal axes of the ellipse and evenly spread over a pixel
that is turned to them, n = 3 + ⌈ln(κ + 1)⌉ for the ratio κ of the variances.  The weight of a node at a distance d from
the pixel's edge is w = q/p (1 + γ ln κ) e^(-β d).  Evenly spread nodes of an even target have q/p = 1.

Every node of a splat has the same factor 1 + γ ln κ, so that it leaves the sum over the weights unchanged.

Nodes of equal d lie on a ring, the outline of a square.  With A_k and B_k the sums of the two one-dimensional Gaussians
over the nodes from ring k inwards, Σ w g = Σ_k (w_k - w_(k-1)) A_k B_k with w_(-1) = 0, which takes 2 n exponentials
instead of n².
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.interfaces import Limits, Pixels
from aaplug.core.kernels import Kernels
from aaplug.core.splats import Splats2D
from aaplug.lab.integral import Integral, principal_columns
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY, forms_at, rows_of

GAMMA, BETA = 0.5, 2.0  # the third party's guesses; beta is per px
LEAST_NODES = 3  # along a pixel's side, to which ⌈ln(κ + 1)⌉ are added
MOST_NODES = 10  # along a pixel's side, which κ up to 1095 need
HALF_U, HALF_V, NODES, FIRST_WEIGHT = range(COLUMNS, COLUMNS + 4)


@dataclass(frozen=True)
class Elliptical(Integral):
    """Alpha is opacity times the weighted mean of the Gaussian at the nodes, which lie within the square of `Integral`.

    gamma: weight of the elongation, which counts only where the sum is not `normalized`.
    beta: decrease of a node's weight with its distance from the pixel's edge, per px.
    normalized: the sum is divided by that of the weights; else by the number of nodes.
    """

    name: str = "eaa"
    columns: int = FIRST_WEIGHT + MOST_NODES // 2
    splats_per_pass: int = 4
    gamma: float = GAMMA
    beta: float = BETA
    normalized: bool = True

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m c"]:
        """Principal axes, the half windows along them, the number of nodes, and what each ring adds to a weight."""
        ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
        halves = [0.5 * splats.window * torch.hypot(x, y) for x, y in ((ux, uy), (vx, vy))]
        nodes, kappa = self.nodes(splats)
        weights, total = list[Tensor](), torch.zeros_like(nodes)
        for ring in range(MOST_NODES // 2):
            inner, weight = (nodes - 2 * ring).clamp(min=0), self.weight((ring + 0.5) / nodes, splats.window)
            total = total + weight * (inner**2 - (inner - 2).clamp(min=0) ** 2)
            weights.append(weight)
        scale = 1 / total if self.normalized else (1 + self.gamma * kappa.log()) / nodes**2
        rings = [scale * (weights[k] - weights[k - 1] if k else weights[k]) for k in range(MOST_NODES // 2)]
        return rows_of(splats, [ux, uy, vx, vy], [*halves, nodes, *rings])

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """Opacity times the sum over the rings, from the innermost to the outermost."""
        u, v = forms_at(rows, pixels)
        half_u, half_v, nodes = (rows[..., i, None] for i in (HALF_U, HALF_V, NODES))
        along_u, along_v, value = torch.zeros_like(u), torch.zeros_like(v), torch.zeros_like(u)
        for ring in reversed(range(MOST_NODES // 2)):
            place = 1 - (2 * ring + 1) / nodes.clamp(min=1)  # of the ring's nodes, in half pixels
            share = (0.5 * nodes - ring).clamp(0, 1)  # a half where both nodes are the pixel's centre
            along_u = along_u + share * _pair(u, half_u * place)
            along_v = along_v + share * _pair(v, half_v * place)
            value = value + rows[..., FIRST_WEIGHT + ring, None] * along_u * along_v
        return limits.cut(rows[..., OPACITY, None] * value)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """The sum over all nodes, one by one."""
        ux, uy, vx, vy = principal_columns(splats.covs, splats.dets)
        half = 0.5 * splats.window
        nodes, kappa = self.nodes(splats)
        value, total = torch.zeros_like(offsets[..., 0]), torch.zeros_like(nodes)
        places = [(2 * k + 1) / nodes - 1 for k in range(MOST_NODES)]
        along_u, along_v = (
            [torch.exp(-0.5 * (x + place * reach).square()) for place in places]
            for x, reach in (
                (ux * offsets[..., 0] + uy * offsets[..., 1], half * torch.hypot(ux, uy)),
                (vx * offsets[..., 0] + vy * offsets[..., 1], half * torch.hypot(vx, vy)),
            )
        )
        for i, s in enumerate(places):
            for j, t in enumerate(places):
                used = (i < nodes) & (j < nodes)
                weight = self.weight(0.5 * (1 - torch.maximum(s.abs(), t.abs())), splats.window) * used
                value, total = value + weight * along_u[i] * along_v[j], total + weight
        return value / total if self.normalized else value * (1 + self.gamma * kappa.log()) / nodes**2

    def nodes(self, splats: Splats2D) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
        """Nodes along a pixel's side, and κ, at least 1."""
        half_trace = 0.5 * (splats.covs[:, 0] + splats.covs[:, 2])
        longer = half_trace + (half_trace.square() - splats.dets).clamp(min=0).sqrt()
        kappa = (longer.square() / splats.dets.clamp(min=torch.finfo(splats.dets.dtype).tiny)).clamp(min=1)
        return (LEAST_NODES + (kappa + 1).log().ceil()).clamp(max=MOST_NODES).detach(), kappa

    def weight(self, distance: Tensor, window: float) -> Tensor:
        """e^(-β d).  distance: from the edge, in pixels of `window` px."""
        return (-self.beta * window * distance).exp()


def _pair(x: Tensor, apart: Tensor) -> Tensor:
    """The Gaussian at the two nodes on either side."""
    low, high = x - apart, x + apart
    return (-0.5 * low * low).exp() + (-0.5 * high * high).exp()


ELLIPTICAL = Elliptical()
