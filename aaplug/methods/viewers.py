"""Closed-form conversion: fuse anti-aliasing into a plain scene, for viewers that have only a fixed 2D filter.

A viewer adds a constant variance to every projected covariance, with or without compensation: its rule.  `fuse` targets
the Mip rule (0.1 px², compensated), `fuse_for` a named viewer.  Each Gaussian is converted independently;
`aaplug.finetuning` can then optimize all of them together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from aaplug.core.errors import UsageError
from aaplug.core.gaussians import (
    ANTIALIASED,
    CLASSIC,
    MIP,
    PLAYCANVAS,
    PLAYCANVAS_CLASSIC,
    Convention,
    Fusion,
    Gaussians,
)
from aaplug.core.registry import Registry, named
from aaplug.core.training import TrainingViews
from aaplug.methods.filters import MatchedEnergy, Smoothing3D, fuse_stored

FITTED_VARIANCE = 0.1  # px² at the median training rate, best measured; from uncompensated training to compensation
MOST_DEGREE = 4  # of spherical harmonics in any file
TUNED = "finetune"  # method that fine-tuning records in `Gaussians.fused`; it adds no blur
MERGED = "merge"  # method that levels of detail record; it keeps what blur there is


@dataclass(frozen=True)
class Form:
    """A closed-form conversion to the Mip rule.

    uses_bounds: whether the filter reads `TrainingViews.bounds`; if not, only the cameras.
    skips: convention of the scenes that need no conversion; None if all need one.
    """

    filter: MatchedEnergy | Smoothing3D
    uses_bounds: bool
    skips: Convention | None = None

    def with_variance(self, variance: float) -> "Form":
        """The same form with another fused variance, in px² at the training rate."""
        changed: Any = replace(self.filter, variance=variance)
        return replace(self, filter=changed)


MATCHED_ENERGY = Form(MatchedEnergy(), uses_bounds=False, skips=MIP)
FORMS: Registry[Form] = Registry(
    "form", {"matched-energy": MATCHED_ENERGY, "mip-splatting": Form(Smoothing3D(), uses_bounds=True)}, Form
)


@dataclass(frozen=True)
class Viewer:
    """A program with its settings, and the rule by which it then shows scenes.

    program: name and version that the rule was measured on or read from.
    recipe: name of the recipe that implements the rule.
    convention: what the file must declare for this rule; None keeps the scene's own convention.
    settings: what to choose in the program, for the user.
    switched: whether anti-aliasing is off there until these settings turn it on.
    sh_degree: highest degree of the harmonics that it draws.
    cut: where a splat ends, in words.
    """

    name: str
    program: str
    recipe: str
    convention: Convention | None
    settings: str
    switched: bool = False
    sh_degree: int = MOST_DEGREE
    cut: str = "alpha < 1/255"

    def convention_of(self, scene: Gaussians) -> Convention:
        """What the file of a scene for this viewer says."""
        return self.convention or scene.convention

    @property
    def rule(self) -> str:
        """The rule in words."""
        if self.convention is None:
            return f"recipe {self.recipe}"
        return f"{self.convention.kernel:g} px², {'' if self.convention.compensated else 'not '}compensated"

    @property
    def advice(self) -> str:
        """What to choose in the program to see a scene that was converted for it, one line."""
        if not self.switched:
            return f"in {self.program}, choose {self.settings}"
        without = "with it off, a converted scene can look worse than the original"
        return f"in {self.program}, turn anti-aliasing on: {self.settings} ({without})"

    def shown(self, scene: Gaussians) -> Gaussians:
        """The scene with the harmonics that the program draws."""
        coefficients = (self.sh_degree + 1) ** 2
        return scene if scene.sh.shape[1] <= coefficients else replace(scene, sh=scene.sh[:, :coefficients])


CLASSIC_VIEWER = Viewer("classic", "3DGS", "classic", CLASSIC, "nothing: anti-aliasing is off by default")
MIP_VIEWER = Viewer("mip", "Mip-Splatting's viewers", "mip", MIP, "a kernel of 0.1, the default")


def _spark(name: str, recipe: str, convention: Convention, settings: str) -> Viewer:
    return Viewer(name, "Spark 2.2.0", recipe, convention, settings, sh_degree=3, cut="√8 σ")


def _playcanvas(name: str, program: str, switch: str, compensated: bool) -> Viewer:
    rule = PLAYCANVAS if compensated else PLAYCANVAS_CLASSIC
    return Viewer(name, program, rule.name, rule, switch, compensated, sh_degree=3, cut="√8 σ, fading out")


def _mkkellogg(name: str, recipe: str, convention: Convention, settings: str) -> Viewer:
    chosen = f"{settings}sphericalHarmonicsDegree: 2"
    cut = "√8 σ; widths bent by √max(0.1, ·)"
    return Viewer(
        name, "GaussianSplats3D 0.4.7", recipe, convention, chosen, convention.compensated, sh_degree=2, cut=cut
    )


def _gsplat(name: str, recipe: str, convention: Convention, settings: str) -> Viewer:
    return Viewer(name, "gsplat 1.5.3", recipe, convention, settings, convention.compensated)


ENGINE, SUPERSPLAT, BRUSH = "PlayCanvas engine 2.23.3", "SuperSplat viewer 1.36.2", "Brush 2026-08"
VIEWERS: Registry[Viewer] = Registry(
    "viewer",
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
    Viewer,
)
FAST = Viewer("fast", "aaplug", "matched", None, "--recipe matched")


def find_viewer(viewer: str | Viewer | None) -> Viewer | None:
    """The viewer, by name or itself; raises UsageError if the name is not known."""
    return VIEWERS.find(viewer, "viewer") if isinstance(viewer, str) else viewer


def fuse(scene: Gaussians, training: TrainingViews | None, form: Form = MATCHED_ENERGY) -> Gaussians:
    """Convert a scene to the Mip rule: fuse its stored 3D filter, or apply `form` if it stores none.

    training: may be None if the scene stores a 3D filter.

    Raises:
        UsageError: something is fused already, the scene needs nothing, or cameras are missing.
    """
    _check(scene, form)
    if scene.filter_3d is not None:
        converted = fuse_stored(scene)
    elif training is None:
        raise UsageError(scene.name, "has no stored 3D filter: its conversion needs the training cameras")
    else:
        converted = form.filter(scene, training)
    return replace(converted, convention=MIP)


def fuse_for(scene: Gaussians, training: TrainingViews, viewer: Viewer) -> Gaussians:
    """Convert a scene for a viewer, which sees only the harmonics that it draws.

    If the viewer draws as training did, only a stored 3D filter is fused.

    Raises:
        UsageError: the viewer has a rule of its own, and the scene holds 2D Gaussians or blur is already fused.
    """
    if viewer.convention is None:
        return fuse_stored(scene)
    _check_convertible(scene)
    scene = fuse_stored(viewer.shown(scene))
    if scene.convention == viewer.convention:
        return scene
    return _energy_kept(scene.convention, viewer.convention)(scene, training)


def _energy_kept(trained: Convention, shown: Convention) -> MatchedEnergy:
    """Matched energy with the variance that training adds and the viewer does not."""
    fitted = shown.compensated and not trained.compensated
    return MatchedEnergy(FITTED_VARIANCE if fitted else trained.kernel - shown.kernel, shown)


def blurring(fused: Sequence[Fusion]) -> list[Fusion]:
    """The fusions that added blur: all but merging and fine-tuning."""
    return [fusion for fusion in fused if fusion.method not in (MERGED, TUNED)]


def describe(fusion: Fusion) -> str:
    """One printable phrase, such as "matched-energy (variance=0.2, views=25)"."""
    settings = ", ".join(f"{key}={value}" for key, value in fusion.settings.items())
    return f"{fusion.method} ({settings})" if settings else fusion.method


def fused_in(scene: Gaussians) -> str:
    """Everything that is fused in a scene, in words."""
    return "; ".join(describe(fusion) for fusion in scene.fused) or "nothing"


def _check(scene: Gaussians, form: Form) -> None:
    _check_convertible(scene)
    if form.skips == scene.convention and scene.filter_3d is None:
        raise UsageError(scene.name, "was trained by the Mip rule and stores no 3D filter: there is nothing to fuse")


def _check_convertible(scene: Gaussians) -> None:
    if scene.flat:
        raise UsageError(scene.name, "holds 2D Gaussians, which closed-form conversion does not support")
    blurs = blurring(scene.fused)
    if blurs:
        done = "; ".join(map(describe, blurs))
        raise UsageError(scene.name, f"already has {done} fused; converting it again would blur it twice")
