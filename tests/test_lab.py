"""The folder for comparisons: nothing needs it, and deleting it deletes its entries alone."""

import re
import shutil

from aaplug.io.images import image_size
from tests.conftest import ROOT, SAMPLE, run_python

PROGRAM = """
import os, sys
os.chdir(sys.argv[1])
sys.path.remove("")  # the checkout
# An editable installation would find the folder where it was installed from.
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in getattr(finder, "__module__", "")]
import aaplug
from aaplug.methods import COMPOSITORS, RECIPES
from aaplug_cli.main import main
assert aaplug.__file__.startswith(sys.argv[1]), aaplug.__file__
assert {"auto", "2dgs"} <= set(RECIPES) and "analytic" not in RECIPES and not COMPOSITORS
main(["render", f"{sys.argv[2]}/chair.ply", *f"--cameras {sys.argv[2]} -o images --scale 0.1 --views r_8".split()])
"""


def test_nothing_but_the_lab_names_it():
    files = [p for folder in ("aaplug", "cli") for p in (ROOT / folder).rglob("*.py*") if p.suffix in (".py", ".pyi")]
    others = [path for path in files if path.parent.name != "lab"]
    assert len(files) > len(others) > 100
    assert not [path for path in others if re.search(r"\blab[./]|import lab\b", path.read_text())]


def test_without_its_folder_auto_renders_and_nothing_is_said_of_it(tmp_path):
    hidden = shutil.ignore_patterns("lab")
    shutil.copytree(ROOT / "aaplug", tmp_path / "aaplug", ignore=hidden)
    shutil.copytree(ROOT / "cli", tmp_path / "aaplug_cli", ignore=hidden)
    done = run_python(PROGRAM, tmp_path, SAMPLE, PYTHONPATH=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "lab" not in done.stderr
    images = [*(tmp_path / "images").rglob("*.png")]
    assert [image_size(path) for path in images] == [(80, 80)]
