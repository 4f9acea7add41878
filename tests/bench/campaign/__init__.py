"""A campaign of mistakes and attacks: damaged files, kills, full disks and every option with odd values.

    python -m tests.bench.campaign [--mutations 100000] [--kills 200] [--only files|kills|disks|options]

Prints counts.  Anything but an exit code of 0, 1, 2 or 130, with one line of error where it is not 0, fails.
"""
