"""One verb for the scenes of a batch file: each to an output of its own, here or on the workers of a cluster."""

from collections.abc import Callable
from contextlib import chdir
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from aaplug.evaluation.report.files import as_json, write_texts
from aaplug.io.atomic import claimed, output_folder, refuse_existing
from aaplug.io.scenes.manifests import is_pyramid
from aaplug.options.shared import RecipeOptions
from aaplug.verbs.batch import SUMMARY, outcome, status_table
from aaplug.verbs.inputs import scheduled
from aaplug.verbs.views import file_names

from .batch import scenes_of
from .console import TERMINAL, out, print_json, quiet
from .main import FAILED
from .options import SeveralScenes


class OfOneScene(Protocol):
    """A verb's options."""

    @property
    def output(self) -> Path: ...  # noqa: D102
    @property
    def several(self) -> SeveralScenes: ...  # noqa: D102
    @property
    def how(self) -> Any: ...  # noqa: D102
    @property
    def json(self) -> bool: ...  # noqa: D102

    def made(self) -> tuple[dict[str, Any], Any]:
        """Do it, and tell what was made: for JSON, and more."""
        ...


V = TypeVar("V", bound=OfOneScene)


def of_all(verb: V, suffix: Callable[[V], str]) -> int:
    """Do a verb for every scene of its batch file, and write batch.json.  One scene that fails stops no other.

    suffix: of a scene's output.
    """
    assert verb.several.batch is not None
    named = dict(scenes_of(verb.several.batch, replace(verb, several=SeveralScenes())))  # pyright: ignore
    folder = next(iter(named.values())).output
    slugs = file_names(list(named), "scene", 3)
    todo = {
        name: replace(own, output=folder / (slug + suffix(own)))  # pyright: ignore
        for slug, (name, own) in zip(slugs, named.items(), strict=True)
    }
    kept = [name for name, own in todo.items() if verb.several.keep and _is_there(own.output)]
    found: dict[str, Any] = {name: {"status": "kept", "output": str(todo.pop(name).output)} for name in kept}
    check = partial(refuse_existing, [folder / SUMMARY], verb.how.overwrite or verb.several.keep)
    check()
    o = RecipeOptions(scheduler=verb.several.scheduler, threads=verb.how.threads)
    with output_folder(folder) as made, claimed(made / SUMMARY, check), scheduled(o, made, TERMINAL) as executor:
        apply = map if executor is None else executor.map
        outcomes = apply(_OfOne(None if executor is None else Path.cwd()), todo.values())
        for name, facts in zip(todo, outcomes, strict=True):
            failed = isinstance(facts, str)
            found[name] = {"status": "failed", "error": facts} if failed else {"status": "done", **facts}
            TERMINAL.say(f"{name}: {found[name]['status']}{f': {facts}' if failed else ''}")
        write_texts(made, {SUMMARY: as_json({"scenes": {name: found[name] for name in named}})}, overwrite=True)
    if verb.json:
        print_json({"scenes": found})
    else:
        rows = [(name, each["status"], each.get("error") or each["output"]) for name, each in found.items()]
        out.print(status_table("output or why there is none", rows))
    return FAILED if any(facts["status"] == "failed" for facts in found.values()) else 0


@dataclass(frozen=True)
class _OfOne:
    """What is done for one scene.

    elsewhere: on a worker, with one thread, whose terminal nobody reads; what relative paths start from.
    """

    elsewhere: Path | None

    def __call__(self, own: Any) -> dict[str, Any] | str:
        """Facts of what was made, or why there is nothing."""
        if self.elsewhere is None:
            return outcome(lambda: own.made()[0], TERMINAL)
        own = replace(own, how=replace(own.how, threads=1))
        with quiet(), chdir(self.elsewhere):
            return outcome(lambda: own.made()[0], TERMINAL)


def _is_there(output: Path) -> bool:
    return output.is_file() or is_pyramid(output)
