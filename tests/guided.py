"""Scene readers under a fuzzer that follows coverage (atheris).

    python -m tests.guided [libFuzzer's flags, such as -max_total_time=60]

An input is a format's place in `NAMES`, one byte, and a file.  It must end as a scene or as an error of ours; the seeds
are the small scenes of the tests.
"""

import sys
import tempfile
from pathlib import Path

import atheris  # pyright: ignore[reportMissingImports]

with atheris.instrument_imports(include=["aaplug.io"]):
    import aaplug.io.scenes  # noqa: F401

from tests.hostile import NAMES, outcome
from tests.scene_files import write_file


def main() -> None:
    """Fuzz until a flag says stop."""
    folder = Path(tempfile.mkdtemp(prefix="aaplug-guided-"))
    seeds = folder / "seeds"
    seeds.mkdir()
    names = [
        n for n in NAMES if n != "run.pt" and "/" not in n
    ]  # torch's unpickler is not ours; folders are many files
    for place, name in enumerate(names):
        (seeds / name).write_bytes(bytes([place]) + write_file(folder, name).read_bytes())

    def read(data: bytes) -> None:
        if data:
            path = folder / names[data[0] % len(names)]
            path.write_bytes(data[1:])
            found = outcome(path)
            assert found in ("read", "refused"), found

    atheris.Setup([*sys.argv, "-max_len=20000", f"-artifact_prefix={folder}/", str(seeds)], read)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
