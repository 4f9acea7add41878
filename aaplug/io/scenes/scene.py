"""An opened scene file of any format: what it says, and its Gaussians whole or part by part.

A format decodes rows; this module checks their values, reports unusable ones, and joins parts.  Rows are counted from
0.  Nothing of the size of the scene is held in memory unless the whole scene is asked for.
"""

import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import CameraSet
from aaplug.core.conventions import CLASSIC, MIP, Convention
from aaplug.core.gaussians import Fusion, Gaussians, Origin, digest_of_scene, joined
from aaplug.core.pyramids import Pyramid
from aaplug.core.sampling import sampling_bounds
from aaplug.core.training import TrainingViews
from aaplug.io import STREAM_INDEXES
from aaplug.io.cameras import read_cameras, recognized
from aaplug.io.limits import lack_of_memory
from aaplug.io.scenes.columns import check_values, described_faults, faults_of, usable
from aaplug.io.scenes.rows import check_count, library_errors
from aaplug.system.contracts import check_fields, contract
from aaplug.system.digests import digest_of_values
from aaplug.system.errors import FormatError, UsageError, listing
from aaplug.system.plug_ins import blaming, check_answer
from aaplug.system.registry import registry_of

MODEL_SCENE = "point_cloud/iteration_*/point_cloud.ply"  # in an INRIA model folder, and in nerfbaselines' checkpoint
FOLDER_INDEXES = ("meta.json", STREAM_INDEXES["sog"])  # each marks a folder that is a scene: of SOG images, of chunks
PROBES = 512  # evenly spaced places in the file that `sample` reads: few enough to read before the work
PART = 1 << 16  # Gaussians per part: 15 MB at degree 3
FLOAT = 4  # bytes
MAX_HARMONICS_BYTES = 2 * 10**9  # reading more for each view costs less than holding them; 10 M Gaussians of degree 3
SHAPE_NUMBERS = 11  # of a Gaussian: mean, quaternion, scales, opacity
# A tag or flag tells that training compensated, not its kernel: splat-transform turns each format's into the others'.
# All are read as Brush's, which introduced the tag: so a scene converted for the Mip rule keeps it in every format.
COMPENSATED = MIP
KERNEL_LOST = f"its kernel is not recorded, {COMPENSATED.kernel:g} px² assumed"

log = logging.getLogger("aaplug")


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene: an opened file or folder, or Gaussians in memory.  It compares by identity.

    path: its file; None in memory.
    load: returns the rows from start up to stop exactly as stored; a file's without convention and origin.
    evidence: the convention's source in the file.
    document: the file's other contents, which its format's writer needs to give everything back.
    flat: see `Gaussians`.
    notes: facts worth printing about how the file was understood, a line each.
    other: the same file read in another way, where it does not say which is right; its last note says how.
    folder: of the levels of detail whose finest this is, or of the frames; else None.  read_levels: reads all levels.
    frames: of a scene in time, of which this is the first; else None.
    others: further files that hold it: other levels of detail or frames, images of SOG.
    drop_bad: rows that cannot be used are left out, instead of raising FormatError.
    memory: what was read of it, by name: each part is read once.

    Raises:
        FormatError: the file holds more Gaussians than the limit GAUSSIANS.
    """

    path: Path | None
    format: str
    count: int
    sh_degree: int
    load: Callable[[int, int], Gaussians] = field(repr=False)
    evidence: str
    convention: Convention = CLASSIC
    fused: tuple[Fusion, ...] = ()
    flat: bool = False
    document: Any = field(default=None, repr=False)
    notes: tuple[str, ...] = ()
    other: "Scene | None" = None
    folder: Path | None = None
    read_levels: Callable[[], Pyramid] | None = field(default=None, repr=False)
    frames: "SceneFrames | None" = None
    others: tuple[Path, ...] = ()
    drop_bad: bool = False
    memory: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.path is not None:
            check_count(self.path, self.count)

    @classmethod
    @contract
    def in_memory(cls, held: Gaussians | Pyramid) -> "Scene":
        """The scene of Gaussians, or of all levels; raises UsageError for NaN, infinite and unusable values."""
        check_values(held.scene if isinstance(held, Pyramid) else held)
        finest, levels = (held.finest, held) if isinstance(held, Pyramid) else (held, None)
        facts = finest.convention, finest.fused, finest.flat
        format, evidence, document = (o.format, o.evidence, o.document) if (o := finest.origin) else ("", "", None)
        format = format if levels is None else "levels"
        scene = cls(None, format, len(finest), finest.sh_degree, partial(held_rows, finest), evidence, *facts, document)
        scene.memory.update(gaussians=finest, levels=levels)
        return scene

    def __getstate__(self) -> dict[str, Any]:
        """Copies hold the rows: what reads a file does not leave its process."""
        rows = self.memory.get("gaussians")
        if rows is None or len(rows) != self.count:  # not read yet, or some were left out
            if "rows" not in self.memory:  # kept: torch shares a tensor with a new process only while it is held
                self.memory["rows"] = self.raw(0, self.count)
            rows = self.memory["rows"]
        return {**vars(self), "load": partial(held_rows, rows), "other": None}

    @property
    def name(self) -> str:
        """For messages: the file, or "scene"."""
        return str(self.path) if self.path is not None else self.memory["gaussians"].name

    @property
    def title(self) -> str:
        """The name that people use: the file's, or its folder's where its format names the file; or "scene"."""
        if self.file is None:
            return "scene"
        if self.file.match(MODEL_SCENE):
            return self.file.parents[2].name
        return self.file.parent.name if self.file.name in FOLDER_INDEXES else self.file.name

    @property
    def file(self) -> Path | None:
        """The file that it was read from, or its folder of levels of detail or frames; None if it has none."""
        path = self.folder or self.source
        return None if path is None else path.resolve()

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that hold it, which no output replaces."""
        return () if self.source is None else (self.source, *self.others)

    @property
    def source(self) -> Path | None:
        """The file that its rows come from; of levels of detail the finest's."""
        origin = None if self.path is not None else self.memory["gaussians"].origin
        return self.path if origin is None else Path(origin.path)

    @property
    def bytes(self) -> int | None:
        """Size of `files`; None if there is none."""
        try:
            return sum(file.stat().st_size for file in self.files) if self.files else None
        except OSError:
            return None

    @property
    def camera_path(self) -> Path | None:
        """The scene's file or folder, or the model folder that its file is in, if that holds cameras."""
        path = self.folder or self.source
        if path is None:
            return None
        place = Path(os.path.normpath(path.parent / "../..")) if path.absolute().match(MODEL_SCENE) else path
        return place if recognized(place) else None

    @property
    def cameras(self) -> CameraSet | None:
        """The cameras of `camera_path`; None if there are none.  Raises as `read_cameras`."""
        path = self.camera_path
        return None if path is None else read_cameras(path)

    @property
    @torch.inference_mode(False)  # autograd may follow later what is kept
    def levels(self) -> Pyramid | None:
        """All levels of detail, read once; None if there is but one.  Raises FormatError if a level is broken."""
        if "levels" not in self.memory:
            self.memory["levels"] = self.read_levels and self.read_levels()
        return self.memory["levels"]

    @torch.inference_mode(False)
    def gaussians(self) -> Gaussians:
        """All Gaussians, read once; of levels of detail the finest.

        Raises:
            FormatError: a row cannot be used and `drop_bad` is false, the file breaks its format, or it takes more
                than the limit MEMORY_SHARE of the machine's memory.
        """
        if "gaussians" not in self.memory:
            self.check_memory()
            [self.memory["gaussians"]] = self.parts(max(1, self.count))
        return self.memory["gaussians"]

    @property
    def digest(self) -> str:
        """Hash of the Gaussians of all levels or frames, with everything that they are drawn by."""
        if self.frames is not None:
            return digest_of_values([frame.digest for frame in self.frames])
        return digest_of_scene(self.gaussians() if self.levels is None else self.levels.scene)

    @contract
    def raw(self, start: int, stop: int) -> Gaussians:
        """The rows from start up to stop, with convention and origin; their values are not checked."""
        if self.path is None:
            return self.load(start, stop)
        origin = Origin(str(self.path), self.format, self.evidence, self.document, torch.arange(start, stop))
        reader = registry_of("scene format").get(self.format, self.load)
        with library_errors(self.path), blaming(("scene format", reader), file=self.path, code=self.load):
            rows = self.load(start, stop)
        check_answer(f"`load` of format {self.format}", rows, Gaussians)
        if len(rows) != stop - start:
            problem = f"`load` of format {self.format} should return {stop - start:,} Gaussians, got {len(rows):,}"
            raise FormatError(self.path, problem)
        facts = {"convention": self.convention, "fused": self.fused, "flat": self.flat}
        return replace(rows, **facts, origin=origin)

    def parts(self, size: int = PART, faults: Counter[str] | None = None) -> Iterator[Gaussians]:
        """The scene part by part, at least one, checked.

        size: Gaussians per part.
        faults: receives the faults of rows that are left out and their numbers, and leaves out such rows; None logs
            the number of rows that `drop_bad` leaves out.
        Raises FormatError for a row that cannot be used where neither `drop_bad` nor `faults` asks to leave it out.
        """
        dropped, left_out = Counter[str]() if faults is None else faults, 0
        for start in range(0, max(self.count, 1), size):
            part = self.raw(start, min(start + size, self.count))
            if found := faults_of(part):
                if faults is None and not self.drop_bad:
                    what = described_faults(found, start)
                    raise FormatError(self.name, f"{what}; pass `drop_bad` to leave such rows out")
                dropped.update({text: int(rows.sum()) for text, rows in found.items()})
                good = usable(part)
                left_out, part = left_out + len(part) - len(good), good
            yield part
        if left_out and faults is None:
            counts = listing([f"{text}: {number:,}" for text, number in dropped.items()])
            log.warning("%s: left out %d of %d Gaussians (%s)", self.name, left_out, self.count, counts)

    def decoded(self) -> "Scene":
        """This reading alone, its rows decoded once and kept; raises FormatError as `gaussians`."""
        self.check_memory()
        return replace(self, load=partial(held_rows, self.raw(0, self.count)), other=None)

    def sample(self, each: int) -> Gaussians:
        """Usable Gaussians from evenly spaced places, `each` at a place: enough to know where the scene is."""
        starts = range(0, max(1, self.count), max(each, self.count // PROBES))
        return usable(joined([self.raw(start, min(start + each, self.count)) for start in starts]))

    def check_memory(self, harmonics: bool = True) -> None:
        """Refuse a scene above the limit MEMORY_SHARE of the machine's memory, with or without harmonics."""
        needed = memory_of(self.count, self.sh_degree) if harmonics else memory_of(self.count)
        if lacking := lack_of_memory(needed):
            hint = "info and convert read it in parts, AAPLUG_MEMORY_SHARE=1 allows all"
            raise FormatError(self.name, f"its {self.count:,} Gaussians take {lacking}; {hint}")


@dataclass(frozen=True)
class SceneFrames:
    """The frames of a scene in time, of which one is open at a time.

    Gaussian i of each frame is the same thing at another time, unless the frames were trained apart.  Its sampling
    rates are those over all frames and cameras, as Alias-Free 4D Gaussian Splatting (arXiv 2511.18367) takes the
    maximum over time: filters that follow them do not change from frame to frame.

    paths: their files, in order.  numbers: theirs, as the files' names write them.  open: opens one of the files.
    apart: they were trained apart, so that each has sampling rates of its own.
    """

    paths: tuple[Path, ...]
    numbers: tuple[str, ...]
    open: Callable[[Path], Scene]
    apart: bool = False

    def __len__(self) -> int:
        return len(self.paths)

    def __iter__(self) -> Iterator[Scene]:
        return map(self.open, self.paths)

    def check(self) -> None:
        """Read what every file says, without its rows; raises FormatError for one that is broken or of another kind."""
        names = ("degree of harmonics", "convention", "2D Gaussians", "number of Gaussians")
        kinds = [(s.sh_degree, s.convention.name, s.flat, not self.apart and s.count) for s in self]
        for path, kind in zip(self.paths, kinds, strict=True):
            for name, value, first in zip(names, kind, kinds[0], strict=True):
                if value != first:
                    hint = "; pass `frames_apart` if each frame was trained alone" * (name == names[-1])
                    raise FormatError(path, f"expected the {name} of {self.paths[0].name}, {first}, got {value}{hint}")

    def over_all(self, training: TrainingViews) -> TrainingViews:
        """The training views of the first frame, with sampling bounds over all; raises as `training_of`."""
        for frame in () if self.apart else islice(self, 1, None):
            training = self.training_of(gaussians := frame.gaussians(), training)
            more = sampling_bounds(gaussians.means, training.cameras)
            training = replace(training, bounds=training.bounds.over(more))
        return training

    def training_of(self, frame: Gaussians, training: TrainingViews) -> TrainingViews:
        """The training views of a frame; training: of the scene.  Raises UsageError for another number of Gaussians."""
        if self.apart:
            return TrainingViews.of(frame, training.cameras, training.cull_margin)
        if len(frame) != (count := len(training.bounds.views)):
            raise UsageError(frame.name, f"expected {count:,} Gaussians, as in the frames before, got {len(frame):,}")
        return training


def memory_of(count: int, degree: int | None = None) -> int:
    """Bytes that so many Gaussians take in memory; degree: of their harmonics, None without any."""
    return count * FLOAT * (SHAPE_NUMBERS + (0 if degree is None else 3 * (degree + 1) ** 2))


def held_rows(held: Gaussians, start: int, stop: int) -> Gaussians:
    """The rows from start up to stop of Gaussians in memory."""
    return held[start:stop]


def harmonics_in_file(
    path: Path, load: Callable[[int, int], Gaussians], rows: Int[Tensor, " n"], start: int, stop: int
) -> Float[Tensor, "c k 3"]:
    """Harmonics as stored, of Gaussians from start up to stop; raises FormatError if the file has changed.

    path: the scene's file.  load: see `Scene`.  rows: the file's row of each Gaussian, increasing.
    """
    rows = rows[start:stop]
    first, end = int(rows[0]), int(rows[-1]) + 1
    with library_errors(path):
        harmonics = load(first, end).sh
    return harmonics if end - first == len(rows) else harmonics[rows - first]


@torch.inference_mode(False)
def without_harmonics(scene: Scene) -> tuple[Gaussians, Callable[[int, int], Tensor] | None]:
    """The scene's Gaussians, and what reads their harmonics where these are large and stay in the file; else None.

    `sh` then has its shape but is NaN and takes no memory.  All values are checked, the harmonics too, part by part.
    Only a .ply is read by rows, and only while nobody has asked for all of its Gaussians.  Raises FormatError as
    `Scene.gaussians`.
    """
    path, in_memory = scene.path, "gaussians" in scene.memory
    harmonics_bytes = memory_of(scene.count, scene.sh_degree) - memory_of(scene.count)
    if path is None or in_memory or scene.format != "ply" or harmonics_bytes <= MAX_HARMONICS_BYTES:
        return scene.gaussians(), None
    if "without harmonics" not in scene.memory:
        scene.check_memory(harmonics=False)
        nothing = torch.full((1, 1, 3), torch.nan)
        bare = joined([replace(part, sh=nothing.expand(len(part), 1, 3)) for part in scene.parts()])
        assert bare.origin is not None
        nothing = nothing.expand(len(bare), (scene.sh_degree + 1) ** 2, 3)
        harmonics = partial(harmonics_in_file, path, scene.load, bare.origin.rows)
        scene.memory["without harmonics"] = replace(bare, sh=nothing), harmonics
    return scene.memory["without harmonics"]
