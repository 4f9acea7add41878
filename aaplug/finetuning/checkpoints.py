"""A run on disk: everything that its next step depends on, in one file that appears whole or not at all.

The file is torch's own, of tensors, numbers and words alone, and is read as such: nothing in it is executed.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aaplug.core.errors import FormatError, UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import SamplingBounds
from aaplug.finetuning.densification import Pulls
from aaplug.finetuning.state import Job, State, optimizer
from aaplug.io.atomic import replacing

FORMAT = "aaplug finetune 2"
DIGEST = 16  # hex digits that tell one scene from another


def packed(state: State) -> dict[str, Any]:
    """A copy of the state that later steps do not change, of types that files hold."""
    moments = {
        group["name"]: {k: v.clone() for k, v in state.adam.state[group["params"][0]].items()}
        for group in state.adam.param_groups
    }
    return {
        "step": state.step,
        "leaves": {name: leaf.detach().clone() for name, leaf in state.leaves.items()},
        "moments": moments,
        "born": state.born.clone(),
        "bounds": {name: value.clone() for name, value in vars(state.bounds).items()},
        "pulls": (state.pulls.total.clone(), state.pulls.views.clone()),
        "bad": state.bad,
        "back_offs": state.back_offs,
        "curve": list(state.curve),
        "probes": list(state.probes),
    }


def unpacked(data: Mapping[str, Any], job: Job) -> State:
    """The state again; it shares nothing with what it was made from."""
    leaves = {name: leaf.clone() for name, leaf in data["leaves"].items()}
    adam = optimizer(leaves, job.settings)
    for group in adam.param_groups:
        moments = data["moments"][group["name"]]
        adam.state[group["params"][0]] = {k: v.clone() for k, v in moments.items()}
    total, views = data["pulls"]
    return State(
        step=data["step"],
        leaves=leaves,
        adam=adam,
        born=data["born"].clone(),
        bounds=SamplingBounds(**{name: value.clone() for name, value in data["bounds"].items()}),
        pulls=Pulls(total.clone(), views.clone()),
        bad=data["bad"],
        back_offs=data["back_offs"],
        curve=list(data["curve"]),
        probes=list(data["probes"]),
    )


def save(path: Path, job: Job, state: State, good: Mapping[str, Any]) -> None:
    """Write the state, and the one to go back to, over what is there.

    Raises:
        OutputError: it cannot be written; an older file is then still whole.
    """
    content = {"format": FORMAT, "job": facts(job), "state": packed(state), "good": dict(good)}
    with replacing(path, overwrite=True) as stream:
        torch.save(content, stream)


def load(path: Path, job: Job) -> tuple[State, dict[str, Any]]:
    """The state of a run of this very job, and the one to go back to.

    Raises:
        FormatError: the file is missing, damaged or something else.
        UsageError: it is of another job; the first difference is named.
    """
    try:
        content = torch.load(path, weights_only=True)
        if content["format"] != FORMAT:
            raise ValueError(content["format"])
        state, found = unpacked(content["state"], job), content["job"]
    except FileNotFoundError as error:
        raise FormatError(path, "does not exist: there is no run to resume") from error
    except Exception as error:  # whatever torch stumbles over in a damaged file
        raise FormatError(path, "is not a checkpoint of `aaplug finetune`, or damaged") from error
    for key, value in facts(job).items():
        if found.get(key) != value:
            raise UsageError(
                str(path), f"is of another run: its {key} was {found.get(key)}, now it is {value}"
            )
    return state, content["good"]


def facts(job: Job) -> dict[str, str]:
    """What a run is a function of, in words that can be compared."""
    settings = {key: str(value) for key, value in asdict(job.settings).items()}
    return settings | {
        "scene": _digest(job.start),
        "truth": f"{_digest(job.truth.scene)} photographs={job.truth.photographs}",
        "recipe": job.recipe.name,
        "views": _hash(repr([(v.name, v.hw, v.focal) for v in job.views]).encode()),
        "background": str(job.background),
        "guard": str(job.training.guard),
        "rasterizer": job.rasterizer.kernels.name,
        "number of threads": str(torch.get_num_threads()),  # sums are taken in another order
    }


def _digest(scene: Gaussians) -> str:
    columns: list[Tensor] = [
        *(scene.means, scene.quats, scene.log_scales, scene.logit_opacities, scene.sh)
    ]
    return _hash(b"".join(c.detach().contiguous().numpy().tobytes() for c in columns))


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGEST]
