"""The files of a scene in time: a folder of .ply files, one a frame, numbered without gaps."""

import re
from itertools import pairwise
from pathlib import Path

from aaplug.system.errors import FormatError, listing

NUMBERED = re.compile(r"(.*?)(?<!\d)(?<!_lod)(\d+)((?:\.compressed)?\.ply)", re.ASCII)  # levels of detail are no frames


def frame_files(folder: Path) -> dict[Path, str]:
    """The numbers of the files of a scene in time, by file and in order; none if no two differ by a number alone.

    Raises FormatError where frames are missing or there twice, or of several sequences.
    """
    matches = [match for path in folder.glob("*.ply") if (match := NUMBERED.fullmatch(path.name))]
    named: dict[tuple[str, str], list[re.Match[str]]] = {}
    for match in sorted(matches, key=lambda match: (int(match[2]), match[0])):
        named.setdefault((match[1], match[3]), []).append(match)
    sequences = {name: found for name, found in named.items() if len(found) > 1}
    if not sequences:
        return {}
    if len(sequences) > 1:
        patterns = listing(sorted(f"{first}####{last}" for first, last in sequences))
        raise FormatError(folder, f"holds frames of {len(sequences)} sequences ({patterns}); give each a folder")
    [found] = sequences.values()
    for before, after in pairwise(found):
        if int(after[2]) != (expected := int(before[2]) + 1):
            problem = f"expected frame {expected} after {before[0]}, got {after[0]}"
            raise FormatError(folder, f"{problem}; or name one of the files")
    return {folder.absolute() / match[0]: match[2] for match in found}
