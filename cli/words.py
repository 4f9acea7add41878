"""From the words of a command line to a verb's options, and back.

The fields of the options' dataclasses are stated in `aaplug.options`: a field's docstring is its help, and its `Group`
the heading under which it stands.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass, replace
from functools import cached_property
from io import StringIO
from typing import Annotated, Any, NamedTuple, TypeVar

from aaplug.options.base import PYTHON_ONLY, SWITCH, Group, Option, Options, as_path, docs_of, flag, options_of
from aaplug.system.errors import AaplugError, UsageError, did_you_mean, within_memory

# a word that names a file, unlike names and numbers such as 1/4
FILE = re.compile(r"(?!\.?\d[\d./,]*$)(.*/.*|.*\.[A-Za-z]\w*)", re.DOTALL)
OPTION = re.compile(r"-(?![\d.]|$)")  # the beginning of a word that is no negative number, nor a lone dash
MAX_METAVAR = 30  # characters; longer lists of names stand in an option's help
SILENT_DEFAULTS = (None, False, True, (), math.inf)  # that help does not show

T = TypeVar("T", bound=Options)


def _spec(option: Option) -> tuple[str, Any, Any]:
    """An option as a field of the parser's dataclass."""
    import tyro

    text, default = option.help, field(default=option.default)
    hint = "" if option.default in SILENT_DEFAULTS or "(default" in text else None
    if option.count == 0:
        about = tyro.conf.arg(help=text, help_behavior_hint=hint)
        return option.name, Annotated[bool, about], default
    metavar = option.metavar
    if len(metavar) > MAX_METAVAR:
        listed = metavar.replace(" ...", "").replace("|...", " and others").replace("|", ", ")
        metavar, text = option.name.upper().replace("_", "-"), f"{text}  Names: {listed}."

    def words_of(value: Any) -> list[str]:
        values = value if isinstance(value, list | tuple) else [value]
        return [f"{each:g}" if isinstance(each, float) else str(each) for each in values]

    how = option.count or "*", metavar, option.value, lambda _: True, words_of
    about = tyro.conf.arg(metavar=metavar, aliases=option.also, help=text, help_behavior_hint=hint)
    place = (tyro.conf.Positional,) * option.by_place
    return option.name, Annotated[(Any, tyro.constructors.PrimitiveConstructorSpec(*how), about, *place)], default


def output(metavar: str, text: str, default: Any = MISSING) -> Option:
    """The option that names what to write."""
    return flag(metavar, "-o", read=as_path).named("output", text, default=default)


def scene_paths(name: str, metavar: str, text: str) -> Option:
    """The option without a name that takes one or more scenes."""
    return flag(metavar, read=as_path, by_place=True, count=None).named(name, text, default=())


def json_of(what: str) -> Option:
    """The option that prints a result as JSON."""
    return SWITCH.named("json", f"Print {what} on stdout.")


class Words:
    """The options that a command line, or a batch file, gives to a verb; each is an attribute."""

    def __init__(self, command: "Command", values: Mapping[str, Any]):
        self.command, self.values = command, dict(values)

    def __reduce__(self) -> tuple[Any, tuple[Any, dict[str, Any]]]:
        return _words_of, (self.command.run, self.values)  # a worker of a cluster has a table of its own

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "values":
            raise AttributeError(name)
        return self.values[name]

    def keywords(self, options: type[Options]) -> dict[str, Any]:
        """The options of one dataclass, as keywords of the library."""
        return {each.name: self.values[each.name] for each in fields(options) if each.name in self.values}

    def of(self, options: type[T]) -> T:
        """The options of one dataclass; raises UsageError if one does not fit."""
        return options(**self.keywords(options))

    def checked(self) -> "Words":
        """These words, if each option and what is between them fits; raises UsageError."""
        for options in self.command.classes:
            self.of(options)
        return self

    def where(self, **values: Any) -> "Words":
        """The same with other values."""
        return Words(self.command, self.values | values)

    def given(self, options: type[Options]) -> list[str]:
        """The command line's words that give the options of one dataclass which are not as usual."""
        words: list[str] = []
        for option in options_of(options):
            value = self.values.get(option.name)
            if value in (None, False) or value == option.default:
                continue
            values = value if isinstance(value, list | tuple) else [] if value is True else [value]
            words = [*words, *option.flags[:1], *map(str, values)] if option.flags else [*map(str, values), *words]
        return words


class Answer(NamedTuple):
    """The result of a verb: facts for --json, tables and texts for people, and whether some of the work failed."""

    facts: Any
    shown: Sequence[Any] = ()
    failed: bool = False


@dataclass(frozen=True)
class Command:
    """A verb of the command line: its help, its options and what runs it.

    stated: single options, and dataclasses of them; of two with one name the first counts.
    """

    name: str
    help: str
    stated: Sequence[type[Options] | Option]
    run: Callable[[Words], Answer]

    @cached_property
    def options(self) -> dict[str, Option]:
        """All options by name; they are read from the dataclasses when the verb is used."""
        options: dict[str, Option] = {}
        for each in self.stated:
            stated = [each] if isinstance(each, Option) else options_of(each)
            for option in stated:
                if option.group != PYTHON_ONLY:
                    option = option if isinstance(each, Option) else replace(option, help=docs_of(each)[option.name])
                    options.setdefault(option.name, option)
        return options

    @property
    def classes(self) -> list[type[Options]]:
        """The dataclasses that state most of the options."""
        return [each for each in self.stated if not isinstance(each, Option)]

    @cached_property
    def parser(self) -> type[Any]:
        """A dataclass of the options: first those without a heading, then one nested dataclass for each heading."""
        import tyro

        specs, groups = list[Any](), dict[Group, list[Any]]()
        for each in sorted(self.options.values(), key=lambda each: each.default is not MISSING):
            (groups.setdefault(each.group, []) if each.group else specs).append(_spec(each))
        for group, members in groups.items():
            nested = make_dataclass(group.title, members)
            nested.__doc__ = group.about
            name = group.title.replace(" ", "_") + "_options"
            specs.append((name, Annotated[nested, tyro.conf.arg(name=group.title)], field(default_factory=nested)))
        parser = make_dataclass(self.name, specs)
        parser.__doc__ = self.help
        return parser

    def parse(self, words: Sequence[str]) -> Words:
        """Read words, or print --help and exit; raises UsageError if they do not fit.

        An option of several values takes them apart or between commas, and ends before a word that names a file.
        """
        import tyro

        flags = {flag: option for option in self.options.values() for flag in option.flags}
        files, others, option = list[str](), list[str](), None
        for word in words:
            name = word.partition("=")[0].replace("_", "-")
            if OPTION.match(word):
                if name not in (*flags, "-h", "--help"):
                    raise self.refusal(f"Unrecognized options: {name}{did_you_mean(name, flags)}")
                option = flags.get(name)
                others.append(word)
            else:
                several = option and option.count is None
                (files if several and FILE.fullmatch(word) else others).append(word)
        box, conf = StringIO(), tyro.conf
        config = conf.OmitArgPrefixes, conf.FlagCreatePairsOff, conf.HelptextFromCommentsOff
        how = {"prog": f"aaplug {self.name}", "args": [*files, *others], "config": config}
        try:
            with redirect_stderr(box):
                parsed, rest = tyro.cli(self.parser, **how, return_unknown_args=True)
        except SystemExit as end:
            if not end.code:  # --help
                raise
            text = box.getvalue().partition("\n")[2]  # without the title; the box is drawn in ASCII on some terminals
            text = re.sub(r"(?m)^(\W {5}-.*?\S) *\W?$", r"\1:", text)  # an option, before its help
            text = " ".join(re.findall(r"[^\s│╭╮╰╯─|+]+", re.sub("-{3,}", "", text)))
            text = re.split(r" \(required\)| For full helptext| Argument helptext", text)[0]
            raise self.refusal(text.replace(f" from aaplug {self.name}", "").rstrip(". ")) from end
        if rest:
            raise self.refusal(f"Unrecognized words: {' '.join(rest)}")
        values = dict[str, Any]()
        for name, value in vars(parsed).items():
            values |= vars(value) if is_dataclass(value) else {name: value}
        return Words(self, values)

    @contextmanager
    def errors(self, what: str) -> Iterator[None]:
        """Name options in the errors of the block, one of which is that there is no memory for `what`."""
        try:
            with within_memory(what):
                yield
        except AaplugError as error:
            where = self.worded(f"`{error.where}`").strip("`") if isinstance(error, UsageError) else error.where
            raise type(error)(where, self.worded(error.problem)) from error

    def worded(self, text: str) -> str:
        """The library's text with parameters as options: min_seen or `min_seen` becomes --min-seen."""
        shown = {option.name: option.shown for option in self.options.values()}
        names = r"`(\w+)`|\b([a-z]+(?:_[a-z]+)+)\b"
        return re.sub(names, lambda match: shown.get(match[1] or match[2], match[0]), text)

    def refusal(self, problem: str) -> UsageError:
        """The error of words that are no command line of this verb."""
        return UsageError(f"aaplug {self.name}", f"{problem}; see `aaplug {self.name} --help`")


VERBS: dict[str, Command] = {}  # by name; `verbs` fills it


def _words_of(run: Callable[[Words], Answer], values: Mapping[str, Any]) -> Words:
    """The words of the verb that `run` carries out, whose module fills the table."""
    return Words(next(command for command in VERBS.values() if command.run is run), values)
