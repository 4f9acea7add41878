"""Frames a second, delay and memory of the live view, by scripted flights around synthetic scenes.

A flight is in a window of 1280x720 px, alone and by two clients at once.  The columns have frames a second while the
camera moves, milliseconds from pose to picture (median, 95th percentile), seconds from rest to the first picture of
full quality, megabytes a second, and the process's peak memory.  The clients are threads of the same process; they do
not decode the pictures.
"""

import itertools
import json
import math
import resource
import statistics
import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from websockets.sync.client import ClientConnection, connect

from aaplug import Camera, CameraSet, serving
from aaplug.core import camera_paths
from aaplug.rendering.benchmark import synthetic_camera, synthetic_scene
from tests.bench import heading, row

WINDOW = (1280, 720)  # px
POSES_PER_SECOND = 60  # as a browser's screen asks
TURN_SECONDS = 30.0  # once around the scene
DEPTH = 5.0  # world units to what the flight turns about
SIDES = [{"recipe": "classic", "quality": "best"}, {"recipe": "auto", "quality": "best"}]


def main(gaussians: Sequence[int] = (100_000, 550_000, 1_000_000), seconds: float = 30.0) -> None:
    """Print the table; seconds: of a flight."""
    delays = ("pose to picture, ms", "95 %", "rest to full quality, s")
    heading("the live view", "Gaussians", "clients", "frames/s", *delays, "MB/s", "GB")
    trained = synthetic_camera(*WINDOW).as_trained()
    view, cameras = replace(trained, trained_focal=None), CameraSet((trained,), (trained,))
    for count, clients in itertools.product(gaussians, (1, 2)):
        with serving(synthetic_scene(count), cameras, port=0, no_browser=True) as address:
            Flight().fly(address, view, 2.0)  # warms up
            flights = [Flight() for _ in range(clients)]
            threads = [threading.Thread(target=flight.fly, args=(address, view, seconds)) for flight in flights]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        delayed = sorted(1000 * delay for flight in flights for delay in flight.delays)
        row(
            f"{count:,}",
            clients,
            " ".join(f"{len(flight.delays) / seconds:.1f}" for flight in flights),
            *(f"{statistics.median(delayed):.0f}", f"{delayed[int(0.95 * len(delayed))]:.0f}"),
            " ".join(f"{flight.rest:.2f}" for flight in flights),
            f"{sum(flight.bytes for flight in flights) / seconds / 1e6:.1f}",
            resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
        )


@dataclass
class Flight:
    """One client's flight.

    requests: times at which pictures were asked for, by number.  delays: of pictures while the camera moves, in s.
    rest: seconds from rest to full quality.
    """

    requests: dict[int, float] = field(default_factory=dict)
    delays: list[float] = field(default_factory=list)
    bytes: int = 0
    rest: float = math.nan
    done: threading.Event = field(default_factory=threading.Event)

    def fly(self, address: str, view: Camera, seconds: float) -> None:
        """Turn about the scene, then rest."""
        up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
        where = address.replace("http", "ws", 1) + "live"
        with connect(where, origin=address.rstrip("/"), proxy=None, max_size=None) as connection:  # pyright: ignore[reportArgumentType]
            connection.recv()
            listener = threading.Thread(target=self.listen, args=(connection,))
            listener.start()
            began, count = time.perf_counter(), round(seconds * POSES_PER_SECOND)
            for number in range(1, count + 1):
                time.sleep(max(0.0, began + number / POSES_PER_SECOND - time.perf_counter()))
                pose = camera_paths.orbit(view, number / POSES_PER_SECOND / TURN_SECONDS, DEPTH, up).cam_from_world
                see = {"id": number, "pose": pose.flatten().tolist(), "focal": view.focal, "split": 0.5, "sides": SIDES}
                see |= {"width": view.width, "height": view.height, "moving": number < count}
                self.requests[number] = time.perf_counter()
                connection.send(json.dumps({"see": see}))
            self.done.wait(60)
            listener.join()

    def listen(self, connection: ClientConnection) -> None:
        """Receive pictures until all is done."""
        while not self.done.is_set():
            message = connection.recv()
            now = time.perf_counter()
            assert isinstance(message, bytes)
            (length,) = struct.unpack_from("<I", message)
            header = json.loads(message[4 : 4 + length])
            connection.send('{"shown": 1}')
            self.bytes += len(message)
            delay = now - self.requests[header["id"]]
            if header["stage"] == "moving":
                self.delays.append(delay)
            elif header["stage"] == "complete" and math.isnan(self.rest):
                self.rest = delay
            elif header["stage"] == "done":
                self.done.set()
