"""From a verb's options to the words of a command line, and back.

The fields of the options' dataclasses are stated in `aaplug.options`.  Here they become one parser a verb: a field's
docstring is its help, and its `Group` the heading under which it stands.
"""

import dataclasses
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import MISSING, dataclass, field, fields, make_dataclass
from functools import cached_property
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import tyro

from aaplug.options.base import Group, Options, docs_of, flag
from aaplug.system.errors import UsageError

CONFIG = (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff)  # how classes become options
FILE = re.compile(r".*/.*|.*\.[A-Za-z]\w*", re.DOTALL)  # a word that names a file, unlike names and numbers
OPTION = re.compile(r"-(?![\d.])")  # the beginning of a word that is no negative number
SIZE = re.compile(r"-?\d+x-?\d+")  # a value of --resolution, which the parser may take for an option

T = TypeVar("T", bound=Options)


class Option(NamedTuple):
    """One option of a verb; its annotation holds how it is read."""

    name: str
    annotation: Any
    help: str
    default: Any = MISSING

    @property
    def group(self) -> Group | None:
        """The heading that it stands under; None for the first."""
        return next((part for part in getattr(self.annotation, "__metadata__", ()) if isinstance(part, Group)), None)

    @property
    def spec(self) -> tuple[str, Any, Any]:
        """The option as a field of the parser's dataclass."""
        base, *metadata = get_args(self.annotation) if get_origin(self.annotation) is Annotated else [self.annotation]
        told = [part for part in metadata if not isinstance(part, Group)]
        configs = [part for part in told if dataclasses.is_dataclass(part) and hasattr(part, "help")]
        told = [part for part in told if part not in configs]
        config: Any = configs[0] if configs else tyro.conf.arg()
        annotation = Annotated[(base, *told, dataclasses.replace(config, help=self.help))]  # pyright: ignore
        return self.name, annotation, field(default=self.default) if self.default is not MISSING else field()


def output(metavar: str, text: str, default: Any = MISSING) -> Option:
    """The option that names what to write."""
    kind = Path if default is MISSING or default is not None else Path | None
    return Option("output", Annotated[kind, flag(metavar, "-o")], text, default)


def json_of(what: str) -> Option:
    """The option that prints a result as JSON."""
    return Option("json", bool, f"Print {what} on stdout.", False)


def options_of(options: type[Options]) -> list[Option]:
    """The options that a dataclass states; what the command line does not offer is left out."""
    hints, docs = get_type_hints(options, include_extras=True), docs_of(options)
    return [
        Option(each.name, hints[each.name], docs[each.name], _default(each))
        for each in fields(options)
        if tyro.conf.Suppress not in get_args(hints[each.name]) and each.name != "monitor"
    ]


class Words:
    """The options that a command line, or a batch file, gives to a verb; each is an attribute."""

    def __init__(self, command: "Command", values: Mapping[str, Any]):
        self.command, self.values = command, dict(values)

    def __reduce__(self) -> tuple[Any, tuple[str, dict[str, Any]]]:
        return _words_of, (self.command.name, self.values)  # a worker of a cluster has a table of its own

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
        defaults = {option.name: option.default for option in options_of(options)}
        for name, value in self.keywords(options).items():
            if value in (None, False) or value == defaults.get(name):
                continue
            values = value if isinstance(value, list | tuple) else [] if value is True else [value]
            if name == "scene":  # the positional one comes first
                words = [*map(str, values), *words]
            else:
                words += [_flag_of(name), *map(str, values)]
        return words


@dataclass(frozen=True)
class Command:
    """A verb of the command line: its help, its options and what runs it.

    stated: single options, and dataclasses of them; of two with one name the first counts.
    """

    name: str
    help: str
    stated: Sequence[type[Options] | Option]
    run: Callable[[Words], int]

    @cached_property
    def options(self) -> list[Option]:
        """All options; they are read from the dataclasses when the verb is used."""
        options: dict[str, Option] = {}
        for each in self.stated:
            for option in [each] if isinstance(each, Option) else options_of(each):
                options.setdefault(option.name, option)
        return list(options.values())

    @property
    def classes(self) -> list[type[Options]]:
        """The dataclasses that state most of the options."""
        return [each for each in self.stated if not isinstance(each, Option)]

    @cached_property
    def types(self) -> dict[str, Any]:
        """Types of the options, by name."""
        return {option.name: option.annotation for option in self.options}

    @cached_property
    def parser(self) -> type[Any]:
        """A dataclass of the options: first those without a heading, then one nested dataclass for each heading."""
        groups: dict[Group, list[Option]] = {}
        first = []
        for option in self.options:
            (first if option.group is None else groups.setdefault(option.group, [])).append(option)
        specs = [option.spec for option in sorted(first, key=lambda option: option.default is not MISSING)]
        for group, members in groups.items():
            nested = make_dataclass(group.title.title(), [member.spec for member in members], frozen=True)
            nested.__doc__ = group.about
            name = group.title.replace(" ", "_") + "_options"
            specs.append((name, Annotated[nested, tyro.conf.arg(name=group.title)], field(default_factory=nested)))
        parser = make_dataclass(self.name.title(), specs, frozen=True)
        parser.__doc__ = self.help
        return parser

    def parse(self, words: Sequence[str], default: Words | None = None) -> Words:
        """Read words; raises UsageError if they do not fit.  default: has what they do not say."""
        how = {} if default is None else {"default": self.filled(default.values)}
        program = f"aaplug {self.name}"
        with one_line(program):
            parsed = tyro.cli(self.parser, prog=program, args=self.parted(words), config=CONFIG, **how)
        values: dict[str, Any] = {}
        for name, value in vars(parsed).items():
            values |= vars(value) if dataclasses.is_dataclass(value) else {name: value}
        return Words(self, values)

    def filled(self, values: Mapping[str, Any]) -> Any:
        """The parser's dataclass with these values."""

        def fill(kind: Any) -> Any:
            names = {each.name: each.default_factory for each in fields(kind)}  # of groups, their dataclasses
            return kind(**{n: values[n] if n in values else fill(group) for n, group in names.items()})

        return fill(self.parser)

    def parted(self, words: Sequence[str]) -> list[str]:
        """The words as the parser wants them.

        `--scale 1,0.25` becomes `--scale 1 0.25`; `--views`, whose names hold commas, stays.  A file after such values
        goes to the front, where the parser does not take it for one of them.  `--resolution -1x720` becomes one word,
        because the parser would take the value for an option.
        """
        several = {_flag_of(name) for name, kind in self.types.items() if _takes_several(kind)}
        option, parted, files = "", list[str](), list[str]()
        for word in words:
            if parted and parted[-1] == "--resolution" and SIZE.fullmatch(word):
                parted[-1] += "=" + word
                continue
            name, _, value = word.partition("=")
            option = name if OPTION.match(word) else option
            if option not in several:
                parted.append(word)
            elif name != option and FILE.fullmatch(word):
                files.append(word)
            elif name == option:
                parted += [option, *filter(None, value.split(","))]
            else:
                parted += filter(None, word.split(","))
        return [*files, *parted]


VERBS: dict[str, Command] = {}  # by name; `verbs` fills it


@contextmanager
def one_line(program: str) -> Iterator[None]:
    """Turn tyro's box about words that it cannot read into an error of one line.

    Raises:
        UsageError: the words inside the block do not fit the program.
    """
    box = StringIO()
    try:
        with redirect_stderr(box):
            yield
    except SystemExit as end:
        if not end.code:  # --help
            raise
        lines = [line.strip("│╭╮╰╯─|+ ") for line in box.getvalue().splitlines()]  # drawn in ASCII on some terminals
        text = " ".join(filter(re.compile(r"\w").search, lines[1:]))  # without the box's title and rules
        text = re.split(" For full helptext| Argument helptext", text)[0].removeprefix("Error parsing ")
        raise UsageError(program, f"{text.rstrip('. ')}; see `{program} --help`") from end


def worded(text: str, names: Collection[str]) -> str:
    """The library's text with parameters as options: min_seen or `min_seen` becomes --min-seen."""

    def option(match: re.Match[str]) -> str:
        name = match[1] or match[2]
        if name not in names:
            return match[0]
        return "SCENE" if name == "scene" else "--for" if name == "viewer" else _flag_of(name)

    return re.sub(r"`(\w+)`|\b([a-z]+(?:_[a-z]+)+)\b", option, text)


def setting_words(name: str, value: Any) -> list[str]:
    """A setting of a batch file as words of the command line."""
    if name == "scene":
        return [str(value)]
    return [_flag_of(name), *map(str, value if isinstance(value, list) else [value])]


def _flag_of(name: str) -> str:
    return "--" + name.replace("_", "-")


def _takes_several(annotation: Any) -> bool:
    base = get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
    return Sequence in [get_origin(kind) for kind in (base, *get_args(base))]


def _default(each: dataclasses.Field[Any]) -> Any:
    return each.default_factory() if each.default_factory is not MISSING else each.default


def _words_of(verb: str, values: Mapping[str, Any]) -> Words:
    """The words of a verb in the table, with these values."""
    import_module(".verbs", __package__)  # fills the table, in a process that unpickles words before all else
    return Words(VERBS[verb], values)
