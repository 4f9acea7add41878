"""aaplug evaluate: every recipe at every scale, measured."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

import aaplug
from aaplug.core.errors import UsageError
from aaplug.options.evaluate import EvaluateOptions

from .console import TERMINAL, out, print_json
from .main import FAILED
from .options import CameraOptions, Flat, SceneOptions, flag, read_inputs

if TYPE_CHECKING:
    from aaplug.evaluation.results import Report


@dataclass(frozen=True)
class OtherScenes:
    """More scenes."""

    more: Annotated[tuple[Path, ...], tyro.conf.Positional, flag("[SCENE ...]")] = ()
    """More scenes, with the same --cameras or each a model folder.  Each gets its own folder of results."""


@dataclass(frozen=True)
class Evaluate:
    """Measure recipes over scales, against photographs or against the scene's own look; of one scene or many."""

    scene: SceneOptions = field(default_factory=SceneOptions)
    others: OtherScenes = field(default_factory=OtherScenes)
    batch: Annotated[Path | None, flag("FILE.toml")] = None
    """Scenes and their settings from a file; what it does not say is as on the command line."""
    cameras: CameraOptions = field(default_factory=CameraOptions)
    output: Annotated[Path | None, flag("FOLDER", "-o")] = None
    """Folder for results.json, per_view.json and results.csv."""
    how: Annotated[EvaluateOptions, Flat] = field(default_factory=EvaluateOptions)
    shard: Annotated[str | None, flag("3/8")] = None
    """Evaluate every 8th of several scenes, from the 3rd on; when all shards are done, aaplug gather joins them."""
    json: bool = False
    """Print results.json on stdout instead of the table."""

    def __call__(self) -> int:
        """Measure one scene or many."""
        if self.batch is not None or self.others.more:
            return self._many()
        if self.shard is not None:
            raise UsageError("shard", "is a part of several scenes; name them, or give `batch`")
        _ = self.scene.path  # refuses where none is named
        from aaplug.evaluation.results import results, tables
        from aaplug.verbs.evaluate import check_results

        check_results(self.output, self.how)  # before the scene is read
        report = self._run()
        self._print(results(report), tables(report))
        return 0

    def _run(self, **given: Any) -> "Report":
        """Evaluate one scene; `given` has precedence over the options."""
        scene, cameras = read_inputs(self.scene, self.cameras)
        own = {"output": self.output, "name": self.scene.path.stem, "monitor": TERMINAL}
        return aaplug.evaluate(scene, cameras, **vars(self.how) | own | given)

    def _many(self) -> int:
        scenes = self._scenes()
        output = scenes[0][1].output
        if output is None:
            raise UsageError("output", "name a folder for the results of several scenes: -o FOLDER")
        from aaplug.verbs.inputs import scheduled

        kept = {"resume": self.how.resume, "overwrite": self.how.overwrite}
        with scheduled(scenes[0][1].how, output, TERMINAL) as scheduler:
            runs = [(name, partial(own._run, scheduler=scheduler)) for name, own in scenes]
            found = aaplug.batch(runs, output, **kept, shard=self.shard, request=self._request(), monitor=TERMINAL)
        self._print(found.summary(), found.tables())
        return FAILED if found.failures else 0

    def _request(self) -> str:
        """Hash of the scenes and of the options that change results; the folder of results may have other names."""
        from aaplug.core.digests import digest_of_files, digest_of_values

        how = replace(self.how, resume=False, overwrite=False, threads=None, memory=None, scheduler=None)
        same = replace(self, how=how, output=None, shard=None, json=False, batch=None)
        file = None if self.batch is None else digest_of_files([self.batch])
        return digest_of_values((file, same))

    def _scenes(self) -> list[tuple[str, "Evaluate"]]:
        """The scenes that a batch file or the command line names, with their options."""
        if self.batch is not None:
            if named := self.others.more or self.scene.scene or self.scene.model_path:
                raise UsageError("batch", f"names the scenes; leave {named} out")
            from .batch import scenes_of

            return scenes_of(self.batch, replace(self, batch=None))
        paths = [self.scene.path, *self.others.more]
        alone = replace(self, others=OtherScenes())
        scenes = [replace(self.scene, scene=path, model_path=None) for path in paths]
        return [(s.path.stem if s.path.is_file() else s.path.name, replace(alone, scene=s)) for s in scenes]

    def _print(self, data: Any, grids: Any) -> None:
        if self.json:
            print_json(data)
        else:
            out.print(*grids)
