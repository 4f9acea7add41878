"""Wrong values: every public function refuses them with an error that says where, what was expected and what came."""

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT

LEAST_CALLS = 3000


@pytest.fixture(scope="module")
def ends():
    command = [sys.executable, "-m", "tests.wrong_calls"]
    return json.loads(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=300).stdout)


def test_no_wrong_call_ends_in_an_error_of_another_library(ends):
    assert not ends["raw"]
    assert ends["calls"] >= LEAST_CALLS


def test_every_public_function_is_called(ends):
    assert not ends["forgotten"]


def test_no_function_takes_a_stranger(ends):
    assert not ends["passed"]


def test_a_wrong_call_takes_less_than_a_second(ends):
    assert not ends["slow"]
