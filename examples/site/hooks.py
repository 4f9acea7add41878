"""What the site has beyond the guides: pages of the API, the tour, plots, and the scripts of aaplug's own pages."""

import inspect
import json
import re
import sys
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import aaplug
from aaplug.options.base import Options, docs_of

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(ROOT)]  # the plots, and the benches that read the result files
from plots import drawn  # noqa: E402

PAGES = ROOT / "aaplug" / "evaluation" / "report" / "pages"
STUB = ROOT / "aaplug" / "__init__.pyi"
SHARED = [PAGES / name for name in ("pictures.js", "comparing.js")]
THEME = PAGES / "theme.css"
TOUR = ROOT / "examples" / "tour.ipynb"
TABLED = "    options: { members: false, show_signature: false, show_bases: false, merge_init_into_class: false }\n"
WORDS = ("source", "protocol", "program")  # attributes that say what an entry of a registry is


def topics() -> dict[str, list[str]]:
    """Public names of each topic, from the comments of the stub."""
    blocks = re.findall(r"^# (.+)\n((?:from .+\n)+)", STUB.read_text(), re.M)
    return {title: re.findall(r"\w+ as (\w+)", lines) for title, lines in blocks}


def path_of(title: str) -> str:
    """A topic's page."""
    return f"api/{re.sub(r'[^a-z]+', '-', title.split(',')[0].replace(chr(39), ''))}.md"


def page_of(title: str, names: list[str]) -> str:
    """A topic's page, which mkdocstrings fills from the docstrings."""
    return f"# {title[0].upper()}{title[1:]}\n\n" + "\n".join(map(entry_of, names))


def entry_of(name: str) -> str:
    """What a page shows of a name: its docstring, then a verb's options or what a registry has."""
    found = getattr(aaplug, name, None)
    if isinstance(found, type) and issubclass(found, Options):
        return f"::: aaplug.{name}\n{TABLED}{options_of(found)}"
    shown = f"::: aaplug.{name}\n"
    if isinstance(found, Mapping):
        return shown + "\n| name | what it is |\n|---|---|\n" + "".join(map(row_of, found.items())) + "\n"
    options = getattr(found, "options", None)
    return shown if options is None or not inspect.isfunction(found) else f"{shown}{options_of(options)}"


def options_of(options: type[Options]) -> str:
    """A table of options with their defaults, from the docstrings that are also the command line's help."""
    docs = {name: " ".join(text.split()).replace("|", "\\|") for name, text in docs_of(options).items()}
    rows = (f"| `{one.name}` | `{default_of(one)}` | {docs.get(one.name, '')} |\n" for one in fields(options))
    return f"\n**Options:**\n\n| option | default | what it does |\n|---|---|---|\n{''.join(rows)}\n"


def default_of(field: Field[Any]) -> str:
    """An option's value where none is given, as Python writes it."""
    value = field.default if field.default_factory is MISSING else field.default_factory()
    return repr(value).replace("|", "\\|")


def row_of(entry: tuple[str, Any]) -> str:
    """An entry of a registry: its own words, or its parameters."""
    name, value = entry
    words = next((getattr(value, key) for key in WORDS if hasattr(value, key)), None)
    if words is None:
        parameters, says = repr(value), (type(value).__doc__ or "").splitlines()[0]
        words = says if "<" in parameters else f"`{parameters}`: {says}"
    return f"| `{name}` | {words} |\n"


def tour() -> str:
    """The notebook as a page: its text, its code, and what the code printed and showed."""
    parts = []
    for cell in json.loads(TOUR.read_text())["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        parts += map(shown, cell.get("outputs", ()))
    return "\n\n".join(parts).replace("](guides/", "](")


def shown(output: dict[str, Any]) -> str:
    """An output of a notebook's cell."""
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img alt="what the cell above shows" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    text = "".join(output.get("text") or data.get("text/plain", ""))
    return f"```text\n{text.rstrip()}\n```"


def script() -> str:
    """The gallery's script after those that aaplug's own pages share; its names stay inside."""
    return "(() => {\n" + "".join(path.read_text() for path in (*SHARED, HERE / "sliders.js")) + "})();\n"


def style() -> str:
    """The theme that aaplug's own pages share, and the site's."""
    return "".join(path.read_text() for path in (THEME, HERE / "site.css"))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the API's pages into the navigation."""
    assert config.nav is not None
    for entry in config.nav:
        if "API reference" in entry:
            entry["API reference"] = [path_of(title) for title in topics()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages, scripts and styles that are made here."""
    made = {path_of(title): page_of(title, names) for title, names in topics().items()}
    made["tour.md"] = tour()
    made["assets/sliders.js"], made["assets/site.css"] = script(), style()
    made["assets/offline.js"] = (HERE / "offline.js").read_text()
    for path, content in made.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead to the tour's page where a guide leads to the notebook; draw the plots."""
    return drawn(markdown.replace("](../tour.ipynb", "](tour.md"))


def on_post_build(config: MkDocsConfig) -> None:
    """Write the search's index as a script, too, which pages that are opened from a folder may read."""
    index = Path(config.site_dir, "search", "search_index.json")
    index.with_suffix(".js").write_text(f"var __index = {index.read_text()}")
