"""Run a bench: `python -m tests.bench NAME ...`.  Without a name it lists them."""

import ast
import sys
from importlib import import_module
from pathlib import Path

import tyro


def benches() -> dict[str, str]:
    """First lines of the docstrings of all benches, by name; none is imported."""
    texts = {path.stem: path.read_text() for path in sorted(Path(__file__).parent.glob("[!_]*.py"))}
    documented = {name: ast.get_docstring(ast.parse(text)) for name, text in texts.items() if "\ndef main(" in text}
    return {name: (text or "").splitlines()[0] for name, text in documented.items()}


def main(words: list[str]) -> None:
    """Run the bench that the first word names with the other words as its options."""
    known = benches()
    if not words or words[0] not in known:
        print("python -m tests.bench NAME [--help | options]\n")
        print("\n".join(f"{name:16}{line}" for name, line in known.items()))
        sys.exit(f"\nno bench is called {words[0]}" if words else 0)
    bench = import_module(f"tests.bench.{words[0]}")
    tyro.cli(bench.main, args=words[1:], prog=f"python -m tests.bench {words[0]}", description=bench.__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
