"""aaplug demo: the whole job on the bundled sample."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from .console import TERMINAL, out, say


@dataclass(frozen=True)
class Demo:
    """Convert, render and measure the bundled scene: a pretrained chair and four photographs."""

    output: Annotated[Path, arg(aliases=["-o"], metavar="FOLDER")] = Path("demo-out")
    """Folder for the converted scene, the contact sheet and the results."""
    overwrite: bool = False
    """Replace the files of an earlier demo."""

    def __call__(self) -> int:
        """Convert, render and measure."""
        from aaplug.evaluation.results import tables
        from aaplug.verbs import demo as verb

        report = verb.demo(self.output, overwrite=self.overwrite, monitor=TERMINAL)
        out.print(*tables(report))
        say(f"look at {self.output / verb.SHEET}")
        return 0
