"""Calls of the public API with one wrong value each, made from its signatures; prints what they ended in as JSON.

It is run as a program, outside of pytest, whose checks of types would raise before the library's own.
"""

import inspect
import json
import math
import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, chdir
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

import aaplug
from aaplug.evaluation.laws.base import make_camera, make_scene, make_splats
from aaplug.gsplat import rasterization, rasterization_2dgs
from aaplug.system.errors import AaplugError

signature_of = cache(inspect.signature)  # takes longer than many of the calls
STRANGERS = (object(), 2j)  # which no parameter takes
ODD_VALUES = (
    None, True, 0, 1, -1, 7, 10**30, 0.0, 0.5, -0.5, 1e30, math.nan, math.inf, -math.inf, "", "nope", "5x5",
    "\0", "n" * 5000, b"bytes", (), [], {}, (1, 2), [1.0, 2.0, math.nan], (5, 5), ["r_8"], {"a": 3}, int, aaplug.Camera,
    Path("nowhere"), np.float16(2), np.zeros((4, 3)), torch.zeros(()), torch.zeros(4, 3), torch.zeros(3),
)  # fmt: skip
MANY, THIN = 12, 5  # from so many parameters on, each option takes one in so many of the odd values
TABLES = ("Gaussians", "Splats2D")  # their columns go to compiled kernels
TAKES_NONE = ("view", "serving", "bench")  # and works on a scene of its own
NOT_CALLED = {  # and why
    **dict.fromkeys(("AaplugError", "FormatError", "UsageError"), "an exception"),
    **dict.fromkeys(("Monitor", "Kernels"), "passed to plug-ins, which do not make one"),
    **dict.fromkeys(("Render", "Pixels", "Limits"), "a tuple: it holds what it is given"),
    **dict.fromkeys(("raster_rows", "whitening_columns"), "compiled into kernels, which call it alone"),
    "Scene": "made by `read_scene` and `in_memory`",
    "Colour": "a name of a type",
}


def right_calls(folder: Path) -> dict[str, tuple[Callable[..., Any], dict[str, Any]]]:
    """Each public function, class and method with a right call of it."""
    nowhere, views = folder / "nowhere.ply", (make_camera(size=(16, 12)), make_camera((3.0, -2.0, 1.0), size=(16, 12)))
    gaussians, cameras = make_scene(20), aaplug.CameraSet(views, views[:1])
    splats, training = make_splats(6, (8, 8)), aaplug.TrainingViews.of(gaussians, views)
    renderer = aaplug.Renderer.of(gaussians, cameras, rasterizer="eager", min_seen=0.0)
    recipe, view, rgb = aaplug.RECIPES["matched"], views[0], torch.zeros(4, 3, 3)
    pyramid = aaplug.Pyramid.of([gaussians], [torch.zeros(20, dtype=torch.int64)])
    at = torch.tensor([[0.0, 0.0, -4.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    picture = folder / "picture.png"
    aaplug.write_png(picture, rgb, overwrite=True)

    def fields(noun: Any) -> dict[str, Any]:
        return {name: value for name, value in vars(noun).items() if name in signature_of(type(noun)).parameters}

    aperture = aaplug.Aperture(0.1, 3.0)
    exposure = aaplug.Exposure(aperture, (view, view), 2)
    nouns = (view, cameras, gaussians, splats, training, recipe, pyramid, aaplug.RULES_3DGS, gaussians.convention)
    lens = aaplug.Lens("equidistant", (0.01,))
    nouns += (aperture, exposure, lens)
    calls = {type(noun).__name__: (type(noun), fields(noun)) for noun in nouns}
    plain = {"rasterizer": "eager", "min_seen": 0.0}
    verbs = ("convert", "evaluate", "finetune", "lod", "video")
    gsplat = {"means": gaussians.means, "quats": gaussians.quats, "scales": gaussians.scales, "width": 16, "height": 12}
    gsplat |= {"opacities": gaussians.opacities, "colors": gaussians.sh[:, 0]}
    intrinsics = torch.tensor([[[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]])
    gsplat |= {"viewmats": view.cam_from_world[None].float(), "Ks": intrinsics}
    functions = {
        **{name: {"scene": nowhere, "output": folder / name} for name in verbs},
        "refine_poses": {"scene": nowhere} | plain,
        "render": {"scene": gaussians, "cameras": cameras, "scale": 0.05, "recipe": "classic", **plain},
        "info": {"scene": gaussians, "cameras": cameras, "min_seen": 0.0},
        "compare": {"scenes": [nowhere, nowhere], "output": folder / "compare"},
        "merge": {"scenes": [gaussians, gaussians], "cameras": cameras, "min_seen": 0.0},
        "serving": {"scene": nowhere},
        "view": {"scene": nowhere, "no_browser": True},
        "bench": {"scene": nowhere},
        "batch": {"runs": [], "output": folder / "batch"},
        "conform": {"images": folder},
        "check_plugin": {"module": "nope"},
        "demo": {"output": picture},
        "warmup": {"recipe": "nope"},
        "cameras_around": {"scene": gaussians, "orbit": aaplug.Orbit()},
        "Orbit": {"orbit": 3},
        "read_cameras": {"path": folder},
        "read_camera_path": {"path": folder},
        "read_scene": {"path": nowhere},
        "read_image": {"path": picture},
        "write_png": {"path": folder / "new.png", "rgb": rgb},
        "write_scene": {"path": folder / "new.ply", "scene": gaussians, "overwrite": True},
        "find_recipe": {"name": "auto"},
        "look_at": dict(zip(("eye", "target", "up"), at, strict=True)),
        "smoothed_by": {"scene": gaussians, "log_sigma": torch.zeros(20, 1), "volume": True},
        "frequency_response": {"splats": splats, "omega": torch.zeros(4, 2)},
        "whitening": {"splats": splats},
        "grown": {"splats": splats, "radius": torch.ones(6, dtype=torch.float64), "min_alpha": 1 / 255},
        "over": {"rgb": rgb, "alpha": rgb[..., 0], "background": (1.0, 1.0, 1.0)},
        "logit_of": {"opacity": torch.rand(4)},
        "sh_of_colour": {"rgb": torch.rand(4, 3)},
        "check_count": {"path": nowhere, "count": 3},
        "library_errors": {"path": nowhere},
        "replacing": {"path": folder / "replaced", "overwrite": True},
        "CameraFileOptions": {},
        "SceneFileOptions": {},
        "Fusion": {"method": "method"},
        "Metric": fields(aaplug.METRICS["PSNR"]),
        "Renderer": fields(renderer),
    }
    calls |= {name: (getattr(aaplug, name), right) for name, right in functions.items()}
    calls |= {
        "Renderer.of": (aaplug.Renderer.of, {"scene": gaussians, "cameras": views, **plain}),
        "Renderer.call": (renderer, {"camera": view}),
        "TrainingViews.of": (aaplug.TrainingViews.of, {"scene": gaussians, "cameras": views}),
        "Pyramid.of": (aaplug.Pyramid.of, {"levels": [gaussians], "chunks": [pyramid.chunks]}),
        "Scene.in_memory": (aaplug.Scene.in_memory, {"held": gaussians}),
        "rasterization": (rasterization, gsplat),
        "rasterization_2dgs": (rasterization_2dgs, gsplat),
    }
    methods: dict[str, tuple[Any, dict[str, Any]]] = {
        "scaled": (view, {"factor": 0.5}),
        "resized": (view, {"width": 4, "height": 4}),
        "framed": (view, {"width": 4, "height": 4}),
        "project": (view, {"points": torch.zeros(2, 3)}),
        "pixels": (view, {"places": torch.zeros(2, 2)}),
        "rays": (view, {"pixels": torch.zeros(2, 2)}),
        "places": (lens, {"rays": torch.ones(2, 3)}),
        "to": (gaussians, {"dtype": torch.float64}),
        "level": (pyramid, {"number": 0}),
        "finer": (training, {"factor": 2.0}),
        "relative_rate": (training, {"camera": view}),
        "blurred": (splats, {"variance": 0.3, "compensate": True}),
        "convolved": (splats, {"added": splats.covs, "compensate": True}),
        "draw": (renderer, {"camera": view}),
        "sampling": (renderer, {"camera": view}),
        "splats": (renderer, {"camera": view}),
        "sampled": (renderer, {"camera": view}),
        "by": (renderer, {"recipe": recipe}),
        "trained_at": (renderer, {"factor": 2.0}),
        "showing": (renderer, {"scene": gaussians}),
        "paint": (renderer, {"splats": renderer.splats(view), "hw": view.hw}),
        "samples_at": (recipe, {"relative_rate": 0.5}),
        "neighbours_at": (recipe, {"sampled_rate": 0.5}),
        "lacks": (recipe, {"scene": gaussians}),
        "find": (aaplug.METRICS, {"name": "PSNR"}),
        "register": (aaplug.METRICS, {"name": "odd", "value": 3}),
    }
    calls |= {f"{type(noun).__name__}.{name}": (getattr(noun, name), right) for name, (noun, right) in methods.items()}
    for noun in (gaussians, splats, aaplug.RECIPES):
        index = "matched" if noun is aaplug.RECIPES else slice(2)
        name = next(iter(signature_of(noun.__getitem__).parameters))
        calls[f"{type(noun).__name__}[]"] = (noun.__getitem__, {name: index})
    return calls


def unfit_columns(x: Tensor) -> list[Any]:
    """Variations of a column of a table that compiled kernels could not read, or not to its end."""
    return [x[:-1], x[..., None], x.to(torch.float16), x.to(torch.complex64), x.to("meta"), x.to_sparse(), x.numpy()]


def odd_tensors(x: Tensor) -> list[Any]:
    """Further variations of a right tensor, each odd in one respect."""
    kinds = [x.to(dtype) for dtype in (torch.bfloat16, torch.int32, torch.float64, torch.bool)]
    shapes = [x[None], x[:0], x.expand(2, *x.shape), x.flatten(), x.reshape(-1, 1)]
    values = [torch.full_like(x, n) for n in (math.nan, math.inf) if x.is_floating_point()]
    return [*kinds, *shapes, *values, x.tolist()]


def empty_ones(noun: Any) -> list[Any]:
    """A noun without all, or some, of what it holds."""
    if isinstance(noun, aaplug.CameraSet):
        return [aaplug.CameraSet(train, test) for train in ((), noun.train) for test in ((), noun.test)][:3]
    return [noun[:0]] if isinstance(noun, aaplug.Gaussians | aaplug.Splats2D) else []


def wrong_calls(folder: Path) -> Iterator[tuple[str, str, Any, bool, Callable[[], Any]]]:
    """Yield (function, parameter, value, whether it must be refused, call) of each call."""
    for name, (function, right) in right_calls(folder).items():
        for number, (parameter, spec) in enumerate(signature_of(function).parameters.items()):
            if spec.kind in (spec.VAR_KEYWORD, spec.VAR_POSITIONAL):
                continue
            thin = spec.kind is spec.KEYWORD_ONLY and len(signature_of(function).parameters) > MANY
            values = list(ODD_VALUES[number % THIN :: THIN] if thin else ODD_VALUES) + empty_ones(right.get(parameter))
            unfit = list(STRANGERS)
            if isinstance(right.get(parameter), Tensor):
                values += odd_tensors(right[parameter].detach())
                (unfit if name in TABLES else values).extend(unfit_columns(right[parameter].detach()))
            for value in (*values, *unfit):
                takes = (value is None and name in TAKES_NONE) or (isinstance(value, tuple | list) and name == "warmup")
                if not takes and not (isinstance(value, bool) and isinstance(spec.default, bool)):
                    refused = any(value is x for x in unfit)
                    yield name, parameter, value, refused, partial(call, function, {**right, parameter: value})


def call(function: Callable[..., Any], given: dict[str, Any]) -> None:
    """Call a function, also where its parameters have no keywords; a context manager is entered too."""
    positional = [given[n] for n, p in signature_of(function).parameters.items() if p.kind is p.POSITIONAL_ONLY]
    result = function(*positional) if positional else function(**given)
    if isinstance(result, AbstractContextManager):
        with result:
            pass


def words_of(name: str, parameter: str, value: Any) -> str:
    """The call in a message."""
    return f"{name}({parameter}={str(value)[:40]!r} {type(value).__name__})"


def main() -> None:
    """Make all calls; print their number, raw errors, slow calls, strangers let pass, and functions not called."""
    torch.set_num_threads(1)
    os.fsync = lambda descriptor: None  # as in conftest.py
    warnings.simplefilter("ignore")
    said: dict[str, list[str]] = {"raw": [], "slow": [], "passed": []}
    ends: Counter[str] = Counter()
    with TemporaryDirectory() as folder, chdir(folder):
        functions = set(right_calls(Path(folder)))
        for name, parameter, value, refused, do in wrong_calls(Path(folder)):
            start = time.thread_time()
            try:
                do()
                ends["let pass"] += 1
                if refused:
                    said["passed"].append(words_of(name, parameter, value))
            except AaplugError:
                ends["refused"] += 1
            except Exception as error:
                said["raw"].append(f"{words_of(name, parameter, value)}: {type(error).__name__}: {str(error)[:80]}")
            if time.thread_time() - start > 1:
                said["slow"].append(words_of(name, parameter, value))
    callables = {
        n
        for n in aaplug.__all__
        if callable(getattr(aaplug, n)) and not getattr(getattr(aaplug, n), "_is_protocol", False)
    }
    said["forgotten"] = sorted(callables - functions - NOT_CALLED.keys())
    json.dump({"calls": sum(ends.values()) + len(said["raw"]), **ends, **said}, sys.stdout, indent=1)


if __name__ == "__main__":
    main()
