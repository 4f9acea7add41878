"""Shards of a batch, run apart and gathered: the bytes of one machine's run, and what is refused."""

import json
import shutil
from pathlib import Path

import pytest

import aaplug
from aaplug.core.errors import UsageError
from aaplug.verbs.shard import MOST, Shard
from tests.test_batch import timeless
from tests.test_cli import cli, dataset  # noqa: F401  (fixtures)

WORDS = "evaluate --batch batch.toml -o out"
SETTINGS = """
recipe = "matched"
scale = [0.5]
views = "train"
metric = ["psnr", "ssim"]
rasterizer = "eager"
cameras = "."
"""
SCENES = ("one", "two", "broken")


@pytest.fixture
def shards(cli):  # noqa: F811
    """The program, in a folder that holds a batch of two whole scenes and a broken one."""
    for name in SCENES:
        shutil.copy("scene.ply", f"{name}.ply")
    Path("broken.ply").write_bytes(Path("scene.ply").read_bytes()[:-100])
    Path("batch.toml").write_text(SETTINGS + "".join(f'[[scene]]\nscene = "{name}.ply"\n' for name in SCENES))
    return cli


def test_shards_that_are_gathered_are_one_machines_run(shards):
    assert shards(WORDS)[0] == 1  # one scene is broken
    Path("out").rename("whole")
    assert [shards(f"{WORDS} --shard {n}/2")[0] for n in (2, 1)] == [0, 1]
    assert not Path("out/batch.json").exists()
    code, out, err = shards("gather out")
    assert (code, "failed" in out, "wrote out/batch.json" in err) == (1, True, True)
    records = {"shard-1-of-2.json", "shard-2-of-2.json"}
    found, whole = timeless(Path("out")), timeless(Path("whole"))
    assert {name: found[name] for name in found.keys() - records} == whole
    assert Path("out/batch.json").read_bytes() == Path("whole/batch.json").read_bytes()
    assert shards("gather out")[0] == 2
    assert json.loads(shards("gather out --overwrite --json")[1])["mean_over"] == ["one", "two"]
    assert timeless(Path("out")) == found
    assert set(aaplug.gather("out", overwrite=True).failures) == {"broken"}


def test_a_shard_is_repeated_only_on_purpose_and_mended_by_resuming(shards):
    assert shards(f"{WORDS} --shard 3/3")[0] == 1
    code, _, err = shards(f"{WORDS} --shard 3/3")
    assert (code, "shard-3-of-3.json" in err) == (2, True)
    shutil.copy("scene.ply", "broken.ply")
    assert shards(f"{WORDS} --shard 3/3 --resume")[0] == 0
    assert [shards(f"{WORDS} --shard {n}/3")[0] for n in (1, 2)] == [0, 0]
    assert shards("gather out")[0] == 0


def test_what_does_not_fit_together_is_refused(shards):
    def refusal(folder="out"):
        code, out, err = shards(f"gather {folder}")
        assert (code, out) == (2, "")
        return err.splitlines()[-1]

    assert "out: holds no shard" in refusal()
    shards(f"{WORDS} --shard 1/3")
    assert "shards 2/3, 3/3: missing or not done: two, broken" in refusal()
    assert "holds an evaluation" in shards(f"{WORDS} --shard 1/2")[2]
    shards(f"{WORDS} --shard 1/2 --overwrite")
    assert "shards 1/2 and 1/3: overlap: both hold one" in refusal()
    Path("out/shard-1-of-2.json").unlink()
    shards(f"{WORDS} --shard 2/3 --recipe classic --metric psnr")  # what the file says stays; the request differs
    assert "shards 1/3 and 2/3: have other scenes or options; repeat one of them" in refusal()
    shards(f"{WORDS} --shard 2/3 --overwrite")
    record = Path("out/shard-2-of-3.json")
    whole = json.loads(record.read_text())
    record.write_text(json.dumps(whole | {"aaplug": "0.1"}))
    assert f"have other versions of aaplug ({aaplug_version()} and 0.1)" in refusal()
    for damaged in ("[]", "{}", json.dumps(whole | {"aaplug": 1}), json.dumps(whole | {"names": {}})):
        record.write_text(damaged)
        assert "shard-2-of-3.json: is damaged; repeat that shard with --resume" in refusal()
    record.write_text(json.dumps(whole))
    shards(f"{WORDS} --shard 3/3")
    journal = Path("out/one/progress.jsonl")
    journal.write_bytes(journal.read_bytes()[:-5])
    assert "progress.jsonl: is damaged or of an unfinished evaluation" in refusal()


def aaplug_version() -> str:
    return json.loads(Path("out/shard-1-of-3.json").read_text())["aaplug"]


def test_options_that_change_no_result_may_differ_between_shards(shards):
    shutil.copy("scene.ply", "broken.ply")
    shards(f"{WORDS} --shard 1/2 --threads 1")
    shards(f"{WORDS} --shard 2/2 --memory 1 --json")
    assert shards("gather out")[0] == 0


@pytest.mark.parametrize("text", ["0/8", "9/8", "1", "1/0", "-1/2", "a/b", f"1/{MOST + 1}", "1/2/3", ""])
def test_a_shard_that_is_none_is_refused(text):
    with pytest.raises(UsageError, match="takes 1/8 to 8/8"):
        Shard.read(text)


def test_every_scene_is_in_one_shard():
    parts = [[place for place in range(20) if Shard(n, 8).holds(place)] for n in range(1, 9)]
    assert sorted(place for part in parts for place in part) == list(range(20))
    assert {len(part) for part in parts} == {2, 3}


def test_a_shard_of_one_scene_is_refused(shards):
    code, _, err = shards("evaluate one.ply --cameras . --shard 1/2 -o out")
    assert (code, "--shard: is a part of several scenes" in err) == (2, True)
