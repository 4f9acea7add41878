"""All levels in one scene, for Multi-Scale 3DGS' selection by pixel size (Yan et al., CVPR 2024, arXiv 2311.17089).

Its rule never leaves out a Gaussian of 2 px or more as too small.  So a level merges only Gaussians that are smaller in
50 training views, and these are what it replaces; what is larger stays for all sizes.  Its rasterizer dilates by
0.3 px² at any size.  So a merged Gaussian is thinner by that much, in pixels of the highest rate that it is drawn at:
any thinner, and surfaces would have holes there.

A Gaussian of level k is drawn from 2^-(k - 1/2) of training's sampling rate down to 2^-(m - 1/2), where level m
replaces it.  Its pixel size differs from view to view: the recorded one is the geometric middle of the training views',
so there are views in which a Gaussian and what replaces it are both drawn, or neither, at rates near to these.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera, spread
from aaplug.core.conventions import CLASSIC
from aaplug.core.convolution import fuse_stored
from aaplug.core.gaussians import Fusion, Gaussians, joined
from aaplug.core.projection import project
from aaplug.lab.pixel_size import LEAST_SHARE, MAX_SMALL_SIZE, MOST_SHARE, PixelSizes, pixel_size
from aaplug.levels.clusters import clusters_of, gaussians_of, rates_of
from aaplug.levels.merging import Goal, rounds
from aaplug.methods.conversion import MERGED
from aaplug.system.errors import UsageError
from aaplug.system.monitor import Tell

TOLERANCE = 1e-2  # px² of the level, as in `merging`: what a level does not merge is dilated, which is worse
VIEWS = 50  # training views that sizes are taken from
HALF_LEVEL = 2**0.5  # half a level, as a ratio of sampling rates


class _Part(NamedTuple):
    """Gaussians, and the level that each was merged for: 0 for none."""

    scene: Gaussians
    level: Int[Tensor, " n"]

    @classmethod
    def of(cls, scene: Gaussians, level: int = 0) -> "_Part":
        return cls(replace(scene, origin=None, extras={}), torch.full((len(scene),), level))

    @classmethod
    def joined(cls, parts: Sequence["_Part"]) -> "_Part":
        return cls(joined([part.scene for part in parts]), torch.cat([part.level for part in parts]))

    def where(self, mask: Bool[Tensor, " n"]) -> "_Part":
        return _Part(self.scene[mask], self.level[mask])


def in_one_scene(
    scene: Gaussians, cameras: Sequence[Camera], levels: int, tell: Tell = lambda done, total: None
) -> Gaussians:
    """The scene and its levels, with the pixel sizes by which Multi-Scale 3DGS draws each at its own size.

    Raises:
        UsageError: training did not dilate the scene by 3DGS's 0.3 px², or it holds 2D Gaussians.
        FrameError: no camera sees any.
    """
    if scene.convention != CLASSIC or scene.flat:
        what = "2D Gaussians" if scene.flat else f"a scene of the convention '{scene.convention.name}'"
        raise UsageError(scene.name, f"is {what}; Multi-Scale 3DGS draws 3D Gaussians by the convention 'classic'")
    remaining, done = _Part.of(fuse_stored(scene)), []
    for level in range(1, levels + 1):
        tell(level - 1, levels)
        largest = pixel_sizes(remaining.scene, cameras)[1]
        small, rates = (largest > 0) & (largest / 2**level < MAX_SMALL_SIZE), rates_of(remaining.scene, cameras)
        remaining, gone = _merged(remaining.where(~small), remaining.where(small), rates[small], level)
        done.append(gone)
    parts = [remaining, *done]
    whole, levels_of = _Part.joined(parts)
    replaced = torch.cat([torch.full((len(part.scene),), level) for level, part in enumerate(parts)])  # by which level
    least, most = pixel_sizes(whole, cameras)
    middle = (least * most).sqrt()
    smallest = torch.where(replaced > 0, middle * _highest_rate(replaced) / LEAST_SHARE, 0.0)
    greatest = torch.where(levels_of > 0, middle * _highest_rate(levels_of) / MOST_SHARE, 0.0)
    record = Fusion(MERGED, {"levels": str(levels), "from": str(len(scene))})
    sizes = PixelSizes(smallest, greatest, (levels_of == 0) & (replaced == 0))
    return replace(whole, extras=sizes.extras, fused=(*scene.fused, record))


def pixel_sizes(scene: Gaussians, cameras: Sequence[Camera]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Smallest and largest pixel size of each Gaussian in the cameras' images; 0 for one whose middle none shows."""
    least, most = torch.full((len(scene),), torch.inf), torch.zeros(len(scene))
    for camera in spread(cameras, VIEWS):
        splats = project(scene, camera)
        sides = torch.tensor([camera.width, camera.height]).to(splats.means)
        splats = splats[((splats.means >= 0) & (splats.means <= sides)).all(dim=1)]
        rows, size = splats.sources, pixel_size(splats).float()
        least[rows], most[rows] = least[rows].minimum(size), most[rows].maximum(size)
    return least.where(least.isfinite(), 0.0), most


def _highest_rate(levels: Int[Tensor, " *n"]) -> Float[Tensor, " *n"]:
    """Highest sampling rate, relative to training's, at which Gaussians of a level are drawn."""
    return torch.where(levels > 0, HALF_LEVEL * 0.5**levels, 1.0)


def _merged(large: _Part, small: _Part, rates: Float[Tensor, " s"], level: int) -> tuple[_Part, _Part]:
    """The Gaussians that are drawn after a level, and those that it replaces; rates: of the small ones."""
    if not len(small.scene):
        return large, small
    covered = replace(clusters_of(small.scene, rates * _highest_rate(small.level)), rates=rates)
    clusters = rounds(covered, Goal(0.5**level, tolerance=TOLERANCE), lambda count: None)
    counts = torch.bincount(clusters.labels, minlength=len(clusters))
    merged = gaussians_of(
        replace(clusters, rates=clusters.rates * _highest_rate(torch.tensor(level))), small.scene, covered.weights
    )
    replaced = counts[clusters.labels] > 1
    fresh = _Part.of(merged[counts > 1], level)
    return _Part.joined([large, small.where(~replaced), fresh]), small.where(replaced)
