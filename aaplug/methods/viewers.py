"""Viewers: programs that show scenes, each with the rule by which it turns covariances into pixels.

A viewer adds a constant variance to every projected covariance, with or without compensation: its rule.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from aaplug.core.conventions import (
    ANTIALIASED,
    CLASSIC,
    MIP,
    PLAYCANVAS,
    PLAYCANVAS_CLASSIC,
    Convention,
    SpzAxes,
    SpzVersion,
)
from aaplug.system.registry import Registry, named

if TYPE_CHECKING:
    from aaplug.core.gaussians import Gaussians

MOST_DEGREE = 4  # of spherical harmonics in any file


@dataclass(frozen=True)
class Viewer:
    """A program with its settings, and the rule by which it then shows scenes.

    program: name and version that the rule was measured on or read from.
    recipe: name of the recipe that implements the rule.
    convention: what the file must declare for this rule; None keeps the scene's own convention.
    settings: what to choose in the program, for the user.
    switched: anti-aliasing is off there until these settings turn it on.
    sh_degree: highest degree of the harmonics that it draws.
    cut: the end of a splat, in words.
    formats: suffixes of the scene files that the program is known to open, of those that aaplug writes.
    spz_axes: in which it takes the numbers of a .spz; "auto": those of the specification.
    spz_version: of a .spz that it takes.
    """

    name: str
    program: str
    recipe: str
    convention: Convention | None
    settings: str
    switched: bool = False
    sh_degree: int = MOST_DEGREE
    cut: str = "alpha < 1/255"
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

    def advice(self, suffix: str = "ply") -> str:
        """One line on the settings to choose in the program for a file that was converted for it."""
        if suffix not in self.formats:
            others = (v for v in VIEWERS.values() if suffix in v.formats and v.convention == self.convention)
            known = " or ".join(f"{viewer.program} ({viewer.settings})" for viewer in others)
            return f"open the .{suffix} in {known}" if known else f"no viewer of this rule is known to open a .{suffix}"
        if not self.switched:
            return f"in {self.program}, choose {self.settings}"
        without = "with it off, a converted scene can look worse than the original"
        return f"in {self.program}, turn anti-aliasing on: {self.settings} ({without})"

    def spz(self, asked: SpzAxes) -> "dict[str, Any]":
        """How a .spz is written, for `write_scene`: axes as asked for, or the program's own, and its version."""
        return {"spz_axes": self.spz_axes if asked == "auto" else asked, "spz_version": self.spz_version}

    def shown(self, scene: "Gaussians") -> "Gaussians":
        """The scene with the harmonics that the program draws."""
        coefficients = (self.sh_degree + 1) ** 2
        return scene if scene.sh.shape[1] <= coefficients else replace(scene, sh=scene.sh[:, :coefficients])


CLASSIC_VIEWER = Viewer("classic", "3DGS", "classic", CLASSIC, "nothing: anti-aliasing is off by default")
MIP_VIEWER = Viewer("mip", "Mip-Splatting's viewers", "mip", MIP, "a kernel of 0.1, the default")


def _spark(name: str, recipe: str, convention: Convention, settings: str) -> Viewer:
    how = {"sh_degree": 3, "cut": "√8 σ", "formats": ("ply", "spz", "splat"), "spz_axes": "opencv", "spz_version": 3}
    return Viewer(name, "Spark 2.2.0", recipe, convention, settings, **how)


def _playcanvas(name: str, program: str, switch: str, compensated: bool) -> Viewer:
    rule = PLAYCANVAS if compensated else PLAYCANVAS_CLASSIC
    return Viewer(name, program, rule.name, rule, switch, compensated, sh_degree=3, cut="√8 σ, fading out")


def _mkkellogg(name: str, recipe: str, convention: Convention, settings: str) -> Viewer:
    chosen = f"{settings}sphericalHarmonicsDegree: 2"
    cut = "√8 σ; widths bent by √max(0.1, ·)"
    how = {"sh_degree": 2, "cut": cut, "formats": ("ply", "splat")}
    return Viewer(name, "GaussianSplats3D 0.4.7", recipe, convention, chosen, convention.compensated, **how)


def _gsplat(name: str, recipe: str, convention: Convention, settings: str) -> Viewer:
    return Viewer(name, "gsplat 1.5.3", recipe, convention, settings, convention.compensated)


ENGINE, SUPERSPLAT, BRUSH = "PlayCanvas engine 2.23.3", "SuperSplat viewer 1.36.2", "Brush 2026-08"
VIEWERS: Registry[Viewer] = Registry(
    "viewer",
    "aaplug.methods.viewers:Viewer",
    named(
        (
            CLASSIC_VIEWER,
            Viewer("antialiased", "3DGS", "ewa", ANTIALIASED, "--antialiasing", switched=True),
            MIP_VIEWER,
            _spark("spark", "ewa", ANTIALIASED, "the defaults: preBlurAmount 0, blurAmount 0.3"),
            _spark("spark-mip", "mip", MIP, "blurAmount: 0.1"),
            _spark("spark-classic", "classic", CLASSIC, "preBlurAmount: 0.3, blurAmount: 0"),
            _playcanvas("playcanvas", ENGINE, "app.scene.gsplat.antiAlias = true", True),
            _playcanvas("playcanvas-classic", ENGINE, "the default: app.scene.gsplat.antiAlias = false", False),
            _playcanvas("supersplat", SUPERSPLAT, "aa in the page's address (?aa; WebGL)", True),
            _playcanvas("supersplat-classic", SUPERSPLAT, "the default: no aa in the page's address", False),
            _mkkellogg("mkkellogg", "ewa", ANTIALIASED, "antialiased: true, "),
            _mkkellogg("mkkellogg-mip", "mip", MIP, "antialiased: true, kernel2DSize: 0.1, "),
            _mkkellogg("mkkellogg-classic", "classic", CLASSIC, ""),
            _gsplat("gsplat", "ewa", ANTIALIASED, 'rasterize_mode="antialiased"'),
            _gsplat("gsplat-mip", "mip", MIP, 'rasterize_mode="antialiased", eps2d=0.1'),
            _gsplat("gsplat-classic", "classic", CLASSIC, 'the default: rasterize_mode="classic"'),
            Viewer("brush", BRUSH, "mip", MIP, "nothing: it follows the tag in the file"),
            Viewer("brush-classic", BRUSH, "classic", CLASSIC, "nothing: it follows the tag in the file"),
        )
    ),
)
FAST = Viewer("fast", "aaplug", "matched", None, "--recipe matched")


def find_viewer(viewer: str | Viewer | None) -> Viewer | None:
    """The viewer, by name or itself; raises UsageError if the name is not known."""
    return VIEWERS.find(viewer, "viewer") if isinstance(viewer, str) else viewer
