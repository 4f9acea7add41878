"""The common parts of pages for the browser: theme, pictures, and comparing two of them by a divider and a lens."""

import base64
import hashlib
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

STYLES = ("theme.css",)
SCRIPTS = ("pictures.js", "comparing.js")


def assembled(package: str, template: str, styles: tuple[str, ...], scripts: tuple[str, ...], **values: Any) -> str:
    """A page of one file, from the sources of a package after those that all pages share.

    The template gets `style`, `script` (of all scripts, as one), the script's hash for a content security policy, and
    the values.
    """
    style = _joined(__name__, STYLES) + _joined(package, styles)
    script = _joined(__name__, SCRIPTS) + _joined(package, scripts)
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return environment.from_string(_joined(package, (template,))).render(
        style=Markup(style), script=Markup(script), script_hash=digest, **values
    )


def _joined(package: str, sources: tuple[str, ...]) -> str:
    return "".join(files(package).joinpath(source).read_text(encoding="utf-8") for source in sources)
