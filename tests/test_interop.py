"""Files of ours in somebody else's reader, and of theirs in ours: splat-transform and pycolmap, where installed."""

import re
import shutil
import subprocess
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from aaplug import read_cameras, read_scene, write_scene
from aaplug.core.conventions import ANTIALIASED, CLASSIC, CONVENTIONS, MIP
from aaplug.methods.conversion import FORMS, fuse
from tests.scene_files import ORACLE

OLDEST = 3  # major version: before, it wrote .spz in other axes and without a flag


def splat_transform() -> str | None:
    """The program of the npm package @playcanvas/splat-transform, if it is there and not too old."""
    program = shutil.which("splat-transform")
    if program is None:
        return None
    command = [program, "--version"]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    version = re.search(r"\bv?(\d+)\.", run.stderr + run.stdout)  # it tells on stderr
    return program if version is not None and int(version[1]) >= OLDEST else None


SPLAT_TRANSFORM = splat_transform()
needs_it = pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="splat-transform 3 is not installed")


def transformed(*paths: Path) -> None:
    """Let the program write each file from the one before."""
    for source, target in pairwise(paths):
        words = [SPLAT_TRANSFORM, "-q", "-w", "-g", "cpu", str(source), str(target)]
        subprocess.run(words, check=True, capture_output=True, timeout=120)


@needs_it
@pytest.mark.parametrize("form", FORMS)
def test_splat_transform_reads_a_converted_scene(form, sample_scene, sample_training, tmp_path):
    write_scene(tmp_path / "converted.ply", fuse(sample_scene, sample_training, FORMS[form]))
    transformed(tmp_path / "converted.ply", tmp_path / "theirs.ply")
    ours, theirs = (read_scene(tmp_path / name).gaussians() for name in ("converted.ply", "theirs.ply"))
    assert len(theirs) == len(ours)
    order = [scene.means[:, 0].argsort(stable=True) for scene in (ours, theirs)]  # it may sort
    for field in ("log_scales", "logit_opacities"):
        a, b = (getattr(s, field)[o] for s, o in zip((ours, theirs), order, strict=True))
        torch.testing.assert_close(a, b)


@needs_it
@pytest.mark.parametrize("suffix", [".compressed.ply", ".sog", ".spz", ".ply"])
def test_what_splat_transform_packs_is_read_as_it_unpacks_it(suffix, tmp_path):
    packed, unpacked = tmp_path / f"packed{suffix}", tmp_path / "unpacked.ply"
    transformed(ORACLE, packed, unpacked)
    ours, theirs = read_scene(packed, spz_axes="opencv").gaussians(), read_scene(unpacked).gaussians()
    for field in ("means", "log_scales", "logit_opacities", "sh"):
        torch.testing.assert_close(getattr(ours, field), getattr(theirs, field), rtol=0, atol=1e-5)
    assert (ours.unit_quats * theirs.unit_quats).sum(dim=1).abs().min() > 0.9999
    assert ours.convention.compensated
    assert theirs.convention.compensated


@needs_it
@pytest.mark.parametrize("suffix", [".compressed.ply", ".sog", ".spz", ".ply"])
@pytest.mark.parametrize("convention", CONVENTIONS.values(), ids=CONVENTIONS)
def test_what_survives_splat_transform_is_whether_training_compensated(suffix, convention, tmp_path):
    """Its one bit is read as the Mip rule, for which `convert` makes scenes; another kernel is lost, which is said."""
    source, packed, unpacked = (tmp_path / name for name in ("source.ply", f"packed{suffix}", "unpacked.ply"))
    write_scene(source, replace(read_scene(ORACLE).gaussians(), convention=convention))
    transformed(source, packed, unpacked)
    for path in (packed, unpacked):
        found = read_scene(path)
        assert found.convention == (MIP if convention.compensated else CLASSIC)
        assert ("its kernel is not recorded" in found.evidence) == convention.compensated


@needs_it
@pytest.mark.parametrize("convention", [CLASSIC, ANTIALIASED])
def test_splat_transform_reads_our_spz(convention, tmp_path):
    ours, path = replace(read_scene(ORACLE).gaussians(), convention=convention), tmp_path / "ours.spz"
    write_scene(path, ours, spz_axes="opencv")
    transformed(path, tmp_path / "theirs.ply")
    theirs, again = read_scene(tmp_path / "theirs.ply").gaussians(), read_scene(path, spz_axes="opencv").gaussians()
    torch.testing.assert_close(theirs.means, ours.means, rtol=0, atol=2e-6)
    torch.testing.assert_close(theirs.log_scales, ours.log_scales, rtol=0, atol=1 / 32 + 1e-5)
    for field in ("means", "log_scales", "logit_opacities", "sh"):
        torch.testing.assert_close(getattr(again, field), getattr(theirs, field), rtol=0, atol=1e-5)
    assert (ours.unit_quats * theirs.unit_quats).sum(dim=1).abs().min() > 0.9999
    assert theirs.convention.compensated == convention.compensated


@pytest.mark.data
@pytest.mark.parametrize(
    "model", ["myhan/sparse/0", "upup/sparse/0", "bartoszek/sparse/0", "colmap_multicam/colmap_sparse/0"]
)
def test_colmap_models_are_read_as_pycolmap_reads_them(model, shared_data):
    pycolmap = pytest.importorskip("pycolmap")
    folder = shared_data / "formats" / "colmap" / model
    theirs = pycolmap.Reconstruction(str(folder))
    ours = read_cameras(folder, test_every=0).all
    images = sorted(theirs.images.values(), key=lambda image: image.name)
    assert len(ours) == len(images)
    for camera, image in zip(ours, images, strict=True):
        lens, motion = image.camera, image.cam_from_world()
        assert (camera.width, camera.height) == (lens.width, lens.height)
        expected = (lens.focal_length_x, lens.focal_length_y, lens.principal_point_x, lens.principal_point_y)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(expected)
        pose = torch.from_numpy(motion.matrix())
        torch.testing.assert_close(camera.cam_from_world[:3], pose, rtol=0, atol=1e-9)
