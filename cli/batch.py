"""One verb for many scenes, which a batch file or the command line names: each to an output of its own.

A batch file's settings are read as the options of their names, so that both mean the same.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import aaplug
from aaplug.options.base import DRAWING, flag
from aaplug.options.verbs import EvaluateOptions
from aaplug.system.errors import FormatError, UsageError, did_you_mean

from .console import FAILED, TERMINAL, print_json, quiet, show
from .inputs import path_of, read_inputs, told
from .words import Option, Words

NOT_IN_A_FILE = ("batch", "more", "json", "resume", "overwrite")
ONCE = ("output", "threads", "memory", "rasterizer", "scheduler")  # for the whole batch, not for one scene

SEVERAL = (  # options of a verb that `for_each_scene` repeats
    Option(
        "batch",
        flag("FILE.toml", read=Path),
        "Scenes and their settings from a file; --output is then a folder for all of them.",
        None,
    ),
    Option("resume", None, "With --batch: leave out scenes whose output is there.", False),
    Option(
        "scheduler",
        flag("local|tcp://HOST:PORT"),
        "With --batch: a scene at a time on each worker of a Dask cluster; see examples/guides/cluster.md.",
        None,
        DRAWING,
    ),
)


def batch_of_evaluations(words: Words) -> int:
    """Evaluate every scene that a batch file or the command line names."""
    scenes = _scenes_to_evaluate(words)
    _, first = scenes[0]
    if first.output is None:
        raise UsageError("output", "name a folder for the results of several scenes: -o FOLDER")
    from aaplug.rendering.job import running

    options = EvaluateOptions(**told(first, EvaluateOptions))

    def run(own: Words, scheduler: Any, name: str, output: Path, **given: Any) -> Any:
        keywords = told(own, EvaluateOptions) | {"scheduler": scheduler, "name": name}
        inputs = read_inputs(own)
        return aaplug.evaluate(*inputs, output, **keywords | given)

    with running(options, None, lambda: None, (), shared=first.output) as workers:
        runs = [(name, partial(run, own, workers.cluster)) for name, own in scenes]
        how = {"resume": options.resume, "overwrite": options.overwrite, "monitor": TERMINAL}
        batch = aaplug.batch(runs, first.output, **how)
    if words.json:
        print_json(batch.summary())
    else:
        show(*batch.tables())
    return FAILED if batch.failures else 0


def _scenes_to_evaluate(words: Words) -> list[tuple[str, Words]]:
    """The scenes by name, with their options."""
    if words.batch is not None:
        if named := words.more or words.scene or words.model_path:
            raise UsageError("batch", f"names the scenes; leave {named} out")
        return scenes_of(words.batch, words.where(batch=None))
    paths = [path_of(words), *words.more]
    named = [path.stem if path.is_file() else path.name for path in paths]
    return [(n, words.where(more=(), scene=p, model_path=None)) for n, p in zip(named, paths, strict=True)]


def for_each_scene(words: Words, suffix: Callable[[Words], str], work: Callable[[Words], dict[str, Any]]) -> int:
    """Do a verb for every scene of its batch file, and write batch.json.  One scene that fails stops no other.

    suffix: of a scene's output.
    work: does the verb for one scene, and returns facts for JSON; a `status` among them replaces "done".
    """
    from aaplug.evaluation.report.files import as_json, write_texts
    from aaplug.io.atomic import refuse_existing
    from aaplug.options.shared import RecipeOptions
    from aaplug.rendering.job import running
    from aaplug.verbs.batch import SUMMARY, status_table
    from aaplug.verbs.views import file_names

    named = dict(scenes_of(words.batch, words.where(batch=None, resume=False, scheduler=None)))
    folder = next(iter(named.values())).output
    slugs = file_names(list(named), "scene", 3)
    todo = {
        name: own.where(output=folder / (slug + suffix(own)))
        for slug, (name, own) in zip(slugs, named.items(), strict=True)
    }
    outcomes: dict[str, Any] = {}
    for name, own in list(todo.items()):
        if words.resume and own.output.is_file():
            outcomes[name] = made_before(todo.pop(name))
    check = partial(refuse_existing, [folder / SUMMARY], words.overwrite or words.resume)
    check()
    options = RecipeOptions(scheduler=words.scheduler, threads=words.threads, monitor=TERMINAL)
    with running(options, folder, check, [words.batch], folder=True) as workers:
        apply = map if workers.cluster is None else workers.cluster.map
        results = apply(_OneScene(work, None if workers.cluster is None else Path.cwd()), todo.values())
        for name, facts in zip(todo, results, strict=True):
            failed = isinstance(facts, str)
            outcomes[name] = {"status": "failed", "error": facts} if failed else {"status": "done", **facts}
            TERMINAL.say(f"{name}: {outcomes[name]['status']}{f': {facts}' if failed else ''}")
        summary = as_json({"scenes": {name: outcomes[name] for name in named}})
        write_texts(folder, {SUMMARY: summary}, overwrite=True)
    if words.json:
        print_json({"scenes": outcomes})
    else:
        rows = [(name, facts["status"], facts.get("error") or facts["output"]) for name, facts in outcomes.items()]
        show(status_table("output or why there is none", rows))
    return FAILED if any(facts["status"] == "failed" for facts in outcomes.values()) else 0


def made_before(own: Words) -> dict[str, Any]:
    """Facts of a scene whose output an earlier run made."""
    return {"status": "kept", "output": str(own.output)}


@dataclass(frozen=True)
class _OneScene:
    """Does the work for one scene.

    elsewhere: on a worker, with one thread, whose terminal nobody reads: the folder that relative paths start from.
    """

    work: Callable[[Words], dict[str, Any]]
    elsewhere: Path | None

    def __call__(self, own: Words) -> dict[str, Any] | str:
        """Facts of what was made, or why there is nothing."""
        from aaplug.verbs.batch import outcome

        if self.elsewhere is None:
            return outcome(lambda: self.work(own), TERMINAL)
        with quiet(), chdir(self.elsewhere):
            return outcome(lambda: self.work(own.where(threads=1)), TERMINAL)


def scenes_of(path: Path, base: Words) -> list[tuple[str, Words]]:
    """The scenes of a batch file with their options; `base` has what the file does not say."""
    from aaplug.io.batch_file import read_batch

    file, refused = read_batch(path), (*NOT_IN_A_FILE, *ONCE)
    shared = _set(path, "at the top", base, file.shared, NOT_IN_A_FILE)
    return [(name, _set(path, f"scene '{name}'", shared, settings, refused)) for name, settings in file.scenes.items()]


def _set(path: Path, where: str, words: Words, settings: Mapping[str, Any], refused: Sequence[str]) -> Words:
    """The options with a table's settings."""
    options = words.command.options
    names = [name for name in options if name not in refused]
    values = {}
    try:
        for name, value in settings.items():
            if name not in names:
                raise FormatError(path, f"{where}: {name} is no setting here{did_you_mean(name, names)}")
            is_switch = options[name].argument is None and isinstance(value, bool)
            texts = [*map(str, value if isinstance(value, list) else [value])]
            values[name] = value if is_switch else options[name].value(texts)
        return words.where(**values).checked()
    except UsageError as error:
        raise FormatError(path, f"{where}: {error}") from error
