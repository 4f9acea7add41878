"""The picture of the floors: the layers of the import contracts in pyproject.toml, each room with its own first line.

`python examples/site/floors.py` draws examples/guides/pictures/floors.svg again.
"""

import ast
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "examples" / "guides" / "pictures" / "floors.svg"
WIDTH, FLOOR_HEIGHT, GAP = 1080, 62, 10  # px


def floors() -> list[list[str]]:
    """The rooms of each floor, from the top down."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    [layers] = [contract["layers"] for contract in contracts if contract["type"] == "layers"]
    return [[room.strip("()") for room in layer.split(" | ")] for layer in layers]


def about(room: str) -> str:
    """The first sentence of a folder's docstring."""
    text = ast.get_docstring(ast.parse((ROOT / "aaplug" / room / "__init__.py").read_text())) or ""
    return text.splitlines()[0]


def svg() -> str:
    """The picture: a box a room, the command line above them; imports go down only."""
    rows = [["cli"], *floors()]
    height = len(rows) * (FLOOR_HEIGHT + GAP) + GAP
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif">',
        "<style>rect{fill:#eef3f8;stroke:#456}text{fill:#123}</style>",
    ]
    for place, rooms in enumerate(rows):
        width = (WIDTH - GAP * (len(rooms) + 1)) / len(rooms)
        for column, room in enumerate(rooms):
            x, y = GAP + column * (width + GAP), GAP + place * (FLOOR_HEIGHT + GAP)
            text = "The command line: words to options, options to verbs." if room == "cli" else about(room)
            most = int(width / 6.6)
            text = text if len(text) <= most else text[: most - 1].rsplit(" ", 1)[0] + " …"
            parts += [
                f'<rect x="{x:.0f}" y="{y}" width="{width:.0f}" height="{FLOOR_HEIGHT}" rx="6"/>',
                f'<text x="{x + 12:.0f}" y="{y + 25}" font-size="17" font-weight="bold">{room}</text>',
                f'<text x="{x + 12:.0f}" y="{y + 47}" font-size="12">{escape(text)}</text>',
            ]
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(svg())
