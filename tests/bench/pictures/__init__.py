"""The pictures of examples/guides, drawn by aaplug from the bundled chair and from the tables of methods.md."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parents[3] / "examples" / "guides" / "pictures"
