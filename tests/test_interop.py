"""Converted files in somebody else's reader: splat-transform, where it is installed."""

import shutil
import subprocess

import pytest
import torch

from aaplug.conversion import FORMS, convert
from aaplug.io.scenes import read_scene, write_scene

SPLAT_TRANSFORM = shutil.which("splat-transform")  # of the npm package @playcanvas/splat-transform


@pytest.mark.skipif(SPLAT_TRANSFORM is None, reason="splat-transform is not installed")
@pytest.mark.parametrize("form", FORMS)
def test_splat_transform_reads_a_converted_scene(form, sample_scene, sample_training, tmp_path):
    write_scene(tmp_path / "converted.ply", convert(sample_scene, sample_training, FORMS[form]))
    words = [SPLAT_TRANSFORM, "-w", str(tmp_path / "converted.ply"), str(tmp_path / "theirs.ply")]
    subprocess.run(words, check=True, capture_output=True, timeout=120)
    ours, theirs = (read_scene(tmp_path / name) for name in ("converted.ply", "theirs.ply"))
    assert len(theirs) == len(ours)
    order = [scene.means[:, 0].argsort(stable=True) for scene in (ours, theirs)]  # it may sort
    for field in ("log_scales", "logit_opacities"):
        a, b = (getattr(s, field)[o] for s, o in zip((ours, theirs), order, strict=True))
        torch.testing.assert_close(a, b)
