"""A training loop as gsplat's users write it, with the bookkeeping of its default densification."""

import torch
from gsplat import rasterization

RATES = {"means": 1e-2, "quats": 1e-2, "scales": 1e-2, "opacities": 5e-2, "sh0": 2e-2, "shN": 1e-2}


def train(splats, views, steps, packed, batch=2):
    """Losses, and for each Gaussian the summed gradient of its centre and in how many images it is.

    splats: parameters by name, scales as logarithms and opacities as logits.  views: pairs of a camera (viewmat, K,
    width, height) and its photograph.
    """
    splats = torch.nn.ParameterDict({name: torch.nn.Parameter(value.clone()) for name, value in splats.items()})
    optimizers = {name: torch.optim.Adam([splats[name]], lr=rate) for name, rate in RATES.items()}
    state = {"grad2d": torch.zeros_like(splats["opacities"]), "count": torch.zeros_like(splats["opacities"])}
    losses = []
    for step in range(steps):
        chosen = [views[(step * batch + i) % len(views)] for i in range(batch)]
        viewmats, Ks = (torch.stack([camera[i] for camera, _ in chosen]) for i in (0, 1))
        width, height = chosen[0][0][2:]
        renders, _, info = rasterization(
            means=splats["means"],
            quats=splats["quats"],
            scales=torch.exp(splats["scales"]),
            opacities=torch.sigmoid(splats["opacities"]),
            colors=torch.cat([splats["sh0"], splats["shN"]], 1),
            viewmats=viewmats,
            Ks=Ks,
            width=width,
            height=height,
            sh_degree=1,
            packed=packed,
        )
        info["means2d"].retain_grad()
        loss = (renders - torch.stack([photograph for _, photograph in chosen])).abs().mean()
        loss.backward()
        update(state, info, packed)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
    return losses, state


def update(state, info, packed):
    """Sum up gradients of the centres, in units of half the image."""
    grads = info["means2d"].grad.clone()
    grads[..., 0] *= info["width"] / 2.0 * info["n_cameras"]
    grads[..., 1] *= info["height"] / 2.0 * info["n_cameras"]
    if packed:
        ids = info["gaussian_ids"]
    else:
        shown = (info["radii"] > 0).all(dim=-1)
        ids, grads = torch.where(shown)[1], grads[shown]
    state["grad2d"].index_add_(0, ids, grads.norm(dim=-1))
    state["count"].index_add_(0, ids, torch.ones_like(ids, dtype=state["count"].dtype))
