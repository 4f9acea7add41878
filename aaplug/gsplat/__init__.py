"""gsplat's `rasterization` on the CPU, with the same arguments and results.

    from aaplug.gsplat import rasterization  # was: from gsplat import rasterization

`aaplug.gsplat.patch()` does so for a whole program.

gsplat (Ye et al., arXiv 2409.06765) has no CPU path.  This one is aaplug's own projection and rasterizers under
gsplat's rules, written from gsplat's documentation.
"""

from aaplug.gsplat.drop_in import rasterization
from aaplug.gsplat.patching import patch
from aaplug.gsplat.surfels import rasterization_2dgs

__all__ = ["patch", "rasterization", "rasterization_2dgs"]
