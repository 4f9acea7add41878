"""The live page: one HTML file that holds its style and script; all else comes over its websocket."""

from functools import cache

from aaplug.evaluation.report.pages import assembled

SCRIPTS = ("poses.js", "link.js", "painting.js", "live.js", "controls.js")


@cache
def page() -> str:
    """The page's text."""
    return assembled(__name__, "live.html.j2", ("live.css",), SCRIPTS)
