"""Pyramids: a scene with coarser levels of itself, and the cut of it that a view draws.

c: chunks, l: levels, n: Gaussians of all levels.  A chunk is a part of space.  No Gaussian stands for others of another
chunk, so each chunk is drawn at a level of its own, which its sampling rate decides.  Level k is meant for rates down
to 2⁻ᵏ of training's.  It is drawn alone from 3/4 of the rate of the level before down to its own; from there to 3/4 of
that, it fades into the next.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.lenses import PINHOLE
from aaplug.core.projection import JACOBIAN_MARGIN
from aaplug.core.rules import NEAR
from aaplug.core.runs import runs_of, starts_of
from aaplug.core.sights import sights
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.system.contracts import check_fields, contract
from aaplug.system.errors import UsageError

FADE_OCTAVES = math.log2(4 / 3)  # of the sampling rate, over which a level fades into the next
COARSENING_STEP = 1 / 4  # octaves between the coarser levels that are tried
OCTAVE_SLACK = 1e-4  # octaves: a rate this near to a level's is that level's
CUTOFF_SIGMAS = 3.33  # standard deviations at which an opaque Gaussian's alpha falls below 1/255
FILTER_REACH = 4.0  # px around the image that filters reach at most, at training's rate and below
FLOAT32_SLACK = 1e-6  # of the camera's distance from the origin: float32 may lose this in the camera's frame
MAX_STRETCH = 1 + JACOBIAN_MARGIN  # largest ratio of a projected Gaussian's length outside of the image to its own


class Level(NamedTuple):
    """A lighter scene.

    rate: the lowest sampling rate relative to training's that it is meant for.
    chunks: of each Gaussian; None if it belongs to no pyramid.
    parents: of each Gaussian of the level before, the place of the one that stands for it; None if that is not known;
        where none does, that of a neighbour's.
    """

    scene: Gaussians
    rate: float
    chunks: Int[Tensor, " n"] | None = None
    parents: Int[Tensor, " m"] | None = None


@dataclass(frozen=True, eq=False)
class Cut:
    """The Gaussians that a view draws.

    places: indices among the Gaussians of all levels, ascending.
    shares: share of each one's energy that is drawn, see `faded`; None for all of it.
    """

    places: Int[Tensor, " m"]
    shares: Float[Tensor, " m"] | None

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, part: slice) -> "Cut":
        """A part of the cut."""
        return Cut(self.places[part], None if self.shares is None else self.shares[part])

    def of(self, scene: Gaussians) -> Gaussians:
        """The Gaussians of the cut, without harmonics."""
        names = ("means", "quats", "log_scales", "logit_opacities")
        columns = {name: getattr(scene, name).index_select(0, self.places) for name in names}
        return replace(scene, **columns, sh=scene.sh[:1].expand(len(self), -1, -1), origin=None, extras={})


@dataclass(frozen=True, eq=False)
class Pyramid:
    """All levels of a scene as one, the finest first.

    scene: the Gaussians of all levels, without origin and extras.
    sizes: number of Gaussians of each level.
    chunks: chunk of each Gaussian.  Gaussians of every level but the finest are in the order of their chunks.
    """

    scene: Gaussians
    sizes: tuple[int, ...]
    chunks: Int[Tensor, " n"]

    def __post_init__(self) -> None:
        check_fields(self)
        counts = len(self.scene), sum(self.sizes), len(self.chunks)
        if not self.sizes or len({*counts}) > 1 or (counts[0] and int(self.chunks.min()) < 0):
            facts = "{} Gaussians, levels of {} in all, and chunks of {}".format(*counts)
            raise UsageError("levels", f"expected levels, and a chunk from 0 for each Gaussian, got {facts}")

    @classmethod
    @contract
    def of(cls, levels: Sequence[Gaussians], chunks: Sequence[Int[Tensor, " _"]]) -> "Pyramid":
        """A pyramid of its levels, the finest first, at least one, and the chunk of each of their Gaussians."""
        if not levels or [*map(len, levels)] != [*map(len, chunks)]:
            got = f"levels of {[*map(len, levels)]} and chunks of {[*map(len, chunks)]}"
            raise UsageError("levels", f"expected levels, and a chunk for each Gaussian of each, got {got}")
        scene = joined([replace(level, origin=None, extras={}) for level in levels])
        return cls(scene, tuple(map(len, levels)), torch.cat(list(chunks)))

    def __len__(self) -> int:
        """Number of levels."""
        return len(self.sizes)

    @contract
    def level(self, number: int) -> Gaussians:
        """One level as a scene of its own."""
        if not -len(self) <= number < len(self):
            raise UsageError("number", f"expected a level from 0 to {len(self) - 1}, got {number}")
        return self.scene[self.places[number]]

    @property
    def places(self) -> list[slice]:
        """The slice of each level's Gaussians."""
        return [slice(*ends) for ends in itertools.pairwise([0, *itertools.accumulate(self.sizes)])]

    @property
    def finest(self) -> Gaussians:
        """The scene that the levels were made of."""
        return self.level(0)

    @cached_property
    def counts(self) -> Int[Tensor, "l c"]:
        """Gaussians of each chunk in each level."""
        parts = self.chunks.split(list(self.sizes))
        return torch.stack([torch.bincount(part, minlength=self.count) for part in parts])

    @cached_property
    def firsts(self) -> Int[Tensor, "l c"]:
        """Index of each chunk's first Gaussian in each level; no meaning in the finest, which has its own order."""
        return starts_of(self.counts.flatten()).view_as(self.counts)

    @cached_property
    def count(self) -> int:
        """Number of chunks."""
        return int(self.chunks.max()) + 1 if len(self.chunks) else 0


@dataclass(frozen=True, eq=False)
class Cutter:
    """Picks a view's cut from bounds of the chunks.

    centres, radii: balls around the chunks' means.
    reach: distance from a ball's centre within which its Gaussians are visible.
    sizes: distance from its mean within which each Gaussian of the pyramid is visible.  All lengths: world units.
    lowest, highest: training's sampling rates in the chunk, px per world unit; 0 if no camera sees it.
    """

    pyramid: Pyramid
    training: TrainingViews
    centres: Float[Tensor, "c 3"]
    radii: Float[Tensor, " c"]
    reach: Float[Tensor, " c"]
    sizes: Float[Tensor, " n"]
    lowest: Float[Tensor, " c"]
    highest: Float[Tensor, " c"]

    @classmethod
    def of(cls, pyramid: Pyramid, training: TrainingViews) -> "Cutter":
        """Compute the bounds of every chunk; training: of the Gaussians of all levels."""
        scene, chunks, bounds = pyramid.scene, pyramid.chunks, training.bounds

        def extreme(values: Tensor, how: str) -> Tensor:
            places = chunks.reshape(-1, *[1] * (values.ndim - 1)).expand_as(values)
            start = torch.full((pyramid.count, *values.shape[1:]), torch.inf if how == "amin" else -torch.inf)
            return start.to(values).scatter_reduce(0, places, values, how)

        means = scene.means.detach().double()
        centres = (extreme(means, "amin") + extreme(means, "amax")) / 2
        distances = (means - centres[chunks]).norm(dim=1)
        radii = extreme(distances, "amax")
        blurs = torch.where(bounds.seen, training.convention.kernel**0.5 / bounds.lowest, 0.0)
        sizes = MAX_STRETCH * CUTOFF_SIGMAS * (scene.scales.detach().amax(dim=1).square() + blurs.square()).sqrt()
        lowest = extreme(torch.where(bounds.seen, bounds.lowest, torch.inf), "amin")
        lowest = lowest.where(lowest.isfinite(), 0.0)
        highest = extreme(bounds.highest, "amax")
        reach = extreme(distances + sizes, "amax")
        return cls(pyramid, training, centres, radii, reach, sizes, lowest, highest)

    @torch.no_grad()
    def __call__(self, camera: Camera, coarser: float = 0.0) -> Cut:
        """The cut of a view whose pixels are those of `camera`; coarser: octaves to add to those of all chunks."""
        frustum, pyramid = self._frustum(camera), self.pyramid
        shares = self._visible_shares(camera, frustum, coarser).to(self.sizes)
        finest = shares[0].index_select(0, pyramid.chunks[: pyramid.sizes[0]]) if shares[0].any() else shares[0, :0]
        finest_places = finest.nonzero()[:, 0]
        levels, chunks = shares[1:].nonzero().unbind(dim=1)
        counts, firsts = (table[1:][levels, chunks] for table in (pyramid.counts, pyramid.firsts))
        starts = starts_of(counts)
        runs = runs_of(starts, counts)
        places = (firsts - starts).index_select(0, runs) + torch.arange(len(runs), device=runs.device)
        places = torch.cat([finest_places, places])  # of all chunks with a share
        coarse_shares = shares[1:][levels, chunks].index_select(0, runs)
        shares = torch.cat([finest.index_select(0, finest_places), coarse_shares])
        means, sizes = (column.index_select(0, places) for column in (pyramid.scene.means, self.sizes))
        visible = _reaches(frustum, means, sizes).nonzero()[:, 0]
        places, shares = places.index_select(0, visible), shares.index_select(0, visible)
        return Cut(places, None if (shares == 1).all() else shares)

    @torch.no_grad()
    def count(self, camera: Camera, coarser: float = 0.0) -> int:
        """Number of Gaussians in the chunks that a view draws; the cut also leaves out those beside the image."""
        return int(self.pyramid.counts[self._visible_shares(camera, self._frustum(camera), coarser) > 0].sum())

    def coarsening(self, camera: Camera, last: float, most: int) -> float:
        """Octaves by which a view's levels are coarser than its samples need, in steps of `COARSENING_STEP`.

        They are the fewest up to `last` that leave at most `most` Gaussians, else those that leave the fewest
        Gaussians.  camera: of the samples.
        """
        if not last:
            return 0.0  # the only step: nothing to count
        fewest = math.inf, 0.0
        for octaves in (*(step * COARSENING_STEP for step in range(math.ceil(last / COARSENING_STEP))), last):
            count = self.count(camera, octaves)
            if count <= most:
                return octaves
            fewest = min(fewest, (count, octaves))
        return fewest[1]

    def octaves(self, camera: Camera, coarser: float = 0.0) -> Float[Tensor, " c"]:
        """Octaves of each chunk's sampling rate below training's, and `coarser` more; from 0 to the last level.

        At a data-set pose the rate is the ratio of focal lengths.  For a free camera the chunk's nearest point counts,
        and the nearest rate of training.
        """
        rates = torch.full_like(self.radii, self.training.relative_rate(camera))
        if camera.trained_focal is None:
            now = sights(self._nearest(camera), camera).rates
            trained = torch.minimum(torch.maximum(now, self.lowest.double()), self.highest.double())
            rates = torch.where(self.highest > 0, now / trained, rates)
        octaves = -rates.log2()
        nearest = octaves.round()
        octaves = torch.where((octaves - nearest).abs() < OCTAVE_SLACK, nearest, octaves)
        return (octaves + coarser).clamp(0, len(self.pyramid) - 1)

    def shares(self, octaves: Float[Tensor, " c"]) -> Float[Tensor, "l c"]:
        """Share of each level in each chunk; they sum to 1."""
        levels = torch.arange(len(self.pyramid)).to(octaves)[:, None]
        coming = ((octaves - levels + 1) / FADE_OCTAVES).clamp(0, 1)  # of level k: 0 up to k - 1
        coming[0] = 1
        return coming - torch.cat([coming[1:], torch.zeros_like(coming[:1])])

    def _nearest(self, camera: Camera) -> Float[Tensor, "c 3"]:
        """The place in each chunk's ball nearest to the camera; of a flat lens that of the least depth."""
        if camera.lens.flat:
            return self.centres - self.radii[:, None] * camera.cam_from_world[2, :3]
        towards = camera.centre - self.centres
        share = self.radii / towards.norm(dim=1).clamp(min=NEAR)
        return self.centres + share.clamp(max=1)[:, None] * towards

    def _frustum(self, camera: Camera) -> tuple[Float[Tensor, "5 3"], Float[Tensor, " 5"]]:
        """Normals and offsets, in the world, of the planes around the view; normals · place + offset >= 0 inside."""
        if camera.lens != PINHOLE:  # it may look anywhere
            return torch.zeros(1, 3, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
        margin = FILTER_REACH * max(1.0, self.training.relative_rate(camera))  # px
        rows = [[0.0, 0.0, 1.0, -NEAR]]
        sides = (camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height)
        for axis, (focal, centre, side) in enumerate(sides):
            for sign, edge in ((1.0, -margin - centre), (-1.0, side + margin - centre)):
                slope = edge / focal  # the plane along = slope z
                row = [0.0, 0.0, -sign * slope, 0.0]
                row[axis] = sign
                rows.append([x / math.hypot(1, slope) for x in row])
        planes = torch.tensor(rows, dtype=torch.float64)
        pose = camera.cam_from_world.detach().cpu().double()
        offsets = planes[:, :3] @ pose[:3, 3] + planes[:, 3]
        return planes[:, :3] @ pose[:3, :3], offsets + FLOAT32_SLACK * pose[:3, 3].norm()

    def _visible_shares(self, camera: Camera, frustum: tuple[Tensor, Tensor], coarser: float) -> Float[Tensor, "l c"]:
        """Share of each level in each chunk; 0 for chunks that cannot reach into the image."""
        visible = _reaches(frustum, self.centres, self.reach)
        return self.shares(self.octaves(camera, coarser)).masked_fill(~visible, 0.0)


def faded(splats: Splats2D, shares: Float[Tensor, " m"]) -> Splats2D:
    """The splats of a level with a share w of its energy, ∫ α; the other level that a chunk draws has 1 - w.

    Where both agree, two Gaussians of peaks a and b lie on each other.  Their alpha together, a + b - a b, has the
    integral of the one of peak α if a + b - a b / 2 = α.  So (1 - a/2) (1 - b/2) = 1 - α/2, and a = 2 (1 - (1 - α/2)ʷ).
    """
    opacities = -2 * torch.expm1(shares * torch.log1p(-splats.opacities / 2))
    return replace(splats, opacities=torch.where(shares == 1, splats.opacities, opacities))


def _reaches(
    frustum: tuple[Tensor, Tensor], places: Float[Tensor, "m 3"], room: Float[Tensor, " m"]
) -> Bool[Tensor, " m"]:
    """True where a thing that is visible up to `room` from its place can reach into the image."""
    normals, offsets = (x.to(places) for x in frustum)
    return torch.addmm(offsets[:, None], normals, places.T).amin(dim=0) > -room
