"""Shards of a batch: every n-th scene, evaluated by any machine that sees the folder of results; and their gathering.

A shard leaves a record, shard-3-of-8.json, beside its scenes' folders: what it was asked for, and what became of each
scene.  `gather` reads the records and the scenes' journals, and writes what one machine's run would have written.
"""

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from aaplug.core.errors import FormatError, UsageError, listing
from aaplug.core.monitor import SILENT, Monitor
from aaplug.evaluation.journal import read_report
from aaplug.io.atomic import claimed, refuse_existing
from aaplug.io.values import read_json
from aaplug.options.objects import AnyPath
from aaplug.verbs.batch import RESULTS, SUMMARY, Batch, write_batch
from aaplug.verbs.evaluate import JOURNAL
from aaplug.verbs.shard import Record, Shard

RECORD = re.compile(r"shard-(\d+)-of-(\d+)\.json")
DAMAGED = "is damaged; repeat that shard with --resume"
SAME = {"aaplug": "versions of aaplug", "request": "scenes or options"}  # what all shards must agree on


def gather(folder: AnyPath, *, overwrite: bool = False, monitor: Monitor = SILENT) -> Batch:
    """Write batch.json and results.csv of a batch whose shards are all done.

    Args:
        folder: the shards' folder of results.
        overwrite: replace the files of an earlier gathering.
        monitor: receives messages.

    Raises:
        UsageError: a shard is missing, two overlap, or they were not asked for the same.
        FormatError: a record or a journal is damaged.
        OutputError: there are results already, or they cannot be written.
    """
    folder = Path(folder)
    check = partial(refuse_existing, [folder / name for name in (SUMMARY, RESULTS)], overwrite)
    check()
    with claimed(folder, check):
        records = _records(folder)
        _check_alike(records)
        first = next(iter(records.values()))
        outcomes = {scene: outcome for record in records.values() for scene, outcome in record.outcomes.items()}
        failures = {scene: error for scene in first.names if (error := outcomes[scene]) is not None}
        done = [scene for scene in first.names if scene not in failures]
        found = Batch(first.names, {scene: read_report(folder / scene / JOURNAL) for scene in done}, failures)
        write_batch(found, folder, monitor)
    return found


def _records(folder: Path) -> dict[Shard, Record]:
    found = {}
    for path in sorted(folder.glob("shard-*.json")):
        if match := RECORD.fullmatch(path.name):
            found[Shard(int(match[1]), int(match[2]))] = _record(path)
    if not found:
        raise UsageError(str(folder), "holds no shard; `aaplug evaluate ... --shard 1/8` makes one")
    return dict(sorted(found.items()))


def _record(path: Path) -> Record:
    data = read_json(path)
    try:
        record = Record(**data)
        texts = [data["aaplug"], data["request"], *data["names"].values()]
        texts += [error for error in data["outcomes"].values() if error is not None]
    except (TypeError, AttributeError) as error:
        raise FormatError(path, DAMAGED) from error
    if not all(isinstance(text, str) for text in texts) or not record.outcomes.keys() <= record.names.keys():
        raise FormatError(path, DAMAGED)
    return record


def _check_alike(records: Mapping[Shard, Record]) -> None:
    """Refuse shards that are not one batch, each of its scenes once."""
    (shard, first), *others = records.items()
    for other, record in others:
        for key, what in SAME.items():
            one, two = getattr(first, key), getattr(record, key)
            if one != two:
                values = f" ({one} and {two})" if key == "aaplug" else ""
                raise UsageError(f"shards {shard} and {other}", f"have other {what}{values}; repeat one of them")
    for other, record in others:
        if twice := [name for s, r in records.items() if s < other for name in record.outcomes if name in r.outcomes]:
            holder = next(s for s, r in records.items() if twice[0] in r.outcomes)
            raise UsageError(
                f"shards {holder} and {other}", f"overlap: both hold {listing(twice)}; remove one's record"
            )
    known = {scene for record in records.values() for scene in record.outcomes}
    if missing := [scene for scene in first.names if scene not in known]:
        lacking = [s for n in range(1, shard.of + 1) if (s := Shard(n, shard.of)) not in records]
        named = listing([str(s) for s in lacking])
        raise UsageError(f"shard{'s' * (len(lacking) > 1)} {named}", f"missing or not done: {listing(missing)}")
