"""Wrong values: every public function refuses them with an error that says where, what was expected and what came."""

import json
import subprocess
import sys

from tests.conftest import ROOT

LEAST_CALLS = 3000


def test_every_public_function_refuses_wrong_values_at_once_and_in_our_words():
    command = [sys.executable, "-m", "tests.wrong_calls"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=300)
    ends = json.loads(done.stdout)
    assert ends["calls"] >= LEAST_CALLS
    assert not ends["forgotten"], "functions that are not called"
    assert not ends["raw"], "errors of another library"
    assert not ends["passed"], "a stranger was taken"
    assert not ends["slow"], "a second or more"
