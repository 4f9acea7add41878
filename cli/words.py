"""From the words of a command line to a verb's options, and back.

The fields of the options' dataclasses are stated in `aaplug.options`: a field's docstring is its help, and its `Group`
the heading under which it stands.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from functools import cached_property
from io import StringIO
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

from aaplug.options.base import PYTHON_ONLY, Argument, Group, Options, argument_of, as_path, docs_of, flag
from aaplug.system.errors import MAX_VALUE_CHARACTERS, AaplugError, UsageError, did_you_mean, within_memory

# a word that names a file, unlike names and numbers such as 1/4
FILE = re.compile(r"(?!\.?\d[\d./,]*$)(.*/.*|.*\.[A-Za-z]\w*)", re.DOTALL)
OPTION = re.compile(r"-(?![\d.]|$)")  # the beginning of a word that is no negative number, nor a lone dash
MAX_METAVAR = 30  # characters; longer lists of names stand in an option's help
SILENT_DEFAULTS = (None, False, True, (), math.inf)  # that help does not show

T = TypeVar("T", bound=Options)


class Option(NamedTuple):
    """One option of a verb.  argument: how its value is read; None for a switch.  default: MISSING if it is needed."""

    name: str
    argument: Argument | None
    help: str
    default: Any = None
    group: Group | None = None

    @property
    def flags(self) -> list[str]:
        """The words that name it, the one for messages first; none for an option without a name."""
        if self.argument is not None and self.argument.by_place:
            return []
        name = ("--no-" if self.default is True else "--") + self.name.replace("_", "-")
        others = self.argument.flags if self.argument else ()
        return sorted([name, *others], key=lambda one: (one[1] != "-", one == name))

    @property
    def shown(self) -> str:
        """The option as messages name it."""
        return self.flags[0] if self.flags else str(self.argument and self.argument.metavar.split()[0].strip("[]"))

    def value(self, words: Sequence[str]) -> Any:
        """The value that words give; raises UsageError."""
        if self.argument is None and not words:
            return not self.default
        takes, got = "no value", " ".join(words)[:MAX_VALUE_CHARACTERS].strip() or "nothing"
        if self.argument is not None:
            with suppress(ValueError):
                value = self.argument.value(words)
                self.argument.check(self.shown, value)
                return value
            takes = self.argument.takes or self.argument.metavar
        raise UsageError(self.shown, f"takes {takes}, got {got}")

    @property
    def spec(self) -> tuple[str, Any, Any]:
        """The option as a field of the parser's dataclass."""
        import tyro

        argument, text, default = self.argument, self.help, field(default=self.default)
        hint = "" if self.default in SILENT_DEFAULTS or "(default" in text else None
        if argument is None:
            about = tyro.conf.arg(help=text, help_behavior_hint=hint)
            return self.name, Annotated[bool, about], default
        metavar = argument.metavar
        if len(metavar) > MAX_METAVAR:
            listed = metavar.replace(" ...", "").replace("|...", " and others").replace("|", ", ")
            metavar, text = self.name.upper().replace("_", "-"), f"{text}  Names: {listed}."

        def words_of(value: Any) -> list[str]:
            values = value if isinstance(value, list | tuple) else [value]
            return [f"{each:g}" if isinstance(each, float) else str(each) for each in values]

        how = argument.count or "*", metavar, self.value, lambda _: True, words_of
        about = tyro.conf.arg(metavar=metavar, aliases=argument.flags, help=text, help_behavior_hint=hint)
        place = (tyro.conf.Positional,) * argument.by_place
        annotation = Annotated[(Any, tyro.constructors.PrimitiveConstructorSpec(*how), about, *place)]
        return self.name, annotation, default


def output(metavar: str, text: str, default: Any = MISSING) -> Option:
    """The option that names what to write."""
    return Option("output", flag(metavar, "-o", read=as_path), text, default)


def scene_paths(name: str, metavar: str, text: str) -> Option:
    """The option without a name that takes one or more scenes."""
    return Option(name, flag(metavar, read=as_path, by_place=True, count=None), text, ())


def json_of(what: str) -> Option:
    """The option that prints a result as JSON."""
    return Option("json", None, f"Print {what} on stdout.", False)


def options_of(options: type[Options]) -> list[Option]:
    """The options that a dataclass states; what the command line does not offer is left out."""
    hints, docs = get_type_hints(options, include_extras=True), docs_of(options)
    stated = []
    for each in fields(options):
        parts = getattr(hints[each.name], "__metadata__", ())
        if PYTHON_ONLY not in parts:
            group = next((part for part in parts if isinstance(part, Group)), None)
            stated.append(Option(each.name, argument_of(hints[each.name]), docs[each.name], each.default, group))
    return stated


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
            for option in [each] if isinstance(each, Option) else options_of(each):
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
            (groups.setdefault(each.group, []) if each.group else specs).append(each.spec)
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
                several = option and option.argument and option.argument.count is None
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
