"""Checkpoints: everything that the next step of a run depends on, in one file that is written whole or not at all.

The file is torch's, of tensors, numbers and strings only.  It is read as such: nothing in it is executed.
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
from aaplug.finetuning.densification import ScreenGradients
from aaplug.finetuning.state import State, TuningJob, optimizer
from aaplug.io.atomic import replacing

FORMAT = "aaplug finetune 3"
DIGEST = 16  # hex digits of a hash
COUNTERS = ("step", "bad_steps", "rollbacks")


def packed(state: State) -> dict[str, Any]:
    """A copy of the state, which later steps do not change, in types that a file can hold."""
    moments = {
        group["name"]: {k: v.clone() for k, v in state.adam.state[group["params"][0]].items()}
        for group in state.adam.param_groups
    }
    return {name: getattr(state, name) for name in COUNTERS} | {
        "leaves": {name: leaf.detach().clone() for name, leaf in state.leaves.items()},
        "moments": moments,
        "first_log_scales": state.first_log_scales.clone(),
        "bounds": _cloned(vars(state.bounds)),
        "gradients": _cloned(vars(state.gradients)),
        "curve": list(state.curve),
        "probes": list(state.probes),
    }


def unpacked(data: Mapping[str, Any], job: TuningJob) -> State:
    """The state again; it shares no tensor with `data`."""
    leaves = _cloned(data["leaves"])
    adam = optimizer(leaves, job.settings)
    for group in adam.param_groups:
        adam.state[group["params"][0]] = _cloned(data["moments"][group["name"]])
    return State(
        leaves=leaves,
        adam=adam,
        first_log_scales=data["first_log_scales"].clone(),
        bounds=SamplingBounds(**_cloned(data["bounds"])),
        gradients=ScreenGradients(**_cloned(data["gradients"])),
        curve=list(data["curve"]),
        probes=list(data["probes"]),
        **{name: data[name] for name in COUNTERS},
    )


def save(path: Path, job: TuningJob, state: State, good: Mapping[str, Any]) -> None:
    """Write the state and the last good one, replacing an older checkpoint.

    Raises:
        OutputError: it cannot be written; an older checkpoint is then still whole.
    """
    content = {"format": FORMAT, "job": facts(job), "state": packed(state), "good": dict(good)}
    with replacing(path, overwrite=True) as stream:
        torch.save(content, stream)


def load(path: Path, job: TuningJob) -> tuple[State, dict[str, Any]]:
    """The state of a run of this job, and the last good one, packed.

    Raises:
        FormatError: the file is missing, damaged or something else.
        UsageError: it is of another job; the message names the first difference.
    """
    try:
        content = torch.load(path, weights_only=True)
        if content["format"] != FORMAT:
            raise ValueError(content["format"])
        state, found = unpacked(content["state"], job), content["job"]
    except FileNotFoundError as error:
        raise FormatError(path, "does not exist: there is no run to resume") from error
    except Exception as error:  # torch raises all kinds over a damaged file
        raise FormatError(path, "is damaged, or no checkpoint of this version") from error
    for key, value in facts(job).items():
        if found.get(key) != value:
            raise UsageError(str(path), f"is of another run: its {key} was {found.get(key)}, now it is {value}")
    return state, content["good"]


def facts(job: TuningJob) -> dict[str, str]:
    """Everything that a run depends on, as text that can be compared."""
    settings = {key: str(value) for key, value in asdict(job.settings).items()}
    start, truth = job.start, job.truth
    return settings | {
        "scene": _digest(start.scene),
        "truth": f"{_digest(truth.own.scene)} {truth.source}",
        "recipe": start.recipe.name,
        "views": _hash(repr([(v.name, v.hw, v.focal) for v in job.views]).encode()),
        "background": str(start.background),
        "cull margin": str(start.training.cull_margin),
        "rasterizer": start.rasterizer.name,
        "number of threads": str(torch.get_num_threads()),  # it changes the order of sums
    }


def _cloned(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in tensors.items()}


def _digest(scene: Gaussians) -> str:
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    columns = [getattr(scene, name).detach().contiguous() for name in names]
    return _hash(b"".join(column.numpy().tobytes() for column in columns))


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGEST]
