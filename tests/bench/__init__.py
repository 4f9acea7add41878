"""Measurements: heavy, never part of the tests.

A bench is a module with a function `main`, whose parameters are its options.  It prints tables of Markdown.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any


def heading(title: str, *columns: object) -> None:
    """Begin a table."""
    print(f"\n{title}\n\n| {' | '.join(map(str, columns))} |\n{'|---' * len(columns)}|", flush=True)


def row(*cells: object) -> None:
    """Print a row of a table; floats have two digits."""
    print("| " + " | ".join(f"{c:.2f}" if isinstance(c, float) else str(c) for c in cells) + " |", flush=True)


def timed(
    works: Mapping[Any, Callable[[], object]],
    rounds: int,
    of: Callable[[Sequence[float]], float] = median,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Any, float]:
    """Seconds of each of these, by name: a figure of so many rounds, in turn, after one that does not count."""
    taken: dict[Any, list[float]] = {name: [] for name in works}
    for _ in range(rounds + 1):
        for name, work in works.items():
            start = clock()
            work()
            taken[name].append(clock() - start)
    return {name: of(seconds[1:]) for name, seconds in taken.items()}
