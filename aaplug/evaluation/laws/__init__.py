"""Laws of everything that a package can add: functions that raise where an object breaks them.

`aaplug check-plugin` runs them on a package's objects, and the tests on all that are registered.  A broken law is an
AssertionError; a law can also end in any exception that the object raises.  The first line of its docstring is the law.
"""

from collections.abc import Callable
from typing import Any

from . import drawing, files, filters, recipes

LAWS: dict[str, list[Callable[[Any], None]]] = {  # by kind
    "pixel kernel": [
        drawing.alpha_is_exact,
        drawing.rows_hold_colours,
        drawing.ellipses_bound_it,
        drawing.draws_the_exact_image,
    ],
    "compositor": [drawing.composites_the_exact_image],
    "rasterizer": [drawing.draws_what_the_reference_draws, drawing.keeps_its_splats],
    "metric": [files.is_ideal_for_the_truth],
    "loss": [files.is_least_for_the_truth, files.has_gradients_of_images],
    "scene format": [files.tells_scenes_apart, files.reads_what_it_writes, files.writes_the_same_files_again],
    "camera format": [files.tells_cameras_apart],
    "screen filter": [
        filters.keeps_splats,
        filters.never_shrinks_splats,
        filters.keeps_opacities_in_range,
        filters.keeps_huge_splats,
        filters.has_gradients_on_screen,
    ],
    "world filter": [
        filters.keeps_gaussians,
        filters.filters_each_by_itself,
        filters.never_shrinks_gaussians,
        filters.has_gradients_in_the_world,
    ],
    "recipe": [recipes.keeps_energy, recipes.fades_when_small, recipes.opaque_when_near, recipes.equals_training],
}
