"""The site: its pages, its tables and figures, its sliders and its tour say what the code and the measurements say."""

import importlib.util
import json
import re
import runpy
import tomllib

import pytest

import aaplug
from aaplug.evaluation.results import CEILING
from aaplug.methods import RECIPES
from tests.bench.claims import CLAIMS, FIGURES
from tests.bench.claims import PAGE as PAGE_OF_CLAIMS
from tests.bench.claims import page as claims_page
from tests.bench.method_tables import COLUMNS, SCALES, lines, short_table, table
from tests.bench.pictures import CURVES, FOLDER, scales
from tests.bench.theory import laws
from tests.bench.viewers import shown_table
from tests.conftest import ROOT, drag

GUIDES = ROOT / "examples" / "guides"
SITE = ROOT / "examples" / "site"
TOUR = ROOT / "examples" / "tour.ipynb"
METHODS = (GUIDES / "methods.md").read_text()
MOST = 2_000_000  # bytes of all pictures
PAPER = re.compile(r"\]\(https://(arxiv\.org/abs/\d{4}\.\d{5}|doi\.org/\S+)\)")
NOT_IN_TABLES = {"multi-scale", "learned", "playcanvas", "playcanvas-classic"}  # need columns; are of viewers.md
OURS = ("aaplug", "PlayCanvas")  # first words of the sources that are no papers


@pytest.fixture(scope="module")
def hooks() -> dict[str, object]:
    pytest.importorskip("mkdocs")
    return runpy.run_path(str(SITE / "hooks.py"))


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_each_recipe_has_a_row_with_its_paper_beside_it(recipe):
    rows = METHODS.split("## Measured")[0].splitlines()  # of the first table
    (found,) = (row for row in rows if re.match(rf"\| [^|]*`{recipe.name}`[^|]* \|", row))
    assert PAPER.search(found) or recipe.source.startswith(OURS)


def test_links_to_papers_say_what_they_lead_to():
    for path in GUIDES.glob("*.md"):
        for said, led in re.findall(r"\[arXiv (\S+)\]\(https://arxiv\.org/abs/(\S+)\)", path.read_text()):
            assert said == led, path.name


def test_tables_and_claims_are_made_from_the_result_files_to_the_digit():
    assert short_table() in METHODS
    assert shown_table() in (GUIDES / "viewers.md").read_text()
    assert PAGE_OF_CLAIMS.read_text() == claims_page()
    numbers = [int(claim.number) for claim in CLAIMS]
    assert numbers == [*range(1, len(numbers) + 1)]
    assert len(FIGURES.keys() & {*numbers}) == len(FIGURES) > 20


@pytest.mark.parametrize("scene", SCALES)
def test_each_csv_has_every_recipe(scene):
    found = table(scene)
    assert {recipe for recipe, _ in found} == {CEILING, *RECIPES} - NOT_IN_TABLES
    assert all(tuple(row) == COLUMNS and None not in row.values() for row in found.values())
    assert f"tables/{scene}.csv" in METHODS


def test_lines_of_a_csv_are_means_and_a_median_of_seconds():
    at = {"PSNR": {"a": 30.0, "b": 31.0, "c": None}, "SSIM": {"a": None}, "evaluations": {"a": 2e6, "b": 4e6}}
    measured = {"_aaplug": {"scales": [0.25]}, "auto@0.25": at | {"seconds": {"a": 1.0, "b": 2.0, "c": 9.0}}}
    assert list(lines(measured)) == [("auto", "0.25", "30.50", "", "3.0", "2.00")]


@pytest.mark.parametrize(("plot", "least"), [(scales(), 4 * len(CURVES)), (laws(), 5)], ids=["scales", "theory"])
def test_a_figure_of_tables_or_formulas_is_the_committed_one(plot, least):
    def curves(svg: str) -> list[str]:
        return re.findall(r'<path d="(M [^"]*)" clip-path', svg)

    def words(svg: str) -> list[str]:
        return re.findall(r"<text [^>]*>([^<]+)</text>", svg)

    now, then = plot.svg(), (FOLDER / f"{plot.name}.svg").read_text()
    assert curves(now) == curves(then)
    assert words(now) == words(then) != []
    assert len(curves(now)) >= least


def test_each_plot_is_asked_for_once_and_names_its_files_their_command_and_commit(hooks):
    texts = {path.name: path.read_text() for path in GUIDES.glob("*.md")}
    pages = {name: hooks["drawn"](text) for name, text in texts.items()}
    changed = {name: page for name, page in pages.items() if page != texts[name]}
    assert changed.keys() == {"results.md", "claims.md", "viewers.md"}
    for page in changed.values():
        [figure] = re.findall(r'<figure class="plot">.*?</figure>', page, re.S)
        assert "\n\n" not in figure
        assert len(re.findall(r'<path d="M |<use ', figure)) > 20
        assert re.search(
            r"tables/\w+\.csv.*<code>.*tests\.bench \w+.*</code> made at commit [0-9a-f]{12}", figure, re.S
        )


def test_pictures_are_small_and_each_is_shown():
    pictures = [path for path in FOLDER.iterdir() if path.is_file()]
    texts = "".join(path.read_text() for path in GUIDES.glob("*.md"))
    assert sum(path.stat().st_size for path in pictures) < MOST
    assert [path.name for path in pictures if f"pictures/{path.name})" not in texts] == []


def test_the_citation_is_of_this_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = dict(re.findall(r"^([\w-]+): (.+)$", (GUIDES / "CITATION.cff").read_text(), re.M))
    expected = (project["version"], project["license"], "1.2.0")
    assert tuple(citation[key] for key in ("version", "license", "cff-version")) == expected


def test_the_api_has_a_place_for_every_public_name(hooks):
    topics = hooks["topics"]()
    assert {name for names in topics.values() for name in names if "." not in name} == set(aaplug.__all__)
    pages = {hooks["path_of"](title): hooks["page_of"](title, names) for title, names in topics.items()}
    assert len(pages) == len(topics)
    assert "| `auto` |" in "".join(pages.values())
    assert "| `recipe` | `'auto'` |" in hooks["entry_of"]("render")


def test_fields_of_a_docstring_become_a_list():
    pytest.importorskip("griffe")
    fields = runpy.run_path(str(SITE / "fields.py"))["listed"]
    text = "How.\n\nname: of it.  when: always, and\n    ever.\nother: no.\n\nArgs:\n    width: in px."
    assert fields(text) == text.replace("name:", "- `name`:").replace("  when:", "\n- `when`:").replace(
        "other:", "- `other`:"
    )


def test_a_slider_of_the_gallery_moves_by_mouse_and_keys_and_its_lens_shows_both_pictures(watched, hooks, tmp_path):
    names = ("chair-r_136-100-classic.webp", "chair-r_136-100-auto.webp")
    images = "".join(f'<img alt="{name[16:-5]}" src="{(FOLDER / name).as_uri()}">' for name in names)
    script, style = hooks["script"](), hooks["style"]()
    (tmp_path / "page.html").write_text(
        f"<!doctype html><style>{style}</style><div class=compare>{images}</div><script>{script}</script>"
    )
    gallery = watched(width=390, height=844)
    gallery.goto((tmp_path / "page.html").as_uri())
    gallery.wait_for_selector(".compare[data-split='0.500']")
    drag(gallery, (0.5, 0.2), (0.25, 0.2), on=".stage canvas")
    gallery.wait_for_selector(".compare[data-split='0.250']")
    gallery.locator(".stage").press("]")
    gallery.wait_for_selector(".compare[data-split='0.270']")
    gallery.locator("input[type=range]").fill("80")
    gallery.wait_for_selector(".compare[data-split='0.800']")
    assert gallery.locator(".crops canvas").count() == 0
    gallery.locator("input[type=checkbox]").check()
    assert gallery.locator(".crops canvas").count() == 2
    assert gallery.locator(".crops").inner_text().split() == ["classic", "auto"]


PAGE = f"""# Page

```bash
aaplug evaluate some/folder/scene.ply --cameras path/to/colmap --recipe classic mip auto matched
```

| a name of one word | zebras |
|---|---|
| `supersplat-classic` | {"many more words " * 40}|
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A page with our theme, styles and hooks, but without the texts of the API."""
    pytest.importorskip("material")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    folder = tmp_path_factory.mktemp("a &lt b")
    (folder / "guides").mkdir()
    (folder / "guides" / "page.md").write_text(PAGE)
    places = {"docs_dir": str(folder / "guides"), "site_dir": str(folder / "out")}
    build(load_config(str(SITE / "mkdocs.yml"), **places, plugins=["search"], nav=[{"Page": "page.md"}]))
    return folder / "out"


@pytest.mark.parametrize("width", [1280, 390])
def test_a_page_that_is_opened_from_its_folder_is_whole_and_can_be_searched(watched, site, width):
    page = watched(width=width, height=844)
    page.goto(f"file://{site}/page.html")
    for _ in range(5):
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.type") != "radio"  # of colours, which nobody sees
    assert page.evaluate("document.querySelector('td code').getClientRects().length") == 1
    code, button = (page.locator(f"pre > {part}").bounding_box() for part in ("code", ".md-code__nav"))
    assert code["x"] + code["width"] <= button["x"]
    page.locator(".md-header__button[for=__search]:visible, .md-search__input:visible").first.click()
    page.keyboard.type("zebra")
    assert "page.html?h=" in page.locator(".md-search-result__link").first.get_attribute("href")


def test_the_tour_runs(tmp_path, monkeypatch):
    nbclient, nbformat = (pytest.importorskip(package) for package in ("nbclient", "nbformat"))
    if importlib.util.find_spec("ipykernel") is None:
        pytest.skip("ipykernel is not installed")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    book = nbformat.read(TOUR, as_version=4)
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    nbclient.NotebookClient(book, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    text = "".join(out.get("text", "") for cell in book.cells for out in cell.get("outputs", ()))
    figures = {name: float(value) for name, value in re.findall(r"^(\w\S*) .* (\d+\.\d+)$", text, re.M)}
    assert figures["box-pixel"] > 30
    assert figures["auto"] > figures["mip"] > 25
    assert any("image/png" in out.get("data", {}) for cell in book.cells for out in cell.get("outputs", ()))


def test_the_tour_as_committed_was_run_in_order_and_knows_no_machine():
    text = TOUR.read_text()
    code = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert not any("traceback" in out for cell in code for out in cell["outputs"])
    assert len(text) < 300_000
    said = re.sub(r'"image/png": "[^"]*"', "", text)
    assert not re.search(r"[\s\"'=(](/[\w.-]+){3}", said)  # an absolute path
