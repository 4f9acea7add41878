"""Command lines that people copy: the shells of a system read the words that were meant.

POSIX's are run.  Those of Windows are modelled by what Microsoft documents: about_Quoting_Rules, about_Parsing, and
CommandLineToArgvW, by whose rules a program on Windows takes its line apart.
"""

import json
import re
import shutil
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aaplug.system.shells import command_line

PRINTING = ("-c", "import json, sys; print(json.dumps(sys.argv[1:]))")
NAMES = [
    "plain.ply", "a b/c.ply", "it's.ply", "Anna’s.ply", "a,b", "@x", "~", "=ls", "!!", "a&b|c", "(1)", "%x",
    "#204060", "{a,b}", "*?[ab]", "a;b", "a^b", "größe", "--min-seen", "-r", "-1.5", "1e-3", "<a>", "\\d", "a\\b c\\",
]  # fmt: skip
EXPANDED = ["$HOME", "a$b c", "`id`", "it’s $5", "“q”.ply"]  # by PowerShell, whose quotes cmd does not know
POSIX = [*NAMES, *EXPANDED, '"', "\\", "a\nb", "", "'"]
WINDOWS = [*NAMES, "C:\\", "C:\\my data\\a.ply", "C:\\my data\\", "\\\\server\\share\\"]  # no file's name has a "
SHELLS = [shell for shell in ("sh", "bash", "dash", "zsh", "fish") if shutil.which(shell)]
SINGLE, DOUBLE = "'‘’‚‛", '"“”„'


def argv(line: str) -> list[str]:
    """The words of a line by CommandLineToArgvW: 2 n backslashes before a quote are n, one more keeps the quote."""
    words, word, quoted = list[str](), None, False
    for slashes, sign in re.findall(r"(\\*)([^\\]|$)", line):
        if sign == '"':
            word = (word or "") + slashes[::2][: len(slashes) // 2] + '"' * (len(slashes) % 2)
            quoted ^= len(slashes) % 2 == 0
        elif sign in ("", " ") and not quoted:
            word = slashes if word is None and slashes else word if word is None else word + slashes
            words += [] if word is None else [word]
            word = None
        else:
            word = (word or "") + slashes + sign
    assert not quoted, line
    return words


def cmd(line: str) -> list[str]:
    """What a program gets from cmd, which hands on the line, quotes and all."""
    outside = "".join(re.split(r'"[^"]*"', line))
    assert not set(outside) & set("&|<>^()%!\n"), line
    return argv(line)


def powershell(line: str, escapes: bool) -> list[str]:
    """What a program gets from PowerShell; escapes: whether it doubles backslashes before a quote, as from 7.3 on."""
    words, rest = list[str](), line
    while rest := rest.lstrip(" "):
        if rest[0] in SINGLE:
            body = re.match(f"[{SINGLE}]((?:[^{SINGLE}]|[{SINGLE}]{{2}})*)[{SINGLE}](?= |$)", rest)
            assert body, rest
            words.append(re.sub(f"([{SINGLE}])[{SINGLE}]", r"\1", body[1]))
        elif rest[0] in DOUBLE:
            body = re.match(f"[{DOUBLE}]([^{DOUBLE}$`]*)[{DOUBLE}](?= |$)", rest)
            assert body, rest
            words.append(body[1])
        else:
            body = re.match(rf"[^\s@#{SINGLE}{DOUBLE}$`&|;,(){{}}<>][^\s{SINGLE}{DOUBLE}$`&|;,(){{}}<>]*(?= |$)", rest)
            assert body, rest
            assert not re.match(r"-\w*\.|--%", body[0]), "taken apart at the point, or the end of parsing"
            words.append(body[0])
        rest = rest[len(body[0]) :]
    last = r"\g<0>\g<0>" if escapes else r"\g<0>"
    handed_on = ['"' + re.sub(r"\\+$", last, word) + '"' if " " in word or not word else word for word in words]
    return argv(" ".join(handed_on))


@pytest.mark.parametrize("shell", SHELLS)
def test_posix_shells_read_the_words_that_were_meant(shell):
    line = command_line([sys.executable, *PRINTING, *POSIX], windows=False)
    done = subprocess.run([shell, "-c", line], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == POSIX


def by_path(words: list[str]) -> list[str]:
    """Words without the backslashes at their end, which do not tell one folder from another."""
    return [word.rstrip("\\") for word in words]


@given(st.lists(st.text("abz09 .:/\\-_+=,;'’%!@#~^&()[]{}ü", min_size=1), max_size=4) | st.just(WINDOWS))
def test_cmd_and_powershell_read_the_words_that_were_meant(words):
    line = command_line(["aaplug", *words], windows=True)
    assert cmd(line) == ["aaplug", *words]
    for escapes in (False, True):
        assert by_path(powershell(line, escapes)) == ["aaplug", *by_path(words)]


@given(st.lists(st.text("ab $`“”„'’. ü", min_size=1), max_size=4) | st.just(EXPANDED))
def test_powershell_keeps_what_it_expands_elsewhere(words):
    for escapes in (False, True):
        assert powershell(command_line(["aaplug", *words], windows=True), escapes) == ["aaplug", *words]
