"""Viewers: programs that show scenes, each with the rule by which it turns covariances into pixels.

A viewer adds a constant variance to every projected covariance, with or without compensation: its rule.  What else it
does to a splat is here too, as far as it shows in pictures.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from aaplug.core.conventions import (
    ANTIALIASED,
    CESIUM,
    CLASSIC,
    KHR,
    MIP,
    PLAYCANVAS,
    PLAYCANVAS_CLASSIC,
    Convention,
    SpzAxes,
    SpzVersion,
)
from aaplug.core.rules import RULES_3DGS
from aaplug.system.errors import listing
from aaplug.system.registry import Registry, named

if TYPE_CHECKING:
    from aaplug.core.gaussians import Gaussians

MOST_DEGREE = 4  # of spherical harmonics in any file
MEASURED, BY_SOURCE, BY_TEXT = "measured", "by its source, not tried", "by its text"


@dataclass(frozen=True)
class Viewer:
    """A program with its settings, and the rule by which it then shows scenes.

    program: name and version that the rule was measured on or read from.
    convention: what the file must declare for this rule; None keeps the scene's own convention.
    settings: what to choose in the program, for the user.
    evidence: how the rule is known.
    recipe: name of the recipe that predicts its pictures; only where it has no convention of its own.
    switched: anti-aliasing is off there until these settings turn it on.
    sh_degree: highest degree of the harmonics that it draws.
    cut: standard deviations at which a splat ends; None: only where its alpha is less than `floor`.
    fades: the falloff is lowered to reach 0 at the cut.
    floor: alpha below which a splat is not drawn at a pixel; 0: it has no such bound.
    smallest: px²; a splat whose variance along its longer axis, with what was added, is less is not drawn.
    apart: px²; least half difference of the variances along a splat's two axes, to which rounder ones are stretched.
    shown_by: names of viewers that show its files by rules of their own; a scene is tuned for all of these rules.
    levels: how it chooses levels of detail, in words; empty: it draws none.
    formats: names of formats of the scene files that the program is known to open, of those that aaplug writes.
    spz_axes: in which it takes the numbers of a .spz; "auto": those of the specification.
    spz_version: of a .spz that it takes.
    """

    name: str
    program: str
    convention: Convention | None
    settings: str
    evidence: str = BY_TEXT
    recipe: str = "matched"
    switched: bool = False
    sh_degree: int = MOST_DEGREE
    cut: float | None = None
    fades: bool = False
    floor: float = RULES_3DGS.min_alpha
    smallest: float = 0.0
    apart: float = 0.0
    shown_by: tuple[str, ...] = ()
    levels: str = ""
    formats: tuple[str, ...] = ("ply",)
    spz_axes: SpzAxes = "auto"
    spz_version: SpzVersion = 4

    def convention_of(self, scene: "Gaussians") -> Convention:
        """The convention that the file of a scene for this viewer declares."""
        return self.convention or scene.convention

    @property
    def rule(self) -> str:
        """The rule in words."""
        if self.convention is None:
            return f"recipe {self.recipe}"
        return f"{self.convention.kernel:g} px², {'' if self.convention.compensated else 'not '}compensated"

    @property
    def end(self) -> str:
        """Where a splat ends, and which splats are changed or left out, in words."""
        ends = [] if self.cut is None else [f"{self.cut:.3g} σ" + (", fading out" if self.fades else "")]
        ends += [f"alpha < {self.floor * 255:.2g}/255"] if self.floor and self.cut is None else []
        ends += [f"drops variances < {self.smallest:g} px²"] if self.smallest else []
        ends += [f"variances at least {2 * self.apart:.2g} px² apart"] if self.apart else []
        return "; ".join(ends) or "nowhere"

    @property
    def choice(self) -> str:
        """The settings, after the switch that they need."""
        return f"anti-aliasing on: {self.settings}" if self.switched else self.settings

    def caveat(self, suffix: str, file: str) -> str:
        """One line, where no viewer of this rule is known to open a file of such a format; else nothing."""
        if suffix in self.formats or self._others(suffix):
            return ""
        fitting = [viewer.name for viewer in VIEWERS.values() if suffix in viewer.formats]
        if not fitting or self == DISC_VIEWER:  # the others show no discs
            return f"no viewer is known to open {file}"
        own = " or ".join(f".{name}" for name in self.formats)
        hint = f"write a {own}, or --for {listing(fitting)} writes one for its own rule"
        if others := self._others(suffix, alike=False):
            hint = f"--for {others[0].name} writes one that {others[0].program} opens"
        return f"no viewer of this rule is known to open {file}; {hint}"

    def advice(self, suffix: str, file: str) -> str:
        """One line on the settings to choose in the program for a file, of such a format, that was converted for it.

        Nothing where no viewer is known to open it.
        """
        if suffix not in self.formats:
            others = " or ".join(f"{v.program} ({v.settings})" for v in self._others(suffix))
            return others and f"open {file} in {others}"
        nothing, _, why = self.settings.partition(": ")
        if nothing in ("nothing", "none"):
            return f"in {self.program}, there is nothing to choose" + (f": {why}" if why else "")
        if not self.switched:
            return f"in {self.program}, choose {self.settings}"
        without = "with it off, a converted scene can look worse than the original"
        return f"in {self.program}, turn {self.choice} ({without})"

    def _others(self, suffix: str, alike: bool = True) -> "list[Viewer]":
        """Viewers of this rule that open the format; alike: that take a .spz as this one does."""
        others = [v for v in VIEWERS.values() if suffix in v.formats and v.convention == self.convention]
        return [v for v in others if suffix != "spz" or not alike or v.spz("auto") == self.spz("auto")]

    def spz(self, asked: SpzAxes) -> "dict[str, Any]":
        """How a .spz is written, for `write_scene`: axes as asked for, or the program's own, and its version."""
        return {"spz_axes": self.spz_axes if asked == "auto" else asked, "spz_version": self.spz_version}

    def shown(self, scene: "Gaussians") -> "Gaussians":
        """The scene with the harmonics that the program draws."""
        coefficients = (self.sh_degree + 1) ** 2
        return scene if scene.sh.shape[1] <= coefficients else replace(scene, sh=scene.sh[:, :coefficients])


ROOT_8 = 8**0.5  # standard deviations; the falloff there is exp(-4)
NO_TAG = "nothing: the file has no tag"
SMALLEST = 0.125  # px²: quads of less than two half pixels
CLASSIC_VIEWER = Viewer("classic", "3DGS", CLASSIC, "nothing: anti-aliasing is off by default")
MIP_VIEWER = Viewer("mip", "Mip-Splatting's viewers", MIP, "a kernel of 0.1, the default")
DISC_VIEWER = Viewer("2dgs", "2DGS's renderers", None, "none", recipe="2dgs")


def _spark(name: str, convention: Convention, settings: str) -> Viewer:
    files = {"formats": ("ply", "compressed.ply", "spz", "sog", "splat"), "spz_axes": "opencv", "spz_version": 3}
    how = {"sh_degree": 3, "cut": ROOT_8, "floor": 0.5 / 255, **files}
    levels = "size of a node over distance, within a budget of splats"
    return Viewer(name, "Spark 2.2.0", convention, settings, MEASURED, levels=levels, **how)


def _playcanvas(name: str, program: str, switch: str, compensated: bool, evidence: str = MEASURED) -> Viewer:
    rule = PLAYCANVAS if compensated else PLAYCANVAS_CLASSIC
    drawn = {"sh_degree": 3, "cut": ROOT_8, "fades": True, "smallest": SMALLEST}
    files = {"levels": "distance or a budget of splats", "formats": ("ply", "compressed.ply", "sog")}
    return Viewer(name, program, rule, switch, evidence, switched=compensated, **drawn, **files)


def _babylon(name: str, switch: str, compensated: bool) -> Viewer:
    rule = PLAYCANVAS if compensated else PLAYCANVAS_CLASSIC
    formats = ("ply", "compressed.ply", "sog", "splat", "glb", "gltf")
    how = {"switched": compensated, "sh_degree": 3, "cut": ROOT_8, "floor": 0.0, "formats": formats}
    return Viewer(name, "Babylon.js 9.35.0", rule, switch, MEASURED, **how)


def _mkkellogg(name: str, convention: Convention, settings: str) -> Viewer:
    chosen = f"{settings}sphericalHarmonicsDegree: 2"
    how = {"sh_degree": 2, "cut": ROOT_8, "floor": 0.0, "apart": 0.1**0.5, "formats": ("ply", "splat")}
    return Viewer(name, "GaussianSplats3D 0.4.7", convention, chosen, MEASURED, switched=convention.compensated, **how)


def _gsplat(name: str, convention: Convention, settings: str) -> Viewer:
    return Viewer(name, "gsplat 1.5.3", convention, settings, MEASURED, switched=convention.compensated)


ENGINE, SUPERSPLAT, BRUSH = "PlayCanvas engine 2.23.3", "SuperSplat viewer 1.36.2", "Brush 2026-08"
VIEWERS: Registry[Viewer] = Registry(
    "viewer",
    "aaplug.methods.viewers:Viewer",
    named(
        (
            CLASSIC_VIEWER,
            Viewer("antialiased", "3DGS", ANTIALIASED, "--antialiasing", switched=True),
            MIP_VIEWER,
            Viewer(
                "khr",
                "glTF KHR_gaussian_splatting",
                KHR,
                NO_TAG,
                sh_degree=3,
                cut=3.0,
                shown_by=("cesium", "babylon-classic"),
                formats=("glb", "gltf"),
            ),
            Viewer(
                "usd", "OpenUSD 26.03's schema", KHR, NO_TAG, sh_degree=3, cut=3.0, formats=("usda", "usdc", "usdz")
            ),
            _spark("spark", ANTIALIASED, "the defaults: preBlurAmount 0, blurAmount 0.3"),
            _spark("spark-mip", MIP, "blurAmount: 0.1"),
            _spark("spark-classic", CLASSIC, "preBlurAmount: 0.3, blurAmount: 0"),
            _playcanvas("playcanvas", ENGINE, "app.scene.gsplat.antiAlias = true", True),
            _playcanvas("playcanvas-classic", ENGINE, "the default: app.scene.gsplat.antiAlias = false", False),
            _playcanvas("supersplat", SUPERSPLAT, "aa in the page's address (?aa; WebGL)", True, BY_SOURCE),
            _playcanvas("supersplat-classic", SUPERSPLAT, "the default: no aa in the page's address", False, BY_SOURCE),
            _babylon("babylon", "GaussianSplattingMaterial.Compensation = true", True),
            _babylon("babylon-classic", "the default: GaussianSplattingMaterial.Compensation = false", False),
            Viewer(
                "cesium",
                "CesiumJS 1.145.0",
                CESIUM,
                "nothing: it has no setting",
                MEASURED,
                sh_degree=3,
                cut=ROOT_8,
                floor=0.0,
                levels="geometric error of a tile over distance (maximumScreenSpaceError)",
                formats=("glb", "spz.glb"),
                smallest=SMALLEST,
            ),
            _mkkellogg("mkkellogg", ANTIALIASED, "antialiased: true, "),
            _mkkellogg("mkkellogg-mip", MIP, "antialiased: true, kernel2DSize: 0.1, "),
            _mkkellogg("mkkellogg-classic", CLASSIC, ""),
            Viewer("unity", "UnityGaussianSplatting 1a03ecd", CLASSIC, "nothing", BY_SOURCE, sh_degree=3, cut=ROOT_8),
            _gsplat("gsplat", ANTIALIASED, 'rasterize_mode="antialiased"'),
            _gsplat("gsplat-mip", MIP, 'rasterize_mode="antialiased", eps2d=0.1'),
            _gsplat("gsplat-classic", CLASSIC, 'the default: rasterize_mode="classic"'),
            Viewer("brush", BRUSH, MIP, "nothing: it follows the tag in the file", BY_SOURCE),
            Viewer("brush-classic", BRUSH, CLASSIC, "nothing: it follows the tag in the file", BY_SOURCE),
        )
    ),
)
FAST = Viewer("fast", "aaplug", None, "--recipe matched")


def find_viewer(viewer: str | Viewer | None) -> Viewer | None:
    """The viewer, by name or itself; raises UsageError if the name is not known."""
    return VIEWERS.find(viewer, "viewer") if isinstance(viewer, str) else viewer
