"""Run the campaign; see the package."""

import argparse
import os
import sys

from tests.bench.campaign import disks, files, kills, words

PARTS = ("files", "options", "disks", "kills")


def main() -> None:
    """Run the parts that are asked for, print counts, and fail if anything went wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.campaign")
    parser.add_argument("--mutations", type=int, default=100_000)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=PARTS, nargs="*", default=PARTS)
    asked = parser.parse_args()
    wrong: list[str] = []
    if "files" in asked.only:
        print("damaged files")
        print(f"files: {dict(files.run(asked.mutations, asked.seed))}")
    if "options" in asked.only:
        print("options")
        counts, found = words.run(os.cpu_count() or 1)
        print(f"options, by exit code: {dict(counts)}")
        wrong += found
    if "disks" in asked.only:
        print("full disks")
        count, found = disks.run()
        print(f"full disks: {count} runs, {len(found)} wrong")
        wrong += found
    if "kills" in asked.only:
        print("kills")
        counts, found = kills.run(asked.kills, asked.seed)
        print(f"kills: {counts}, {len(found)} wrong")
        wrong += found
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
