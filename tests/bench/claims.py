"""examples/guides/claims.md: each paper's claims about aliasing beside what aaplug measured.

It writes the figures of the page from the result files in examples/guides/tables, which `method_tables` makes.
"""

import csv
import re
from functools import partial
from statistics import fmean
from typing import NamedTuple

from tests.bench.method_tables import PSNR_COLUMN, SCALES, TABLES, made, table

PAGE = TABLES.with_name("claims.md")


class Claim(NamedTuple):
    """A row of the page: what a paper claims, and what of it can be repeated here.

    ours: reads the figure that aaplug measured, in words; its first argument is the result file.  None if it cannot be
    repeated, for the reason in `what`.
    """

    number: str
    paper: str
    claim: str
    what: str
    ours: partial[str] | None = None


def value(scene: str, recipe: str, scale: float, column: str = PSNR_COLUMN) -> float:
    """A figure of a result file."""
    return float(table(scene)[recipe, scale][column])


def _over(scene: str, recipe: str, scales: tuple[float, ...]) -> str:
    """PSNR at some scales and their mean."""
    values = [value(scene, recipe, scale) for scale in scales]
    return f"{' '.join(f'{value:.2f}' for value in values)}, mean {fmean(values):.2f} dB"


def _gain(scene: str, recipe: str, other: str, scales: tuple[float, ...]) -> str:
    """Mean gain in PSNR of one recipe over another."""
    return f"{fmean(value(scene, recipe, s) - value(scene, other, s) for s in scales):+.2f} dB"


def _fall(scene: str, recipe: str, first: float, last: float) -> str:
    return f"{value(scene, recipe, first):.2f} → {value(scene, recipe, last):.2f} dB"


def _time(name: str, rasterizer: str, recipe: str) -> str:
    """How much longer a view takes than by `classic`, in percent."""
    with open(TABLES / f"{name}.csv", newline="", encoding="utf-8") as file:
        times = {(line["rasterizer"], line["recipe"]): float(line["ms"]) for line in csv.DictReader(file)}
    return f"{100 * (times[rasterizer, recipe] / times[rasterizer, 'classic'] - 1):+.0f} % time per view at 1"


def _work(scene: str, recipe: str, other: str, scale: float) -> str:
    """Evaluations of one recipe against another's."""
    work = [value(scene, name, scale, "evaluations (M)") for name in (recipe, other)]
    return f"{work[0] / work[1]:.2f} times the evaluations of {other} at {scale:g}"


ALL, SMALL, LARGE, NEAR = (1.0, 0.5, 0.25, 0.125), (0.5, 0.25, 0.125), (2.0, 4.0, 8.0), (1.0, 2.0, 4.0, 8.0)
FIGURES = {  # by the numbers of their rows
    1: partial(_over, "chair", "classic", ALL),
    2: partial(_fall, "chair-eighth", "classic", 1.0, 8.0),
    3: partial(_fall, "snowmiku-quarter", "classic", 1.0, 4.0),
    4: partial(_over, "chair", "ewa", ALL),
    5: partial(_over, "chair", "mip-splatting", ALL),
    6: partial(_gain, "chair", "mip-splatting", "classic", ALL),
    7: partial(_over, "chair", "mip", ALL),
    8: partial(_over, "chair-eighth", "mip-splatting", NEAR),
    9: partial(_over, "chair-eighth", "ewa", NEAR),
    11: partial(_gain, "chair", "sa-gs", "classic", SMALL),
    12: partial(_gain, "snowmiku", "sa-gs", "classic", SMALL),
    13: partial(_gain, "chair-eighth", "sa-gs", "classic", LARGE),
    14: partial(_gain, "chair", "sa-gs-integral", "sa-gs", SMALL),
    15: partial(_gain, "chair", "sa-gs-samples", "sa-gs", SMALL),
    16: partial(_gain, "chair", "auto", "classic", SMALL),
    17: partial(_gain, "chair-eighth", "matched", "classic", LARGE),
    18: partial(_over, "chair", "analytic", ALL),
    19: partial(_time, "times", "eager", "analytic"),
    20: partial(_over, "chair", "gaussian-blending", ALL),
    21: partial(_gain, "chair", "gaussian-blending", "mip-splatting", ALL),
    22: partial(_over, "chair", "aaa", ALL),
    23: partial(_over, "chair", "2dgs", ALL),
    24: partial(_over, "chair", "aa-2dgs", ALL),
    26: partial(_work, "chair", "auto", "classic", 0.125),
    29: partial(_work, "chair", "matched", "classic", 0.125),
    30: partial(_time, "times", "compiled", "matched"),
}
ROW = re.compile(r"^\| (\d+) \| (.+?) \| (.+?) \| (.+?) \|.*\|$", re.M)
SOURCES = re.compile(r"(?<=result files, which )`.*?(?= \(the least of)", re.S)
CLAIMS = [Claim(*words, ours=FIGURES.get(int(words[0]))) for words in ROW.findall(PAGE.read_text())]


def pair(claim: Claim) -> tuple[float, float] | None:
    """The paper's figure and ours in dB, where both are a mean over scales or a gain; else None."""
    if claim.ours is None:
        return None
    for pattern in (r"mean (?:of four )?(\d+\.\d+)", r"([+-]\d+\.\d+)(?: dB|$)"):
        said, ours = (re.search(pattern, text) for text in (claim.claim, claim.ours()))
        if said and ours:
            return float(said[1]), float(ours[1])
    return None


def main() -> None:
    """Write the figures of the page."""
    PAGE.write_text(page())


def page() -> str:
    """claims.md, with the figures of the result files and where they come from."""
    rows = {claim.number: _row(claim) for claim in CLAIMS}
    text = ROW.sub(lambda found: rows[found[1]], PAGE.read_text())
    text, count = SOURCES.subn(f"{made(*SCALES)}, and of time\n{made('times')}", text)
    assert count == 1, "the page does not say where its figures come from"
    return text


def _row(claim: Claim) -> str:
    ours, file = "", "none: cannot be repeated"
    if claim.ours is not None:
        file = claim.ours.args[0]
        ours, file = claim.ours(), f"[{file}](tables/{file}.csv)"
    return f"| {' | '.join([*claim[:4], ours, file])} |"
