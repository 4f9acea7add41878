"""Wrong values: every public function refuses them with an error that says where, what was expected and what came."""

import json

from tests.conftest import run_python

LEAST_CALLS = 3000


def test_every_public_function_refuses_wrong_values_at_once_and_in_our_words():
    ends = json.loads(run_python("from tests.wrong_calls import main; main()").stdout)
    assert ends["calls"] >= LEAST_CALLS
    assert not ends["forgotten"], "functions that are not called"
    assert not ends["raw"], "errors of another library"
    assert not ends["passed"], "a stranger was taken"
    assert not ends["slow"], "a second or more"
