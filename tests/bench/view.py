"""The live view, measured: python -m tests.bench.view [GAUSSIANS ...] [--seconds N | --minutes N].

A scripted flight around a synthetic scene in a window of 1280x720 px, alone and by two clients at once.  Prints frames
a second while the camera moves, milliseconds from pose to picture (median, 95th percentile), seconds from rest to the
first picture of full quality, megabytes a second, and the process's peak memory.  The clients are threads of the same
process; they do not decode the pictures.

With --minutes, clients come and go for so long, each with a flight of its own size, recipe and paint; after each of
them it prints the memory that the process holds.
"""

import argparse
import itertools
import json
import math
import resource
import statistics
import struct
import threading
import time
from dataclasses import dataclass, field, replace
from typing import Any

import psutil
import torch
from websockets.sync.client import ClientConnection, connect

from aaplug.core import camera_paths
from aaplug.core.cameras import Camera, CameraSet
from aaplug.rendering.benchmark import synthetic_camera, synthetic_scene
from aaplug.verbs.view import serving

SIZES = (100_000, 550_000, 1_000_000)
WINDOW = (1280, 720)  # px
ASKED = 60  # poses a second, as a browser's screen asks
TURNS = 30.0  # seconds around the scene
DEPTH = 5.0  # world units to what the flight turns about
PAINTS: tuple[dict[str, Any], ...] = ({}, {"paint": "rate"}, {"paint": "cost"})
SIDES = [{"recipe": "classic", "quality": "best"}, {"recipe": "auto", "quality": "best"}]


@dataclass
class Flight:
    """What one client saw."""

    sent: dict[int, float] = field(default_factory=dict)
    delays: list[float] = field(default_factory=list)
    moving: int = 0
    bytes: int = 0
    rest: float = math.nan
    done: threading.Event = field(default_factory=threading.Event)

    def listen(self, connection: ClientConnection) -> None:
        """Receive pictures until all is done."""
        while not self.done.is_set():
            found = connection.recv()
            now = time.perf_counter()
            assert isinstance(found, bytes)
            (length,) = struct.unpack_from("<I", found)
            header = json.loads(found[4 : 4 + length])
            connection.send('{"shown": 1}')
            self.bytes += len(found)
            if header["stage"] == "moving":
                self.moving += 1
                self.delays.append(now - self.sent[header["id"]])
            elif header["stage"] == "complete" and math.isnan(self.rest):
                self.rest = now - self.sent[header["id"]]
            elif header["stage"] == "done":
                self.done.set()


def fly(address: str, view: Camera, seconds: float, flight: Flight, other: dict[str, Any] | None = None) -> None:
    """Turn about the scene, then rest.

    other: further fields of what is asked for.
    """
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    where = address.replace("http", "ws", 1) + "live"
    with connect(where, origin=address.rstrip("/"), proxy=None, max_size=None) as connection:  # pyright: ignore[reportArgumentType]
        connection.recv()
        listener = threading.Thread(target=flight.listen, args=(connection,))
        listener.start()
        began = time.perf_counter()
        for number in range(1, round(seconds * ASKED) + 1):
            time.sleep(max(0.0, began + number / ASKED - time.perf_counter()))
            pose = camera_paths.orbit(view, number / ASKED / TURNS, DEPTH, up).cam_from_world
            see = {"id": number, "pose": pose.flatten().tolist(), "focal": view.focal, "split": 0.5, "sides": SIDES}
            see |= {"width": view.width, "height": view.height, "moving": number < round(seconds * ASKED)} | (
                other or {}
            )
            flight.sent[number] = time.perf_counter()
            connection.send(json.dumps({"see": see}))
        flight.done.wait(60)
        listener.join()


def measured(gaussians: int, clients: int, seconds: float) -> str:
    """One line of the table."""
    view = synthetic_camera(*WINDOW).as_trained()
    free, cameras = replace(view, trained_focal=None), CameraSet((view,), (view,))
    with serving(synthetic_scene(gaussians), cameras, port=0, no_browser=True) as address:
        warm = Flight()
        fly(address, free, 2.0, warm)
        flights = [Flight() for _ in range(clients)]
        threads = [threading.Thread(target=fly, args=(address, free, seconds, flight)) for flight in flights]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    delays = sorted(1000 * delay for flight in flights for delay in flight.delays)
    cells = [
        f"{gaussians:,}", str(clients),
        " ".join(f"{flight.moving / seconds:.1f}" for flight in flights),
        f"{statistics.median(delays):.0f}", f"{delays[int(0.95 * len(delays))]:.0f}",
        " ".join(f"{flight.rest:.2f}" for flight in flights),
        f"{sum(flight.bytes for flight in flights) / seconds / 1e6:.1f}",
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f}",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def held(minutes: float, gaussians: int) -> None:
    """Print the memory that is held after each of many flights."""
    view = synthetic_camera(*WINDOW).as_trained()
    free, cameras = replace(view, trained_focal=None), CameraSet((view,), (view,))
    print("| minutes | pictures | GB held |\n|---|---|---|")
    with serving(synthetic_scene(gaussians), cameras, port=0, no_browser=True) as address:
        began, pictures = time.perf_counter(), 0
        for scale, recipe, paint in itertools.cycle(itertools.product((1, 0.5, 0.75), ("auto", "mip"), PAINTS)):
            flight = Flight()
            fly(
                address,
                free.scaled(scale),
                20.0,
                flight,
                {"sides": [SIDES[0], {"recipe": recipe, "quality": "best"}]} | paint,
            )
            pictures += flight.moving
            passed = (time.perf_counter() - began) / 60
            print(f"| {passed:.1f} | {pictures} | {psutil.Process().memory_info().rss / 1e9:.2f} |", flush=True)
            if passed > minutes:
                return


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("gaussians", nargs="*", type=int, default=SIZES)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--minutes", type=float)
    asked = parser.parse_args()
    if asked.minutes is not None:
        return held(asked.minutes, asked.gaussians[0])
    print("| Gaussians | clients | frames/s | pose to picture, ms | 95 % | rest to full quality, s | MB/s | GB |")
    print("|---|---|---|---|---|---|---|---|")
    for gaussians in asked.gaussians:
        for clients in (1, 2):
            print(measured(gaussians, clients, asked.seconds), flush=True)


if __name__ == "__main__":
    main()
