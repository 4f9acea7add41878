"""Peak memory and time of sampling bounds at full size: python -m tests.bench.sampling_bounds [GAUSSIANS] [CAMERAS]."""

import resource
import sys
import time

import torch

from aaplug.core.sampling import sampling_bounds
from tests.conftest import make_camera

KIB = 1024


def main(gaussians: int = 3_000_000, cameras: int = 300) -> None:
    angles = torch.linspace(0, 6.28, cameras)
    views = [make_camera((4 * a.cos().item(), 4 * a.sin().item(), 1.0), (1600, 1060)) for a in angles]
    means = torch.randn(gaussians, 3)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KIB
    started = time.perf_counter()
    bounds = sampling_bounds(means, views)
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * KIB
    pairs = gaussians * cameras
    print(f"{gaussians:,} Gaussians × {cameras} cameras: {seconds:.1f} s, {seconds / pairs * 1e9:.2f} ns a pair")
    print(f"peak {peak / 1e9:.2f} GB in all, {(peak - before) / 1e9:.2f} GB above the scene's means")
    print(f"seen by any camera: {bounds.seen.double().mean():.1%}")


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
