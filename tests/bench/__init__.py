"""Measurements: heavy, never part of the tests."""

import os

import torch


def take_all_threads() -> None:
    """Those of the machine, as aaplug does; `tests.conftest` leaves one."""
    torch.set_num_threads(os.cpu_count() or 1)
