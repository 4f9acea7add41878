"""Ten tiny scenes that tell what a renderer does wrong, and the pictures of renderers that do one thing wrong.

Each picture of a renderer under test is compared with the reference rasterizer's, in float64, by the rule of a viewer:
once as it should be and once for each of `FAULTS`.  A test is right where the first is near enough.  Otherwise the
fault that explains the picture is named.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, centred, look_at
from aaplug.core.colours import BLACK, WHITE
from aaplug.core.conventions import CONVENTIONS, Convention
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.interfaces import PixelKernel
from aaplug.core.placing import placed
from aaplug.core.projection import project
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.shading import shade
from aaplug.core.splats import Splats2D
from aaplug.io.scenes.packed import sh_of_colour
from aaplug.methods.filters.dilation import limited
from aaplug.methods.pixel_kernels.point import POINT, Point
from aaplug.methods.viewers import VIEWERS, Viewer
from aaplug.rasterizers.reference import REFERENCE

Picture = Float[Tensor, "h w 3"]
F64 = torch.float64
SIDE, FOCAL = 64, 300.0  # px: a field of view of 12 degrees, in which perspective bends no splat visibly
LEVELS = 255.0  # of an 8-bit picture
UNSEEN = 600  # Gaussians
PATCH = 16  # px: side of the squares that pictures are compared in
EYE = (2.2, -1.4, -3.1)  # looks at the origin
POSE = look_at(torch.tensor(EYE), torch.zeros(3), torch.tensor([0.1, -1.0, 0.2]))
CAMERA = centred("camera", (SIDE, SIDE), FOCAL, POSE).as_trained()
DISTANCE = math.hypot(*EYE)
GREY, RED = (0.6, 0.6, 0.6), (1.0, 0.2, 0.0)  # seen on black and on white


class Spot(NamedTuple):
    """A Gaussian by its splat: place and standard deviations in px, angle in degrees, depth in world units."""

    x: float
    y: float
    sigmas: tuple[float, float]
    rgb: Sequence[float] = GREY
    opacity: float = 0.9
    angle: float = 0.0
    depth: float = DISTANCE
    rest: Sequence[Sequence[float]] = ()  # harmonics above degree 0, [k, 3]


@dataclass(frozen=True, eq=False)
class Test:
    """A scene and what it tests.

    tolerance: largest `Finding.error` of a picture that is right.
    """

    name: str
    about: str
    spots: Sequence[Spot]
    tolerance: float = 6.0

    @cached_property
    def scene(self) -> Gaussians:
        """The Gaussians, of degree 3."""
        x, y, depth, opacity, angle = (
            torch.tensor([getattr(spot, name) for spot in self.spots], dtype=F64)
            for name in ("x", "y", "depth", "opacity", "angle")
        )
        near = depth / FOCAL  # world units a px
        half, zero = angle.deg2rad() / 2, torch.zeros_like(angle)
        sigmas = torch.tensor([(*spot.sigmas, min(spot.sigmas)) for spot in self.spots], dtype=F64)
        sh = torch.zeros(len(self.spots), 16, 3, dtype=F64)
        sh[:, :1] = sh_of_colour(torch.tensor([[*spot.rgb] for spot in self.spots], dtype=F64)[:, None])
        for place, spot in enumerate(self.spots):
            if spot.rest:
                sh[place, 1 : 1 + len(spot.rest)] = torch.tensor(spot.rest, dtype=F64)
        seen = Gaussians(
            torch.stack([(x - SIDE / 2) * near, (y - SIDE / 2) * near, depth], dim=1),
            torch.stack([half.cos(), zero, zero, half.sin()], dim=1),
            (near.abs()[:, None] * sigmas).log(),
            opacity.logit(),
            sh[:, :1],
        )
        world = torch.linalg.inv(POSE)
        return replace(placed(seen, world[:3, :3], 1.0, world[:3, 3].tolist()), sh=sh).to(torch.float32)

    @property
    def stored(self) -> Gaussians:
        """The Gaussians, and others beside the picture: some viewers do not draw a scene of a few Gaussians rightly."""
        beside = [Spot(-6.0, (i + 0.5) * SIDE / UNSEEN, (0.3, 0.3), depth=1.0 + i % 7) for i in range(UNSEEN)]
        return joined([self.scene, replace(self, spots=beside).scene])


def _grid(count: int) -> list[tuple[float, float]]:
    """Places all over the picture, at every part of a pixel; none on the middle row, where round splats lie along x."""
    step = SIDE / count
    return [((i + 0.5) * step + 0.13 * j, (j + 0.48) * step - 0.17 * i) for j in range(count) for i in range(count)]


def _harmonics(first: int, last: int, seed: int, span: float) -> list[Spot]:
    """Splats whose harmonics are drawn at random from one coefficient up to another."""
    generator = torch.Generator().manual_seed(seed)
    spots = []
    for x, y in _grid(3):
        rest = torch.zeros(15, 3, dtype=F64)
        rest[first:last] = (torch.rand(last - first, 3, generator=generator, dtype=F64) - 0.5) * span
        spots.append(Spot(x, y, (4.0, 4.0), (0.5, 0.5, 0.5), 0.95, rest=rest.tolist()))
    return spots


def _tests() -> tuple[Test, ...]:
    sizes = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
    small = [Spot(x, y, (s := sizes[i % 6], s), RED) for i, (x, y) in enumerate(_grid(6))]
    needles = [Spot(x, y, (5.0, 0.3 + 0.1 * (i % 3)), RED, angle=37.0 * i) for i, (x, y) in enumerate(_grid(3))]
    broad = [Spot(32.3, 31.4, (8.5, 8.5), RED, 0.95)]
    turned = [
        Spot(20, 18, (7.0, 2.0), (1.0, 0.3, 0.2), angle=30), Spot(44, 24, (5.0, 1.5), (0.2, 1.0, 0.3), angle=-65),
        Spot(26, 46, (6.0, 2.0), (0.3, 0.4, 1.0), angle=15), Spot(50, 52, (3.0, 2.0), angle=80),
    ]  # fmt: skip
    greys = [Spot(x, y, (4, 4), (0.1 * (i + 1),) * 3, 0.98) for i, (x, y) in enumerate(_grid(3))]
    tones = [*greys, Spot(43, 22, (9, 4), (0.9, 0.2, 0.5), 0.5, depth=3.0)]
    near = [
        Spot(20, 24, (5, 5), (0.2, 0.9, 0.3), depth=0.5), Spot(44, 40, (5, 5), (0.3, 0.3, 1.0)),
        Spot(40, 20, (9, 9), (1.0, 0.2, 0.2), depth=0.005), Spot(22, 44, (9, 9), (1.0, 1.0, 0.1), depth=-2.0),
    ]  # fmt: skip
    colours = [(1.0, 0.2, 0.1), (0.1, 0.9, 0.2), (0.2, 0.3, 1.0), (0.9, 0.9, 0.1)]
    depths = [4.3, 3.4, 4.8, 3.0]  # in the order of the file
    stack = [Spot(26 + 4 * i, 28 + 3 * i, (6, 6), colours[i], 0.8, depth=d) for i, d in enumerate(depths)]
    opacities = [Spot(x, y, (4, 4), opacity=0.1 * (i + 1), rgb=(0.9, 0.9, 0.9)) for i, (x, y) in enumerate(_grid(3))]
    opacities[-1] = opacities[-1]._replace(sigmas=(13, 13), opacity=0.9999, rgb=(0.05,) * 3, depth=3.5)
    behind = opacities[-1]._replace(rgb=(1.0, 1.0, 1.0), depth=DISTANCE + 1)
    return (
        Test("dilation", "round splats of 0.35 to 2 px: what is added to a covariance", small),
        Test("compensation", "needles of 0.3 to 0.5 px: how opacity pays for what is added", needles),
        Test("cut-off", "one broad splat: where it ends", broad, 9.0),
        Test("orientation", "ellipses at four angles: axes of quads, quaternions, pictures", turned),
        Test("harmonics", "degree 1: order, signs and direction of sight", _harmonics(0, 3, 0, 1.6)),
        Test("degree", "degrees 2 and 3: whether they are drawn", _harmonics(3, 15, 1, 0.7)),
        Test("gamma", "greys from 0.1 to 0.9, and a veil: values and blending as stored", tones),
        Test("near-plane", "Gaussians at depths 0.5, 0.005 and -2: which are drawn", near),
        Test("order", "four splats across each other: nearest first", stack),
        Test("opacity", "opacities from 0.1 to 0.9999: sigmoid, cap and blending", [*opacities, behind]),
    )


TESTS = _tests()


@dataclass(frozen=True, eq=False)
class Fault:
    """One thing that a renderer does wrong.  Each field changes a stage of the drawing.

    words: what is wrong, after "wrong:".
    """

    words: str
    scene: Callable[[Gaussians], Gaussians] = lambda scene: scene
    camera: Callable[[Camera], Camera] = lambda camera: camera
    rule: Callable[[Convention], Convention] = lambda rule: rule
    splats: Callable[[Splats2D], Splats2D] = lambda splats: splats
    pixel: PixelKernel = POINT
    rules: Rules = RULES_3DGS
    image: Callable[[Picture], Picture] = lambda image: image


NONE = Fault("")


def draw(scene: Gaussians, viewer: Viewer, fault: Fault = NONE, white: bool = False) -> Picture:
    """The picture by a viewer's rule, in float64, on black or white, with one fault."""
    assert viewer.convention is not None
    scene = fault.scene(viewer.shown(scene).to(F64))
    camera, rule = fault.camera(CAMERA), fault.rule(viewer.convention)
    splats = project(scene, camera, rules=fault.rules).blurred(rule.kernel, rule.compensated)
    splats = fault.splats(shade(splats, scene, camera))
    drawn = REFERENCE(splats, camera.hw, WHITE if white else BLACK, fault.pixel, rules=fault.rules)
    return fault.image(drawn.rgb).clamp(0, 1)


@dataclass(frozen=True)
class Ending(Point):
    """Splats that end at a number of standard deviations."""

    sigmas: float = math.inf

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """0 beyond the end."""
        values = super().exact(splats, offsets)
        return torch.where(values < math.exp(-(self.sigmas**2) / 2), 0.0, values)


def _sh(change: Callable[[Tensor], Tensor]) -> Callable[[Gaussians], Gaussians]:
    """A change of the harmonics above degree 0, [n, k, 3]."""
    return lambda scene: replace(scene, sh=torch.cat([scene.sh[:, :1], change(scene.sh[:, 1:])], dim=1))


def _signs(*negative: int) -> Callable[[Gaussians], Gaussians]:
    """These coefficients above degree 0, counted from 1, with the other sign."""
    return _sh(lambda rest: torch.stack([-c if i in negative else c for i, c in enumerate(rest.unbind(1), 1)], dim=1))


def _covs(change: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, ...]]) -> Callable[[Splats2D], Splats2D]:
    """A change of the splats' covariances, xx, xy and yy; those that are none afterwards are not drawn."""

    def changed(splats: Splats2D) -> Splats2D:
        xx, xy, yy = change(*splats.covs.unbind(dim=1))
        dets = xx * yy - xy * xy
        kept = splats.with_columns({"covs": torch.stack([xx, xy, yy], dim=1), "dets": dets})
        return kept[(dets > 0) & (xx > 0)]

    return changed


def _mirrored(scene: Gaussians) -> Gaussians:
    """Those behind the camera, drawn as if a negative depth were a positive one."""
    local = scene.means @ POSE[:3, :3].T + POSE[:3, 3]
    return replace(scene, means=(torch.where(local[:, 2:] < 0, -local, local) - POSE[:3, 3]) @ POSE[:3, :3])


def _coloured(change: Callable[[Any], Tensor]) -> Callable[[Splats2D], Splats2D]:
    return lambda splats: replace(splats, rgb=change(splats))


GAMMA = 2.2
BEND = VIEWERS["mkkellogg"].apart  # px²
FAULTS = (
    Fault("dilation: nothing is added to covariances", rule=lambda r: replace(r, kernel=0.0, compensated=False)),
    Fault("dilation: twice the variance is added", rule=lambda r: replace(r, kernel=2 * r.kernel)),
    Fault("dilation: half of the variance is added", rule=lambda r: replace(r, kernel=r.kernel / 2)),
    Fault("compensation: opacity pays for what is added, and should not", rule=lambda r: replace(r, compensated=True)),
    Fault("compensation: opacity should pay for what is added, and does not",
          rule=lambda r: replace(r, compensated=False)),
    *(Fault(f"dilation: {c.kernel:g} px², {'' if c.compensated else 'not '}compensated, as {c.name} does",
            rule=lambda _, c=c: c) for c in CONVENTIONS.values()),
    Fault("dilation: widths of small splats are bent by √max(0.1, ·), as GaussianSplats3D does",
          splats=partial(limited, apart=BEND)),
    Fault("cut-off: splats end at 2 standard deviations", pixel=Ending(sigmas=2.0)),
    Fault("quads are mirrored: the covariance's xy has the wrong sign", splats=_covs(lambda a, b, c: (a, -b, c))),
    Fault("quads are turned: width and height are exchanged", splats=_covs(lambda a, b, c: (c, -b, a))),
    Fault("quaternions are read as xyzw, and are wxyz", scene=lambda s: replace(s, quats=s.quats[:, [3, 0, 1, 2]])),
    Fault("rotations are inverted", scene=lambda s: replace(s, quats=s.quats * s.quats.new_tensor([1, -1, -1, -1]))),
    Fault("the picture is upside down", image=lambda image: image.flip(0)),
    Fault("the picture is mirrored, left to right", image=lambda image: image.flip(1)),
    Fault("the picture is turned by half a turn", image=lambda image: image.flip(0, 1)),
    Fault("places are half a pixel too far right and down", camera=lambda c: replace(c, cx=c.cx + 0.5, cy=c.cy + 0.5)),
    Fault("places are half a pixel too far left and up", camera=lambda c: replace(c, cx=c.cx - 0.5, cy=c.cy - 0.5)),
    Fault("harmonics: degree 1 lacks its minus signs", scene=_signs(1, 3)),
    Fault("harmonics: degree 1 is taken in the order x, y, z", scene=_sh(lambda c: torch.cat(
        [-c[:, 1:2], c[:, 2:3], -c[:, :1], c[:, 3:]], dim=1))),
    Fault("harmonics: the direction of sight is reversed", scene=_signs(1, 2, 3, *range(9, 16))),
    Fault("harmonics: directions are in OpenGL's axes, y and z reversed", scene=_signs(1, 2, 4, 7, 9, 11, 12, 14)),
    Fault("harmonics: f_rest is read with the channels side by side", scene=_sh(
        lambda c: c.mT.reshape(len(c), -1, 3))),
    Fault("degree: harmonics above degree 2 are not drawn", scene=lambda s: replace(s, sh=s.sh[:, :9])),
    Fault("degree: harmonics above degree 1 are not drawn", scene=lambda s: replace(s, sh=s.sh[:, :4])),
    Fault("degree: harmonics are not drawn", scene=lambda s: replace(s, sh=s.sh[:, :1])),
    Fault("gamma: values are encoded once too often (too bright)", image=lambda image: image ** (1 / GAMMA)),
    Fault("gamma: values are decoded once too often (too dark)", image=lambda image: image**GAMMA),
    Fault("gamma: colours are blended in linear light", splats=_coloured(lambda s: s.rgb**GAMMA),
          image=lambda image: image ** (1 / GAMMA)),
    Fault("near plane: Gaussians nearer than 1 are not drawn", rules=replace(RULES_3DGS, near=1.0)),
    Fault("near plane: Gaussians nearer than 0.01 are drawn", rules=replace(RULES_3DGS, near=1e-3)),
    Fault("near plane: Gaussians behind the camera are drawn", scene=_mirrored),
    Fault("order: the farthest splat is drawn over the others", splats=lambda s: replace(s, depths=-s.depths)),
    Fault("order: splats are drawn in the file's order", splats=lambda s: replace(s, depths=s.sources.double())),
    Fault("order: splats are drawn against the file's order", splats=lambda s: replace(s, depths=-s.sources.double())),
    Fault("opacity: the stored logit is taken for the opacity", scene=lambda s: replace(
        s, logit_opacities=s.logit_opacities.clamp(1e-6, 1 - 1e-6).logit())),
    Fault("opacity: alpha is capped at 0.9", rules=replace(RULES_3DGS, max_alpha=0.9)),
    Fault("opacity: colours are multiplied by opacity twice", splats=_coloured(lambda s: s.opacities[:, None] * s.rgb)),
)  # fmt: skip


class Finding(NamedTuple):
    """The verdict of one test.

    wrong: what is wrong, in words; "" if nothing is.
    error: root mean square of the difference to the expected picture in the patch and channel where it is largest,
        in levels of 255; None without a picture.
    """

    test: str
    about: str
    wrong: str
    error: float | None


@dataclass(frozen=True)
class Conformance:
    """The verdict on a renderer.

    viewer: whose rule the expected pictures follow.  stated: false if it was found as the one that fits best.
    """

    viewer: Viewer
    stated: bool
    findings: Sequence[Finding]

    @property
    def right(self) -> bool:
        """True if every test is."""
        return not any(finding.wrong for finding in self.findings)


class _Seen:
    """A renderer's picture of a test.  white: True if its background is, in most corners."""

    def __init__(self, test: Test, picture: Picture):
        self.test, self.picture, self.error = test, picture, cache(self._error)
        self.white = float(picture[:: SIDE - 1, :: SIDE - 1].median()) > 0.5

    def expected(self, viewer: Viewer, fault: Fault = NONE) -> Picture:
        return draw(self.test.scene, viewer, fault, self.white)

    def _error(self, viewer: Viewer, fault: Fault = NONE) -> float:
        """`Finding.error` against the picture with a fault."""
        squares = (self.expected(viewer, fault) - self.picture).square()
        patches = squares.reshape(SIDE // PATCH, PATCH, -1, PATCH, 3).mean(dim=(1, 3))
        return LEVELS * float(patches.max().sqrt())

    def agrees(self, viewer: Viewer, fault: Fault = NONE) -> bool:
        return self.error(viewer, fault) <= self.test.tolerance


def judged(pictures: Mapping[str, Picture | str], viewer: Viewer | None = None) -> Conformance:
    """The verdict on the pictures of a renderer, by the tests' names; of a text, it is why there is no picture.

    viewer: whose rule to expect; None for the one that fits best, of those that differ in rule or degree.
    """
    seen = {t.name: _Seen(t, p.to(F64)) for t in TESTS if not isinstance(p := pictures[t.name], str)}
    rules = dict[tuple[Convention | None, int], Viewer]()
    for each in [viewer] if viewer else VIEWERS.values():
        rules.setdefault((each.convention, each.sh_degree), each)

    def explained(viewer: Viewer, fault: Fault) -> tuple[int, float]:
        """Tests that agree, and minus the error of all."""
        errors = [s.error(viewer, fault) for s in seen.values()]
        return sum(s.agrees(viewer, fault) for s in seen.values()), -math.fsum(errors)

    found, cause = max(rules.values(), key=lambda v: explained(v, NONE)), NONE
    if wrong := [each for each in seen.values() if not each.agrees(found)]:
        counts = {fault: sum(each.agrees(found, fault) for each in wrong) for fault in FAULTS}
        most = [fault for fault, count in counts.items() if count == max(counts.values())]
        cause = max(most, key=lambda fault: explained(found, fault))
        found = max(rules.values(), key=lambda v: explained(v, cause) + explained(v, NONE))
    findings = []
    for test in TESTS:
        if test.name not in seen:
            findings.append(Finding(test.name, test.about, str(pictures[test.name]), None))
            continue
        drawn = seen[test.name]
        error, wrong = drawn.error(found), ""
        if not drawn.agrees(found):
            nearest = min(FAULTS, key=lambda fault: drawn.error(found, fault))
            fault = cause if cause is not NONE and drawn.agrees(found, cause) else nearest
            wrong = fault.words if drawn.agrees(found, fault) else _unnamed(drawn, found, fault)
        findings.append(Finding(test.name, test.about, wrong, error))
    return Conformance(found, viewer is not None, findings)


def _unnamed(drawn: _Seen, viewer: Viewer, fault: Fault) -> str:
    """Where a picture differs for a reason that no fault is."""
    difference = (drawn.picture - drawn.expected(viewer)).abs().amax(dim=2)
    y, x = divmod(int(difference.argmax()), SIDE)
    where = f"differs by up to {LEVELS * float(difference.max()):.0f} levels of 255, most at x {x}, y {y}"
    better = drawn.error(viewer, fault) < drawn.error(viewer) / 2
    return f"{where}; nearest to: {fault.words}" if better else where
