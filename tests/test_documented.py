"""Whatever README, the guides and the examples show runs as it stands, with small files of the names that it uses."""

import json
import os
import re
import runpy
import shlex
import shutil
import tomllib
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from aaplug_cli.main import main
from aaplug_cli.verbs import VERBS
from PIL import Image

from aaplug import Gaussians, read_cameras, read_scene, write_scene
from aaplug.options.verbs import BUILT_IN_PATHS
from tests.conftest import GUIDES, ROOT, SAMPLE, write_model

EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
GAUSSIANS = 80
SIZE = 24  # px: side of the photographs
TRAINING = 3  # cameras
RUN_BY_THE_GATE = "<!-- "  # stands before README's blocks that .ci/run executes
SHORTER = {  # options that make a documented command quicker; they come last, so they take precedence
    "finetune": ["--steps", "2"],
    "lod": ["--steps", "2"],
    "video": ["--seconds", "0.1"],
    "bench": ["--repeats", "1", "--gaussians", "100"],
}
FITTING = ["--steps", "2"]  # of `convert --for`, likewise
ONE_WORKER = ["--threads", "1"]  # of `--scheduler local`
TRAINER = """
import torch
from gsplat import DefaultStrategy, rasterization, spherical_harmonics

assert __name__ == "__main__"
means, quats, scales = torch.zeros(1, 3).cuda(), torch.ones(1, 4), torch.ones(1, 3)
colors = spherical_harmonics(0, means + 1, torch.ones(1, 1, 3))
pose, K = torch.eye(4)[None], torch.tensor([[[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]])
pose[:, 2, 3] = 3
image, _, _ = rasterization(means, quats, scales, torch.ones(1), colors, pose, K, 8, 8)
torch.save(image, "trained.pt")
"""
NERFBASELINES = (
    "nerfbaselines train --method aaplug --data chair --output run"
    " --set scene=$PWD/chair.ply --backend python --disable-output-artifact",
    "nerfbaselines render --checkpoint run/checkpoint-0 --data chair --output predictions --backend python",
    "nerfbaselines evaluate predictions --output results.json",
)
ELSEWHERE = {  # what runs commands of the tests and benches themselves instead
    "ten minutes; needs scenes beside the repository": ["python -m tests.bench method_tables"],
    "test_site.py compares the page with what it writes": ["python -m tests.bench claims"],
    "ten seconds; test_site.py draws the figure of the tables": ["python -m tests.bench pictures"],
    "minutes; needs Node.js and Chromium": ["python -m tests.bench viewers"],
    "about an hour in all": [
        f"python -m tests.bench {name}" for name in ("campaign", "odd_options", "full_disks", "kills")
    ],
    "the gate installs it from constraints.txt": ["pip install -e '.[view]'", "pip install -e '.[cluster]'"],
    "test_cluster.py, with processes of its own": [
        "aaplug convert --batch scenes.toml -o converted --scheduler local --threads 2",
        "dask scheduler",
        "dask worker tcp://host:8786 --nworkers 16 --nthreads 1 --memory-limit 0",
        "aaplug evaluate --batch batch.toml -o results --scheduler tcp://host:8786",
    ],
    "test_view.py: it ends when it is interrupted": [
        f"aaplug view{words}" for words in ("", " scene.ply", " scene.ply --cameras path/to/colmap --port 8123")
    ],
    "test_conform.py runs programs": [
        'aaplug conform "aaplug render {scene} --cameras {camera} --min-seen 0 -o {image} --recipe mip" --for mip'
    ],
    "test_nerfbaselines.py, where the package is": NERFBASELINES,
    ".ci/run, twice for a third as long": ["python -m tests.guided -max_total_time=60"],
}
RUN_ELSEWHERE = {command for commands in ELSEWHERE.values() for command in commands}


class Block(NamedTuple):
    """A fenced block.  file: its name in the guide, from a first comment line."""

    document: str
    number: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.document}-{self.number}-{self.language}"


FENCED = re.compile(r"(^<!-- .*-->\n)?^```(\w*)\n(.*?)^```$", re.M | re.S)
BLOCKS = [
    Block(path.stem, number, match[2], match[3])
    for path in (ROOT / "README.md", *GUIDES)
    if path.stem != "contributing"  # test_plugin.py runs its blocks, with its plug-in installed
    for number, match in enumerate(FENCED.finditer(path.read_text()), 1)
    if not (match[1] or "").startswith(RUN_BY_THE_GATE)
]
COMMANDS = [block for block in BLOCKS if block.language == "bash"]
PROGRAMS = [block for block in BLOCKS if block.language == "python"]
TABLES = [block for block in BLOCKS if block.language == "toml"]


def few(scene: Gaussians) -> Gaussians:
    """The largest Gaussians of a scene, which any view shows."""
    return scene[scene.log_scales.sum(dim=1).topk(GAUSSIANS).indices.sort().values]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds every file that the documents name."""
    folder = tmp_path_factory.mktemp("documented")
    scene = replace(few(read_scene(SAMPLE / "chair.ply").gaussians()), origin=None)
    for name in ("scene.ply", "a.ply", "b.ply", "chair.ply", "toy/point_cloud.ply"):
        (folder / name).parent.mkdir(exist_ok=True)
        write_scene(folder / name, scene)
    for name in ("path/to/colmap", "chair", "toy"):
        write_cameras(folder / name)
    cameras, photographs = read_cameras(folder / "chair"), folder / "chair" / "test"
    arguments = "eval=True, images='images', resolution=1, white_background=True"
    for name in ("scene", "garden", "bicycle"):
        model = write_model(folder / "output" / name, (*cameras.test, *cameras.train), arguments, scene, 7)
        shutil.copytree(photographs, model / "images")
        for camera in cameras.train:
            shutil.copy(photographs / "r_8.png", model / "images" / f"{camera.name}.png")
    (folder / "trainer.py").write_text(TRAINER)
    (folder / "camera_path.json").write_text(json.dumps(camera_path(folder / "chair")))
    for block in TABLES:
        name = re.match(r"# (\S+)\n", block.text)
        assert name is not None, f"{block} does not say in a first comment which file it is"
        (folder / name[1]).write_text(block.text)
    return folder


def write_cameras(folder: Path) -> None:
    """The sample's cameras, a few of them, with small photographs of two test views."""
    (folder / "test").mkdir(parents=True)
    for split, count in (("train", TRAINING), ("test", 2)):
        data = json.loads((SAMPLE / f"transforms_{split}.json").read_text())
        step = len(data["frames"]) // count if split == "train" else 1
        data |= {"frames": data["frames"][::step][:count], "w": SIZE, "h": SIZE}
        (folder / f"transforms_{split}.json").write_text(json.dumps(data))
    for name in ("r_8.png", "r_24.png"):
        with Image.open(SAMPLE / "test" / name) as image:
            image.resize((SIZE, SIZE)).save(folder / "test" / name)


def camera_path(folder: Path) -> dict[str, object]:
    """Two frames of nerfstudio's camera path, at poses of a Blender data set, whose axes are the same."""
    frames = json.loads((folder / "transforms_test.json").read_text())["frames"]
    path = [{"camera_to_world": list(chain(*frame["transform_matrix"])), "fov": 40.0} for frame in frames]
    return {"render_width": SIZE, "render_height": SIZE, "fps": 10, "camera_path": path}


@pytest.fixture
def here(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plots_drawn_once: None) -> Path:
    """A fresh copy of the folder, to run in."""
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_there_are_blocks_of_every_kind_and_examples():
    assert len(COMMANDS) > 15
    assert all((PROGRAMS, TABLES, EXAMPLES))
    assert {block.language for block in BLOCKS} <= {"bash", "python", "toml", "json"}
    assert {line for block in COMMANDS for line in lines_of(block)} >= RUN_ELSEWHERE


@pytest.mark.parametrize("block", COMMANDS, ids=str)
def test_documented_commands_run(block, here, capsys):
    before = set(here.rglob("*"))
    for line in lines_of(block):
        if line in RUN_ELSEWHERE:
            continue
        program, verb, *words = shlex.split(re.sub(r"--resolution \d+x\d+", "--resolution 64x36", line))
        assert program == "aaplug", f"{line}: run this too, or say in ELSEWHERE who does"
        shorter = FITTING if verb == "convert" and "--for" in words else SHORTER.get(verb, [])
        shorter = ONE_WORKER if "local" in words else shorter
        if verb == "video" and "--path" in words and words[words.index("--path") + 1] not in BUILT_IN_PATHS:
            shorter = []  # a file says itself how long it is
        with pytest.raises(SystemExit) as stop:
            main([verb, *words, *shorter])
        printed = capsys.readouterr()
        assert not stop.value.code, f"{line}\n{printed.err}"
        if {"-o"} & set(words):
            output = here / words[words.index("-o") + 1].replace("####", "0001")  # a sequence's first frame
            assert output.exists(), f"{line} wrote no {output.name}"
            assert output not in before, f"{line} names an input as its output"
        else:
            assert printed.out, f"{line} printed nothing"


def lines_of(block: Block) -> list[str]:
    """The commands of a block, without comments and with continued lines joined."""
    joined = block.text.replace("\\\n", " ").splitlines()
    return [line.strip() for line in joined if line.strip() and not line.startswith("#")]


@pytest.mark.parametrize("block", PROGRAMS, ids=str)
def test_documented_programs_run(block, here, monkeypatch):
    if "aaplug.gsplat.patch()" in block.text:
        pytest.importorskip("gsplat", reason="the package gsplat is not installed")
        monkeypatch.setattr(torch.Tensor, "cuda", torch.Tensor.cuda)  # the program replaces it
    before = set(os.listdir(here))
    (here / "program.py").write_text(block.text)
    variables = runpy.run_path("program.py")
    image = variables.get("image")
    wrote = set(os.listdir(here)) - before - {"program.py"}
    assert wrote or (image is not None and image.std() > 0.01), "the program shows nothing"


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, tmp_path, capsys):
    runpy.run_path(str(example))["main"](tmp_path)
    assert capsys.readouterr().out


@pytest.mark.parametrize("block", TABLES, ids=str)
def test_documented_tables_are_used_by_a_command(block):
    assert tomllib.loads(block.text)
    name = block.text.split()[1]
    assert any(name in command.text for command in COMMANDS)


def test_links_between_documents_lead_somewhere():
    for path in (ROOT / "README.md", ROOT / "CHANGELOG.md", *GUIDES):
        for target in re.findall(r"\]\((?!http)([^)#]+)(?:#[^)]*)?\)", path.read_text()):
            assert (path.parent / target).exists(), f"{path.name}: {target}"


def test_every_option_in_the_documents_exists():
    text = "\n".join(path.read_text() for path in (ROOT / "README.md", *GUIDES))
    known = {"--help"} | {flag for verb in VERBS.values() for option in verb.options.values() for flag in option.flags}
    named = set(re.findall(r"`(--[a-z][a-z-]+)", text))
    # of 3DGS's own scripts, of splat-transform, of nerfbaselines, of Dask
    others = {"--antialiasing", "--decimate", "--decimate-adaptive", "--set", "--memory-limit"}
    assert named - known - others == set()
    for verb, words in re.findall(r"(?<!`)`aaplug ([a-z-]+)\s([^`]+)`", text):
        flags = {flag for option in VERBS[verb].options.values() for flag in option.flags}
        assert set(re.findall(r"(?<!\S)--[a-z][a-z-]+", words)) <= flags, f"aaplug {verb} {words}"
