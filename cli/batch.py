"""One verb for many scenes, which a batch file or the command line names: each to an output of its own.

A batch file's settings are read as the options of their names, so that both mean the same.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from functools import partial
from pathlib import Path
from typing import Any

import aaplug
from aaplug.options.base import SWITCH, as_path, flag
from aaplug.options.verbs import DRAWING, EvaluateOptions, RecipeOptions
from aaplug.system.errors import FormatError, UsageError, did_you_mean

from .console import TERMINAL, quiet
from .inputs import path_of, read_inputs, told
from .words import Answer, Words

NOT_IN_A_FILE = ("batch", "more", "json", "resume", "overwrite", "models", "skip")
ONCE = ("output", "threads", "memory", "rasterizer", "scheduler")  # for the whole batch, not for one scene

BATCH = flag("FILE.toml", read=as_path).named(
    "batch", "File of scenes and their settings, for an --output folder; options given here hold where it says nothing."
)
SEVERAL = (  # options of a verb that `for_each_scene` repeats
    BATCH,
    SWITCH.named("resume", "With --batch: leave out scenes whose output is there."),
    flag("local|tcp://HOST:PORT").named(
        "scheduler",
        "With --batch: a scene at a time on each worker of a Dask cluster; see `aaplug guide cluster`.",
        group=DRAWING,
    ),
)


def refuse_without_batch(words: Words, *names: str) -> None:
    """Raise UsageError if one of these options was given: they belong to a batch."""
    for name in names:
        if words.values[name]:
            raise UsageError(name, "belongs to --batch")


def batch_of_evaluations(words: Words, of_set: bool = False) -> Answer:
    """Evaluate every scene that a batch file or the command line names, or of a protocol's data set in a folder."""
    from aaplug.evaluation.data_sets import find_scenes

    if words.batch is not None:
        if others := words.more or words.scene or words.model_path:
            raise UsageError("batch", f"names the scenes; leave {others} out")
        scenes = scenes_of(words.batch, words.where(batch=None))
    elif of_set:
        data, protocol = path_of(words), str(words.protocol)
        found = find_scenes(protocol, data, words.models, words.skip)
        words = words.where(more=(), model_path=None, models=None)
        scenes = [(n, words.where(scene=model, cameras=data)) for n, (model, data) in found.items()]
    else:
        paths = [path_of(words), *words.more]
        names = [path.stem if path.is_file() else path.name for path in paths]
        scenes = [(n, words.where(more=(), scene=p, model_path=None)) for n, p in zip(names, paths, strict=True)]
    _, first = scenes[0]
    if first.output is None:
        raise UsageError("output", "name a folder for the results of several scenes: -o FOLDER")
    from aaplug.rendering.job import running

    options = EvaluateOptions(**told(first, EvaluateOptions))

    def run(scene: Words, scheduler: Any, name: str, output: Path, **given: Any) -> Any:
        keywords = told(scene, EvaluateOptions) | {"scheduler": scheduler, "name": name}
        with scene.command.errors("scene"):
            inputs = read_inputs(scene)
            return aaplug.evaluate(*inputs, output, **keywords | given)

    with running(options, shared=first.output) as workers:
        runs = [(name, partial(run, scene, workers.cluster)) for name, scene in scenes]
        how = {"resume": options.resume, "overwrite": options.overwrite, "monitor": TERMINAL}
        how |= {"protocol": words.protocol, "partly": words.skip} if of_set else {}
        batch = aaplug.batch(runs, first.output, **how)
    return Answer(batch.summary(), batch.tables(), bool(batch.failures))


def for_each_scene(words: Words, suffix: Callable[[Words], str], is_made: Callable[[Words], bool]) -> Answer:
    """Do a verb for every scene of its batch file, and write batch.json.  One scene that fails stops no other.

    suffix: of a scene's output.  is_made: whether a scene's output is there, and complete.
    """
    from aaplug.evaluation.data_sets import status_table
    from aaplug.evaluation.report.files import as_json, write_texts
    from aaplug.io.atomic import refuse_existing
    from aaplug.io.image_files import file_names
    from aaplug.io.scenes.pyramid_folder import is_pyramid
    from aaplug.rendering.job import running
    from aaplug.verbs.batch import SUMMARY

    scenes = dict(scenes_of(words.batch, words.where(batch=None, resume=False, scheduler=None)))
    folder = next(iter(scenes.values())).output
    done, todo = dict[str, dict[str, Any]](), dict[str, Words]()
    for slug, (name, scene) in zip(file_names(list(scenes), "scene", 3), scenes.items(), strict=True):
        output = folder / (slug + suffix(scene))
        scene = scene.where(output=output, resume=words.resume and is_pyramid(output))
        if words.resume and is_made(scene):
            done[name] = {"status": "kept", "output": str(output)}
        else:
            todo[name] = scene
    check = partial(refuse_existing, [folder / SUMMARY], words.overwrite or words.resume)
    check()
    options = RecipeOptions(scheduler=words.scheduler, threads=words.threads, monitor=TERMINAL)
    with running(options, folder, check, [words.batch], folder=True) as workers:
        apply = map if workers.cluster is None else workers.cluster.map
        results = apply(partial(_one_scene, None if workers.cluster is None else Path.cwd()), todo.values())
        for name, facts in zip(todo, results, strict=True):
            done[name] = {"status": "failed", "error": facts} if isinstance(facts, str) else {"status": "done", **facts}
            TERMINAL.say(": ".join([name, done[name]["status"], *([facts] if isinstance(facts, str) else [])]))
        outcomes = {name: done[name] for name in scenes}
        write_texts(folder, {SUMMARY: as_json({"scenes": outcomes})}, overwrite=True)
    rows = [(name, facts["status"], facts.get("error") or facts["output"]) for name, facts in outcomes.items()]
    failed = any(facts["status"] == "failed" for facts in outcomes.values())
    return Answer({"scenes": outcomes}, [status_table("output or why there is none", rows)], failed)


def _one_scene(elsewhere: Path | None, scene: Words) -> dict[str, Any] | str:
    """Do the verb for one scene: facts of what was made, or why there is nothing.

    elsewhere: on a worker, with one thread, whose terminal nobody reads: the folder that relative paths start from.
    """
    from aaplug.verbs.batch import outcome

    run = scene.command.errors("scene")(scene.command.run)
    if elsewhere is None:
        return outcome(lambda: run(scene).facts, TERMINAL)
    with quiet(), chdir(elsewhere):
        return outcome(lambda: run(scene.where(threads=1)).facts, TERMINAL)


def scenes_of(path: Path, base: Words) -> list[tuple[str, Words]]:
    """The scenes of a batch file with their options; `base` has what the file does not say."""
    from aaplug.io.batch_file import read_batch

    (at_the_top, scenes), refused = read_batch(path), (*NOT_IN_A_FILE, *ONCE)
    shared = _set(path, "at the top", base, at_the_top, NOT_IN_A_FILE)
    return [(name, _set(path, f"scene '{name}'", shared, settings, refused)) for name, settings in scenes.items()]


def _set(path: Path, where: str, words: Words, settings: Mapping[str, Any], refused: Sequence[str]) -> Words:
    options = words.command.options
    names = [name for name in options if name not in refused]
    values = {}
    try:
        for name, value in settings.items():
            if name not in names:
                raise FormatError(path, f"{where}: {name} is no setting here{did_you_mean(name, names)}")
            is_switch = options[name].count == 0 and isinstance(value, bool)
            texts = [*map(str, value if isinstance(value, list) and options[name].count != 0 else [value])]
            values[name] = value if is_switch else options[name].value(texts)
        return words.where(**values).checked()
    except UsageError as error:
        raise FormatError(path, f"{where}: {error}") from error
