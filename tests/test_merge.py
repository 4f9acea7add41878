"""Merging: scenes of several conventions, degrees and places in one file; and how a scene is placed."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

import aaplug
from aaplug import CameraSet, Fusion, TrainingViews, UsageError, read_scene
from aaplug.core.conventions import ANTIALIASED, CLASSIC, MIP
from aaplug.core.placing import mirrored, placed
from aaplug.core.projection import rotation_matrices
from aaplug.core.spherical_harmonics import sh_colour
from aaplug.io.limits import Memory
from aaplug.methods.conversion import carried
from aaplug.rendering.agreement import photo_of
from aaplug.rendering.renderer import own_look
from tests.conftest import make_scene, moved
from tests.scene_files import oracle

WHITE = (1.0, 1.0, 1.0)


def covariances(scene):
    axes = rotation_matrices(scene.unit_quats) * scene.scales[:, None]
    return axes @ axes.transpose(1, 2)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (90.0, 0.0, 0.0), (20.0, -70.0, 130.0)])
def test_a_placed_scene_is_seen_turned_and_as_large(angles):
    """Its points, its covariances and its colours go where a rigid motion and a scale take them."""
    scene, turn = oracle().to(torch.float64), torch.tensor(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    moved = placed(scene, turn, 3.0, (1.0, -2.0, 5.0))
    ways = torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64), dim=1)
    shift = torch.tensor([1.0, -2, 5], dtype=torch.float64)
    torch.testing.assert_close(moved.means, 3 * scene.means @ turn.T + shift)
    torch.testing.assert_close(covariances(moved), 9 * turn @ covariances(scene) @ turn.T)
    torch.testing.assert_close(sh_colour(moved.sh, ways @ turn.T), sh_colour(scene.sh, ways))
    again = placed(moved, turn.T, 1 / 3, (-turn.T @ shift / 3).tolist())
    for name in ("means", "log_scales", "sh"):
        torch.testing.assert_close(getattr(again, name), getattr(scene, name))


@pytest.mark.parametrize("signs", [(1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, 1.0)])
def test_a_mirrored_scene_is_seen_mirrored(signs):
    scene, ways = oracle(), torch.nn.functional.normalize(torch.randn(40, 3), dim=1)
    other, factors = mirrored(scene, signs), torch.tensor(signs)
    torch.testing.assert_close(sh_colour(other.sh, ways * factors), sh_colour(scene.sh, ways))
    torch.testing.assert_close(covariances(other), covariances(scene) * factors[:, None] * factors)
    again = mirrored(other, signs)
    assert all(torch.equal(getattr(again, name), getattr(scene, name)) for name in scene.columns)


def test_a_mixed_scene_looks_like_its_parts(sample_scene, sample_cameras):
    """A classic, a Mip-Splatting and an antialiased scene, merged, are within 0.5 dB of each drawn alone."""
    few = sample_scene[::4]
    training = TrainingViews.of(few, sample_cameras)
    parts = [carried(few, training, convention) for convention in (CLASSIC, MIP, ANTIALIASED)]
    moves = [(0.0, 0.0, 0.0), (300.0, 0.0, 700.0), (600.0, 0.0, 1400.0)]  # no view of one shows another
    merged = aaplug.merge(parts, sample_cameras, move=sum(moves, ()))
    assert (merged.convention, len(merged)) == (MIP, 3 * len(few))
    for part, move in zip(parts, moves, strict=True):
        there = CameraSet(
            *(tuple(moved(v, move) for v in views) for views in (sample_cameras.train, sample_cameras.test))
        )
        alone = own_look(part, TrainingViews.of(part, sample_cameras), background=WHITE)
        whole = own_look(merged, TrainingViews.of(merged, there), background=WHITE)
        view, same = (cameras.test[0].scaled(0.25) for cameras in (sample_cameras, there))
        truth = photo_of(sample_cameras.test[0], WHITE)(view)
        images = alone(view).rgb.clamp(0, 1), whole(same).rgb.clamp(0, 1)
        errors = torch.stack([(image - truth).square().mean().log10() * 10 for image in images])
        assert errors.diff() < 0.5, part.convention.name


def test_degrees_records_and_places_are_brought_together():
    first = replace(oracle(), sh=oracle().sh[:, :4], fused=(Fusion("merge", {"rate": "0.5"}),))
    second = replace(oracle(), filter_3d=torch.full((40,), 0.01), extras={"more": torch.zeros(40)})
    turns = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    merged = aaplug.merge([first, second], move=(0.0, 0.0, 0.0, 1.0, 2.0, 3.0), turn=turns, scale=(1.0, 2.0))
    assert (len(merged), merged.sh_degree, merged.convention) == (80, 3, MIP)
    assert [fusion.method for fusion in merged.fused] == ["merge", "filter_3D"]
    assert merged.filter_3d is None
    assert not merged.extras
    torch.testing.assert_close(merged.means[:40], first.means)
    torch.testing.assert_close(merged.sh[:40], torch.nn.functional.pad(first.sh, (0, 0, 0, 12)))
    half_turn = second.means * torch.tensor([-2.0, -2, 2]) + torch.tensor([1.0, 2, 3])
    torch.testing.assert_close(merged.means[40:], half_turn)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"move": (1.0, 2.0, 3.0)}, "move: expected 6 numbers for 2 scenes, got 3"),
        ({"turn": (0.0,) * 7}, "turn: expected 6 or 8 numbers for 2 scenes, got 7"),
        ({"turn": (0.0,) * 8}, "a quaternion, got one of length 0"),
        ({"scale": (1.0, 0.0)}, "scale: takes"),
        ({"into": "nothing"}, "into: 'nothing' is not one of"),
    ],
)
def test_places_that_do_not_fit_are_refused(options, problem):
    with pytest.raises(UsageError, match=problem):
        aaplug.merge([oracle(), oracle()], **options)


def test_all_scenes_together_should_fit_into_memory(monkeypatch):
    scene = make_scene(1000)
    monkeypatch.setattr("aaplug.io.limits.usable_memory", lambda: Memory(3e5, "this machine's {}"))
    assert len(aaplug.merge([scene])) == 1000
    with pytest.raises(UsageError, match=r"scenes: their 2,000 Gaussians take .* more than 50% of this machine's"):
        aaplug.merge([scene, scene])


def test_discs_and_ellipsoids_do_not_mix():
    flat = replace(oracle(), flat=True)
    with pytest.raises(UsageError, match="2D Gaussians"):
        aaplug.merge([oracle(), flat])
    with pytest.raises(UsageError, match="2D Gaussians"):
        aaplug.merge([flat], into="classic")
    with pytest.raises(UsageError, match="needs at least one, got none"):
        aaplug.merge([])


def test_the_command_merges_files_of_several_formats(cli):
    scene = read_scene("scene.ply").gaussians()
    aaplug.write_scene("b.glb", replace(scene, convention=MIP, origin=None))
    words = "merge scene.ply b.glb --cameras . -o c.sog --move 0,0,0 4,0,0 --turn 0,0,0 0,90,0 --json"
    out, err = cli.done(words)
    assert json.loads(out) == {"output": "c.sog", "gaussians": 2 * len(scene), "convention": "mip"}
    assert "converted from classic to mip, by" in err
    merged = read_scene("c.sog")
    assert (merged.count, merged.convention) == (2 * len(scene), MIP)
    assert [fusion.method for fusion in merged.fused] == ["matched-energy"]
    cli.refused("merge scene.ply b.glb -o scene.ply --overwrite", "is also the input")
    assert not list(Path().glob("*.tmp"))
