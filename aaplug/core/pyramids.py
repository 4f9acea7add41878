"""Pyramids: a scene with coarser levels of itself, and the cut that a view draws.

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

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.projection import JACOBIAN_MARGIN
from aaplug.core.rules import NEAR
from aaplug.core.runs import runs_of, starts_of
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews

FADE = math.log2(4 / 3)  # octaves of the sampling rate over which a level fades into the next: half of the way
COARSER = 1 / 4  # octaves: steps in which coarser levels are tried
ROUNDING = 1e-4  # octaves: what lies nearer to a level is that level
SIGMAS = 3.33  # standard deviations to where an opaque Gaussian's alpha falls below 1/255
PAD = 4.0  # px around the image that the filters reach at most, at training's rate and below
FAR_ROUNDING = 1e-6  # of the camera's distance from the origin: what float32 may lose in the camera's frame
STRETCH = 1 + JACOBIAN_MARGIN  # how much longer than it is a Gaussian outside of the image is projected at most


@dataclass(frozen=True)
class Cut:
    """What a view draws.

    places: of Gaussians among those of all levels, ascending.
    shares: of each one's energy that is drawn, see `faded`; None for all of it.
    """

    places: Int[Tensor, " m"]
    shares: Float[Tensor, " m"] | None

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, part: slice) -> "Cut":
        """A part of it."""
        return Cut(self.places[part], None if self.shares is None else self.shares[part])

    def of(self, scene: Gaussians) -> Gaussians:
        """The Gaussians of the cut, without harmonics."""
        names = ("means", "quats", "log_scales", "logit_opacities")
        columns = {name: getattr(scene, name).index_select(0, self.places) for name in names}
        none = scene.sh[:1].expand(len(self), -1, -1)
        return replace(scene, **columns, sh=none, origin=None, pixel_sizes=None)


@dataclass(frozen=True)
class Pyramid:
    """All levels of a scene as one, the finest first.

    scene: its origin is not known.
    sizes: Gaussians of each level.
    chunks: of each Gaussian; those of every level but the finest lie in the order of their chunks.
    """

    scene: Gaussians
    sizes: tuple[int, ...]
    chunks: Int[Tensor, " n"]

    @classmethod
    def of(cls, levels: Sequence[Gaussians], chunks: Sequence[Int[Tensor, " _"]]) -> "Pyramid":
        """A pyramid of its levels, the finest first, at least one, and the chunk of each of their Gaussians."""
        like = [replace(level, origin=None, pixel_sizes=None) for level in levels]
        return cls(joined(like), tuple(map(len, levels)), torch.cat(list(chunks)))

    def __len__(self) -> int:
        """Number of levels."""
        return len(self.sizes)

    def level(self, number: int) -> Gaussians:
        """One level as a scene of its own."""
        return self.scene[self.places[number]]

    @property
    def coarsest_rate(self) -> float:
        """The lowest sampling rate, relative to training's, that there is a level for."""
        return 0.5 ** (len(self) - 1)

    @property
    def places(self) -> list[slice]:
        """Where each level's Gaussians are."""
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


@dataclass(frozen=True)
class Cutter:
    """Picks a view's cut from bounds of the chunks.

    centres, radii: of a ball around a chunk's means, in world units.
    reach: how far from the ball's centre one of its Gaussians can be seen.
    sizes: how far from its mean each Gaussian of the pyramid can be seen, in world units.
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
        """Compute the bounds of every chunk.

        training: views of all levels.
        """
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
        sizes = STRETCH * SIGMAS * (scene.scales.detach().amax(dim=1).square() + blurs.square()).sqrt()
        lowest = extreme(torch.where(bounds.seen, bounds.lowest, torch.inf), "amin")
        seen = lowest.isfinite()
        highest = extreme(bounds.highest, "amax")
        reach = extreme(distances + sizes, "amax")
        return cls(pyramid, training, centres, radii, reach, sizes, lowest.where(seen, 0.0), highest)

    @torch.no_grad()
    def __call__(self, camera: Camera, coarser: float = 0.0) -> Cut:
        """The cut of a view whose pixels are those of `camera`; coarser: octaves to add to those of all chunks."""
        frustum = self._frustum(camera)
        index, shares = self._candidates(self._drawn(camera, frustum, coarser).to(self.sizes))
        means, sizes = (column.index_select(0, index) for column in (self.pyramid.scene.means, self.sizes))
        shown = _reaches(frustum, means, sizes).nonzero()[:, 0]
        index, shares = index.index_select(0, shown), shares.index_select(0, shown)
        return Cut(index, None if (shares == 1).all() else shares)

    @torch.no_grad()
    def count(self, camera: Camera, coarser: float = 0.0) -> int:
        """Number of Gaussians in the chunks that a view draws, of which the cut leaves out those beside the image."""
        return int(self.pyramid.counts[self._drawn(camera, self._frustum(camera), coarser) > 0].sum())

    def coarsening(self, camera: Camera, last: float, most: int) -> float:
        """Octaves by which a view's levels are coarser than those of its samples, in steps of `COARSER` up to `last`.

        As few as leave at most `most` Gaussians; where none does, those that leave the fewest.

        camera: of the samples.
        """
        if not last:
            return 0.0  # the only step: nothing to count
        fewest = math.inf, 0.0
        for octaves in (*(step * COARSER for step in range(math.ceil(last / COARSER))), last):
            count = self.count(camera, octaves)
            if count <= most:
                return octaves
            fewest = min(fewest, (count, octaves))
        return fewest[1]

    def octaves(self, camera: Camera, coarser: float = 0.0) -> Float[Tensor, " c"]:
        """How far each chunk's sampling rate lies below training's, and `coarser` more, in octaves; at least 0.

        At a data-set pose it is the ratio of focal lengths.  For a free camera the chunk's nearest point counts, and
        the nearest rate of training.
        """
        own = torch.full_like(self.radii, self.training.relative_rate(camera))
        if camera.trained_focal is None:
            pose = camera.cam_from_world.detach().double()
            depths = self.centres @ pose[2, :3] + pose[2, 3]
            now = camera.focal / (depths - self.radii).clamp(min=NEAR)
            trained = torch.minimum(torch.maximum(now, self.lowest.double()), self.highest.double())
            own = torch.where(self.highest > 0, now / trained, own)
        octaves = -own.log2()
        nearest = octaves.round()
        octaves = torch.where((octaves - nearest).abs() < ROUNDING, nearest, octaves)
        return (octaves + coarser).clamp(0, len(self.pyramid) - 1)

    def shares(self, octaves: Float[Tensor, " c"]) -> Float[Tensor, "l c"]:
        """Share of each level in each chunk; they sum to 1."""
        levels = torch.arange(len(self.pyramid)).to(octaves)[:, None]
        coming = ((octaves - levels + 1) / FADE).clamp(0, 1)  # of level k: 0 up to k - 1
        coming[0] = 1
        return coming - torch.cat([coming[1:], torch.zeros_like(coming[:1])])

    def _frustum(self, camera: Camera) -> tuple[Float[Tensor, "5 3"], Float[Tensor, " 5"]]:
        """Normals and offsets of the planes around what is seen; normals · place + offset >= 0 inside."""
        normals, offsets = _planes(camera, PAD * max(1.0, self.training.relative_rate(camera)))
        return normals, offsets + FAR_ROUNDING * camera.cam_from_world.detach()[:3, 3].cpu().norm()

    def _drawn(self, camera: Camera, frustum: tuple[Tensor, Tensor], coarser: float) -> Float[Tensor, "l c"]:
        """Share of each level in each chunk; 0 for chunks that cannot reach into the image."""
        visible = _reaches(frustum, self.centres, self.reach)
        return self.shares(self.octaves(camera, coarser)).masked_fill(~visible, 0.0)

    def _candidates(self, shares: Float[Tensor, "l c"]) -> tuple[Int[Tensor, " m"], Float[Tensor, " m"]]:
        """The Gaussians of the chunks that have a share, ascending, and their shares."""
        pyramid = self.pyramid
        finest = shares[0].index_select(0, pyramid.chunks[: pyramid.sizes[0]]) if shares[0].any() else shares[0, :0]
        first = finest.nonzero()[:, 0]
        levels, chunks = shares[1:].nonzero().unbind(dim=1)
        counts, firsts = (of[1:][levels, chunks] for of in (pyramid.counts, pyramid.firsts))
        starts = starts_of(counts)
        runs = runs_of(starts, counts)
        index = (firsts - starts).index_select(0, runs) + torch.arange(len(runs), device=runs.device)
        own = shares[1:][levels, chunks].index_select(0, runs)
        return torch.cat([first, index]), torch.cat([finest.index_select(0, first), own])


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
    """Whether what is seen up to `room` from a place can reach into the image."""
    normals, offsets = (x.to(places) for x in frustum)
    return torch.addmm(offsets[:, None], normals, places.T).amin(dim=0) > -room


def _planes(camera: Camera, pad: float) -> tuple[Float[Tensor, "5 3"], Float[Tensor, " 5"]]:
    """Normals and offsets of the planes around what a camera sees, in the world.

    pad: px around the image.
    """
    planes = [[0.0, 0.0, 1.0, -NEAR]]
    for axis, focal, centre, side in (
        (0, camera.fx, camera.cx, camera.width),
        (1, camera.fy, camera.cy, camera.height),
    ):
        for sign, edge in ((1.0, -pad - centre), (-1.0, side + pad - centre)):
            slope = edge / focal  # the plane along = slope z
            plane = [0.0, 0.0, -sign * slope, 0.0]
            plane[axis] = sign
            planes.append([x / math.hypot(1, slope) for x in plane])
    found = torch.tensor(planes, dtype=torch.float64)
    pose = camera.cam_from_world.detach().cpu().double()
    return found[:, :3] @ pose[:3, :3], found[:, :3] @ pose[:3, 3] + found[:, 3]
