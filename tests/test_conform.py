"""The kit that names what a renderer does wrong: on renderers with one thing broken, and on right ones."""

import json
import shlex
import sys
from functools import cache
from pathlib import Path

import pytest
import torch

import aaplug
from aaplug import AaplugError, Renderer, UsageError, read_cameras, read_image, write_png
from aaplug.core.imaging import quantised
from aaplug.evaluation import conformance
from aaplug.evaluation.conformance import CAMERA, FAULTS, NONE, TESTS, Conformance, Fault, judged
from aaplug.methods.presets import recipe_of
from aaplug.methods.viewers import VIEWERS, Viewer
from tests.conftest import ALL_RASTERIZERS
from tests.test_gsplat import composited

CLASSIC = VIEWERS["classic"]
BROKEN = [  # the ten things of the issue, and others that renderers were seen to do
    "dilation: nothing", "dilation: twice", "compensation: opacity pays", "cut-off", "quads are mirrored",
    "quaternions are read as xyzw", "degree 1 is taken in the order", "degree 1 lacks its minus", "f_rest is read",
    "above degree 2", "encoded once too often",
    "blended in linear light", "nearer than 1 are not", "nearer than 0.01 are", "behind the camera",
    "the farthest splat", "in the file's order", "the stored logit", "capped at 0.9", "half a pixel too far right",
    "upside down",
]  # fmt: skip
CONVENTIONS = ("classic", "antialiased", "mip", "playcanvas", "playcanvas-classic")


@pytest.fixture(scope="module", autouse=True)
def drawn_once():
    """What is expected of a renderer is drawn once for all of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conformance, "draw", cache(conformance.draw))
        yield


def fault(words: str) -> Fault:
    [found] = [fault for fault in FAULTS if words in fault.words]
    return found


def pictures(viewer: Viewer, broken: Fault = NONE, white: bool = False) -> dict[str, torch.Tensor | str]:
    """As a renderer stores them."""
    return {test.name: quantised(conformance.draw(test.scene, viewer, broken, white).float()) for test in TESTS}


def wrongs(verdict: Conformance) -> set[str]:
    return {finding.wrong for finding in verdict.findings if finding.wrong}


@pytest.mark.parametrize("words", BROKEN)
def test_a_broken_renderer_is_named(words):
    broken = fault(words)
    verdict = judged(pictures(CLASSIC, broken, white=len(words) % 2 == 0), CLASSIC)
    assert wrongs(verdict) == {broken.words}
    assert not verdict.right


def test_the_rule_is_found_where_none_is_stated(monkeypatch):
    verdict = judged(pictures(VIEWERS["mip"]))
    assert (verdict.viewer.name, verdict.stated, verdict.right) == ("mip", False, True)
    stated = judged(pictures(VIEWERS["mip"]), CLASSIC)
    assert wrongs(stated) == {"dilation: 0.1 px², compensated, as mip does"}
    monkeypatch.setattr(conformance, "VIEWERS", {name: VIEWERS[name] for name in ("mip", "classic")})  # of many faults
    verdict = judged(pictures(CLASSIC, fault("upside down")))
    assert (verdict.viewer.name, wrongs(verdict)) == ("classic", {"the picture is upside down"})


def test_one_odd_picture_does_not_change_the_rule():
    """A picture that the rule of another viewer explains better, and no other does."""
    names = ("dilation", "compensation", "gamma")
    seen, others = (pictures(VIEWERS[name], white=True) for name in ("antialiased", "classic"))
    seen["gamma"] = seen["gamma"] + 4 * (others["gamma"] - seen["gamma"])
    verdict = judged({name: seen[name] if name in names else "none" for name in seen})
    assert verdict.viewer.name == "antialiased"
    assert [finding.test for finding in verdict.findings if finding.wrong and finding.error is not None] == ["gamma"]


def test_what_no_fault_explains_is_shown_where_it_is():
    seen = pictures(CLASSIC)
    seen["order"] = seen["order"].clone()
    seen["order"][3:9, 40:46] = 1.0
    [finding] = [f for f in judged(seen, CLASSIC).findings if f.wrong]
    assert finding.test == "order"
    assert finding.wrong == "differs by up to 255 levels of 255, most at x 40, y 3"


@pytest.mark.parametrize("viewer", CONVENTIONS)
@pytest.mark.parametrize("rasterizer", ALL_RASTERIZERS.values(), ids=ALL_RASTERIZERS)
def test_no_rasterizer_of_ours_is_accused(viewer, rasterizer):
    def drawn(scene):
        renderer = Renderer.of(scene, [CAMERA], recipe_of(viewer_of), rasterizer=rasterizer, min_seen=0.0)
        return quantised(renderer(CAMERA).rgb)

    viewer_of = VIEWERS[viewer]
    verdict = judged({test.name: drawn(test.stored) for test in TESTS}, viewer_of)
    assert wrongs(verdict) == set()
    assert all(f.error < 1 for f in verdict.findings)  # in levels of 255: rounding, and float32
    # on the middle row a round one lies along x, and PlayCanvas's axes are 0/0
    assert all(abs(spot.y - CAMERA.height / 2) > 0.1 for test in TESTS for spot in test.spots)


@pytest.mark.parametrize("viewer", ["gsplat", "gsplat-mip", "gsplat-classic"])
def test_gsplats_torch_code_is_not_accused(viewer):
    theirs = pytest.importorskip("gsplat.cuda._torch_impl", reason="the package gsplat is not installed")
    rule = VIEWERS[viewer].convention
    matrix = torch.tensor([[[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]]])
    pose = CAMERA.cam_from_world.float()[None]

    def drawn(scene):
        sigma, _ = theirs._quat_scale_to_covar_preci(scene.unit_quats, scene.scales, compute_preci=False)
        how = {"eps2d": rule.kernel, "calc_compensations": True}
        radii, means, depths, conics, paid = theirs._fully_fused_projection(
            scene.means, sigma, pose, matrix, CAMERA.width, CAMERA.height, **how
        )
        sight = scene.means - CAMERA.centre.float()
        colours = (theirs._spherical_harmonics(3, sight, scene.sh) + 0.5).clamp(min=0)
        opacities = scene.opacities * paid if rule.compensated else scene.opacities[None]
        meta = {"radii": radii, "means2d": means, "depths": depths, "conics": conics, "opacities": opacities}
        return quantised(composited(meta, colours, 0, size=CAMERA.hw[::-1])[0].float())

    assert wrongs(judged({test.name: drawn(test.scene) for test in TESTS}, VIEWERS[viewer])) == set()


# --------------------------------------------------------------------------------------------------- programs, files

PROGRAM = """
import pathlib, shutil, sys

scene, camera, image = map(pathlib.Path, sys.argv[1:])
if scene.stem == "order":
    sys.exit("no such order")
if scene.stem != "gamma":
    shutil.copy(pathlib.Path(__file__).parent / "right" / "expected" / image.name, image)
"""


def test_a_program_that_fails_at_times(tmp_path):
    assert aaplug.conform(output=tmp_path / "right") is None
    write_png(tmp_path / "right" / "expected" / "degree.png", torch.zeros(64, 32, 3), overwrite=True)
    (tmp_path / "draw.py").write_text(PROGRAM)
    command = f"{shlex.quote(sys.executable)} {tmp_path / 'draw.py'}"
    verdict = aaplug.conform(command, output=tmp_path / "kit")
    told = {finding.test: finding.wrong for finding in verdict.findings if finding.wrong}
    assert told == {
        "order": "no picture: the program ended with code 1: no such order",
        "gamma": "no picture: there is no gamma.png",
        "degree": "no picture: expected 64x64 px, got 32x64",
    }
    [camera] = json.loads((tmp_path / "kit" / "order.json").read_text())
    assert camera.keys() == {"id", "img_name", "width", "height", "position", "rotation", "fx", "fy"}
    [view] = read_cameras(tmp_path / "kit" / "order.json").train
    assert torch.allclose(view.cam_from_world, CAMERA.cam_from_world)
    with pytest.raises(AaplugError, match="pass `overwrite`"):
        aaplug.conform(command, output=tmp_path / "kit")


def test_pictures_by_hand(cli, tmp_path):
    cli.done("conform -o kit")
    assert len(list(Path("kit").glob("*.ply"))) == len(list(Path("kit/expected").glob("*.png"))) == len(TESTS) == 10
    code, out, err = cli("conform --images kit/expected")
    assert (code, out.count("right")) == (0, 10)
    assert "expected: classic (3DGS: 0.3 px², not compensated), which fits best" in err
    Path("kit/expected/order.png").write_bytes(b"no picture")
    write_png("kit/expected/gamma.png", read_image("kit/expected/gamma.png") ** (1 / 2.2), overwrite=True)
    code, out, _ = cli("conform --images kit/expected --for classic --json")
    verdict = json.loads(out)
    wrong = {test["test"]: test["wrong"] for test in verdict["tests"] if test["wrong"]}
    assert (code, verdict["right"], wrong.keys()) == (1, False, {"order", "gamma"})
    assert wrong["gamma"] == "gamma: values are encoded once too often (too bright)"
    assert wrong["order"].startswith("no picture: ")


def test_what_contradicts_itself_is_refused(tmp_path):
    for words, problem in [
        ({}, "name a program"),
        ({"program": "x", "images": tmp_path}, "gives the pictures, as `program` does"),
        ({"program": "nowhere/at-all"}, "cannot be started: nowhere/at-all: no such file"),
        ({"program": "sh -c 'echo no such scene >&2; exit 3'"}, "none of 10 pictures: .*code 3: no such scene"),
        ({"images": tmp_path}, "images: gave none of 10 pictures: there is no dilation.png"),
        ({"program": "'open"}, "is no command line"),
        ({"images": tmp_path, "viewer": "nope"}, "nope"),
    ]:
        with pytest.raises(UsageError, match=problem):
            aaplug.conform(**words)


def test_a_stale_picture_is_not_judged(tmp_path):
    how = {"viewer": "classic", "output": tmp_path / "kit"}
    aaplug.conform(lambda scene, camera, image: write_png(image, torch.zeros(64, 64, 3)), **how)
    with pytest.raises(UsageError, match=r"none of 10 pictures: there is no dilation\.png"):
        aaplug.conform(lambda *paths: None, **how, overwrite=True)
