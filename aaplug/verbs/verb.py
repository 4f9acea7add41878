"""The decorator of verbs: a function that takes its options as one object is called with them as keywords.

A verb's options are a dataclass of `aaplug.options`, which states each keyword once.  Type checkers see them as
keywords of the verb, and so do `help` and the API's pages.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial, wraps
from os import PathLike
from types import NoneType
from typing import Any, ParamSpec, Protocol, TypeVar, get_args, get_type_hints

import torch

from aaplug.io.atomic import AnyPath, check_name
from aaplug.io.scenes import SceneLike
from aaplug.options.base import Options, docs_of
from aaplug.rendering.job import CamerasLike, detached
from aaplug.system.contracts import contract
from aaplug.system.errors import UsageError, did_you_mean
from aaplug.system.executors import given_threads, torch_threads

P = ParamSpec("P")
O_contra = TypeVar("O_contra", bound=Options, contravariant=True)
R_co = TypeVar("R_co", covariant=True)
ScenesLike = Mapping[str, SceneLike] | Sequence[SceneLike]


class Writing(Protocol[P, R_co]):
    """A verb that works on a scene and can write an output."""

    def __call__(  # noqa: D102
        self,
        scene: SceneLike,
        cameras: CamerasLike = None,
        output: AnyPath | None = None,
        *_: P.args,
        **options: P.kwargs,
    ) -> R_co: ...


class Looking(Protocol[P, R_co]):
    """A verb that looks at a scene."""

    def __call__(  # noqa: D102
        self, scene: SceneLike | None = None, cameras: CamerasLike = None, *_: P.args, **options: P.kwargs
    ) -> R_co: ...


class Comparing(Protocol[P, R_co]):
    """A verb that works on several scenes."""

    def __call__(  # noqa: D102
        self,
        scenes: ScenesLike,
        cameras: CamerasLike = None,
        output: AnyPath | None = None,
        *_: P.args,
        **options: P.kwargs,
    ) -> R_co: ...


def writes(
    options: Callable[P, O_contra],
) -> Callable[[Callable[[SceneLike, CamerasLike, AnyPath | None, O_contra], R_co]], Writing[P, R_co]]:
    """Decorate a verb that works on a scene and can write an output."""
    return partial(_verb, options)


def looks(
    options: Callable[P, O_contra],
) -> Callable[[Callable[[SceneLike | None, CamerasLike, O_contra], R_co]], Looking[P, R_co]]:
    """Decorate a verb that looks at a scene."""
    return partial(_verb, options)


def compares(
    options: Callable[P, O_contra],
) -> Callable[[Callable[[ScenesLike, CamerasLike, AnyPath | None, O_contra], R_co]], Comparing[P, R_co]]:
    """Decorate a verb that works on several scenes."""
    return partial(_verb, options)


def _verb(options: Any, body: Callable[..., Any]) -> Any:
    *given, last = inspect.signature(body).parameters.values()
    assert last.name == "options"
    given = [p.replace(default=None) if NoneType in get_args(p.annotation) else p for p in given]
    inputs = inspect.Signature(given)
    body_checked = contract(body)

    @wraps(body)
    def verb(*args: Any, **keywords: Any) -> Any:
        own = {name: keywords.pop(name) for name in inputs.parameters if name in keywords}
        bound = inputs.bind(*args, **own)
        bound.apply_defaults()
        for name in bound.arguments.keys() & {"scene", "scenes", "cameras"}:
            bound.arguments[name] = detached(bound.arguments[name])
        if isinstance(output := bound.arguments.get("output"), str | PathLike):
            check_name(output)
        # where more threads pay, and are free, `on_free_cores` takes them
        with torch.inference_mode(False), torch.enable_grad(), torch_threads(1, given_threads()):
            for name in keywords.keys() - hints:
                raise UsageError(name, f"is no option here{did_you_mean(name, hints)}")
            return body_checked(*bound.args, options(**keywords))

    hints = get_type_hints(options)  # without what the command line adds to them
    fields = [p.replace(annotation=hints[name]) for name, p in inspect.signature(options).parameters.items()]
    signature = inspect.signature(body).replace(parameters=[*inputs.parameters.values(), *fields])
    told = [f"    {name}: {doc}" for name, doc in docs_of(options).items()]
    verb.__doc__ = "\n".join([inspect.cleandoc(body.__doc__ or ""), "", "Options:", *told])
    vars(verb).update(__signature__=signature, options=options)
    return verb
