"""A shard of a batch: every n-th scene, and the record that it leaves."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from aaplug.core.errors import SHOWN, UsageError

MOST = 100_000  # shards of a batch


class Shard(NamedTuple):
    """The number-th of so many shards, counted from 1."""

    number: int
    of: int

    @classmethod
    def read(cls, text: str) -> "Shard":
        """The shard that "3/8" means; raises UsageError if it means none."""
        match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
        if match is None or not 1 <= int(match[1]) <= int(match[2]) <= MOST:
            raise UsageError("shard", f"takes 1/8 to 8/8 of 8 shards, or of up to {MOST:,}; got {text[:SHOWN]}")
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    def holds(self, place: int) -> bool:
        """Whether the scene at a place, counted from 0, is in it."""
        return place % self.of == self.number - 1

    @property
    def record(self) -> str:
        """Name of the file that says what became of it."""
        return f"shard-{self.number}-of-{self.of}.json"


@dataclass(frozen=True)
class Record:
    """What a shard was asked for, and what became of its scenes.

    aaplug: version.  request: hash of the batch's scenes and options.
    names: of all scenes of the batch, by folder.  outcomes: why each of the shard's failed; None for what is done.
    """

    aaplug: str
    request: str
    names: Mapping[str, str]
    outcomes: Mapping[str, str | None]
