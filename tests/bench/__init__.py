"""Measurements: heavy, never part of the tests.

A bench is a module with a function `main`, whose parameters are its options.  It prints tables of Markdown.
"""


def heading(title: str, *columns: object) -> None:
    """Begin a table."""
    print(f"\n{title}\n\n| {' | '.join(map(str, columns))} |\n{'|---' * len(columns)}|", flush=True)


def row(*cells: object) -> None:
    """Print a row of a table; floats have two digits."""
    print("| " + " | ".join(f"{c:.2f}" if isinstance(c, float) else str(c) for c in cells) + " |", flush=True)
