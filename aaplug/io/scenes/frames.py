"""The files of a scene in time: a folder of .ply files, one a frame, numbered without gaps."""

import re
from pathlib import Path

from aaplug.system.errors import FormatError, listing

NUMBERED = re.compile(r"(.*?)(?<!\d)(?<!_lod)(\d+)((?:\.compressed)?\.ply)", re.ASCII)  # levels of detail are no frames


def frame_files(folder: Path) -> dict[Path, str]:
    """The numbers of the files of a scene in time, by file and in order; none if no two differ by a number alone.

    Raises:
        FormatError: frames are missing, or there are frames of several sequences.
    """
    matches = [match for path in folder.glob("*.ply") if (match := NUMBERED.fullmatch(path.name))]
    named: dict[tuple[str, str], list[re.Match[str]]] = {}
    for match in sorted(matches, key=lambda match: int(match[2])):
        named.setdefault((match[1], match[3]), []).append(match)
    sequences = {name: found for name, found in named.items() if len(found) > 1}
    if not sequences:
        return {}
    if len(sequences) > 1:
        patterns = listing(sorted(f"{first}####{last}" for first, last in sequences))
        raise FormatError(folder, f"holds frames of {len(sequences)} sequences ({patterns}); give each a folder")
    [found] = sequences.values()
    numbers = [int(match[2]) for match in found]
    missing = sorted({*range(numbers[0], numbers[-1] + 1)} - {*numbers})
    if missing or len({*numbers}) < len(numbers):
        span = f"{found[0][0]} to {found[-1][0]}"
        problem = f"lack {listing([*map(str, missing)], most=3)}" if missing else "have a number twice"
        raise FormatError(folder, f"its frames {span} {problem}; or name one of the files")
    return {folder.absolute() / match[0]: match[2] for match in found}
