"""Commands and options that look alike everywhere, and what commands need before work begins."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from typing import Any

import click

from faintspot.base.checks import not_none
from faintspot.base.errors import InputError, MissingExtraError, present, require, require_linux
from faintspot.base.options import FLAG, REQUIRED, TEXT, TEXTS, Options
from faintspot.base.tables import parse_ranges

_GENERAL = "Options"
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class _Option(click.Option):
    """An option that belongs to a section of its command's help."""

    def __init__(self, *arguments: Any, section: str = _GENERAL, **attributes: Any) -> None:
        super().__init__(*arguments, **attributes)
        self.section = section

    def get_help_extra(self, context: click.Context) -> Any:
        """Return default and range; a default in words has no brackets of its own."""
        extra = super().get_help_extra(context)
        if isinstance(self.show_default, str):
            extra["default"] = self.show_default
        return extra


class Listed(click.ParamType[Any]):
    """A list with commas.

    Parameters
    ----------
    kind : type
        str or float.
    counts : tuple of int
        Allowed numbers of items; none: any.
    expected : str
        What messages expect.
    """

    name = "list"

    def __init__(self, kind: type = str, counts: tuple[int, ...] = (), expected: str = "") -> None:
        self.kind, self.counts, self.expected = kind, counts, expected or "numbers with commas"

    def convert(self, value: Any, parameter: Any, context: click.Context | None) -> object:
        """Return the items of a text as a tuple."""
        if not isinstance(value, str):
            return value
        try:
            items = tuple(self.kind(part.strip()) for part in value.split(",") if part.strip())
        except ValueError:
            items = ()
        wrong = self.kind is float and not (items and all(map(math.isfinite, items)))
        if wrong or (self.counts and len(items) not in self.counts):
            raise InputError(f"{parameter.opts[0]} {value}: expected {self.expected}")
        return items


class _Ranges(click.ParamType[Any]):
    """Numbers and ranges of numbers, such as 4,5,10-20."""

    name = "ranges"

    def convert(self, value: Any, parameter: Any, context: click.Context | None) -> Any:
        """Return the numbers."""
        return parse_ranges(value, parameter.opts[0]) if isinstance(value, str) else value


NAMES, NUMBERS, RANGES = Listed(), Listed(float), _Ranges()


class SectionedCommand(click.Command):
    """A command whose options are listed by section, in the order of their first appearance."""

    def format_options(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(context):
            record = parameter.get_help_record(context)
            if record is not None and isinstance(parameter, click.Option):
                sections.setdefault(getattr(parameter, "section", _GENERAL), []).append(record)
        sections[_GENERAL] = sections.pop(_GENERAL)  # last; --help is always there
        for heading, records in sections.items():
            with formatter.section(heading):
                formatter.write_dl(records)


def option(*names: str, **attributes: object) -> Decorator:
    """Return `click.option` with the default shown and a metavar in place of the name of a Python type.

    Parameters
    ----------
    *names : str
    **attributes
        As for `click.option`; `section`: heading in the help of a `SectionedCommand`; `show_default`: a
        default that is computed, in words.
    """
    attributes.setdefault("show_default", True)
    kind = attributes.get("type")
    if kind in (int, float) or isinstance(kind, click.IntRange | click.FloatRange):
        attributes.setdefault("metavar", "N" if kind is int or isinstance(kind, click.IntRange) else "X")
    return click.option(*names, cls=_Option, **attributes)


def flag_of(name: str) -> str:
    """Return the option that gives a value of this name."""
    return f"--{name.replace('_', '-')}"


@contextmanager
def errors_of_options(where: object) -> Iterator[None]:
    """Add the file or part to the errors raised within; name values that options give by their options."""
    try:
        yield
    except InputError as error:
        given = error.name in click.get_current_context().params
        name = flag_of(error.name) if given else error.name
        raise InputError(error.expected, name=name, value=error.value, where=error.where).within(
            where
        ) from None


def declared(
    kind: type[Options],
    *names: str,
    sections: Mapping[str, str] | str = _GENERAL,
    show_default: str | None = None,
) -> Decorator:
    """Return the options that a class declares, all or those named; what is not given is None.

    Parameters
    ----------
    kind : type
    *names : str
    sections : str or mapping
        Heading in the help of a `SectionedCommand`, or headings by the group of an option.
    show_default : str, optional
        Default in words, if it is not that of the class.
    """

    def add(command: Callable[..., object]) -> Callable[..., Any]:
        defaults = kind.defaults()
        for name, what in reversed(kind.declared().items()):
            if name not in (names or (name,)) or not what.meaning:
                continue
            attributes: dict[str, object] = {"help": what.meaning, "type": int if what.whole else float}
            if what.kind == TEXTS:
                attributes |= {"type": NAMES, "metavar": ",".join(what.choices)}
            elif what.choices:
                attributes["type"] = click.Choice(what.choices)
            elif what.kind == TEXT:
                attributes["type"] = str
            elif what.kind == FLAG:
                attributes |= {"type": bool, "is_flag": True, "default": None}
            if what.unit:
                attributes["metavar"] = what.unit.upper().replace("E-", "E")
            if show_default or defaults[name] not in (None, REQUIRED, False, ()):
                attributes["show_default"] = show_default or f"{defaults[name]}".removesuffix(".0")
            section = sections if isinstance(sections, str) else sections[what.group]
            command = option(flag_of(name), name, section=section, **attributes)(command)
        return command

    return add


def configuration_option(what: str) -> Decorator:
    """Return --config: a configuration, and what it is to the command."""
    return option("-c", "--config", default="faintspot.toml", metavar="TOML", help=what)


def name_option(what: str) -> Decorator:
    """Return --name: what has it."""
    return option("--name", default="faintspot", help=what)


ENGINE_NAME = name_option("Name of the engine.")


def which_frames(**options: object) -> Decorator:
    """Return --key and --time-axis: which array of a file holds frames, and how."""
    key = option("--key", metavar="NAME", help="Which array to read of files that hold several.", **options)
    time_axis = option(
        "--time-axis",
        type=click.IntRange(0, 2),
        metavar="AXIS",
        help="Axis of a cube that counts the frames.",
        show_default="0, or the odd one of three of which two are equal",
        **options,
    )
    return lambda command: key(time_axis(command))


KEY = which_frames()
FRAMES = option(
    "--frames", type=click.IntRange(1), help="Stop after this number of frames.", show_default="at Ctrl-C"
)
READOUT_FRACTION = option(
    "--readout-fraction",
    type=float,
    metavar="PART",
    default=0.8,
    help="Read-out, as a part of the frame time.",
)
PORT = option(
    "--port", type=click.IntRange(0, 65535), default=8642, help="Port of the page; 0: any that is free."
)
REFERENCE = option(
    "--reference",
    metavar="FILE",
    help="Reference positions: slopes of a flat wavefront (their mean), or (n, 2) px as FILE[:ARRAY].",
)


def needs(extra: str, *packages: str) -> Callable[[click.Command], click.Command]:
    """Declare which packages a command cannot do without, and the extra that installs them.

    The command then ends before any work, in one line, where one is missing; --help names the extra.
    """

    def declared(command: click.Command) -> click.Command:
        _check_first(command, lambda path: require(extra, *packages, purpose=path))
        command.epilog = f"Needs the extra `{extra}`: pip install 'faintspot[{extra}]'"
        return command

    return declared


def needs_linux(command: click.Command) -> click.Command:
    """Declare that a command does its work in real time: on Linux only."""
    _check_first(command, require_linux)
    return command


def _check_first(command: click.Command, check: Callable[[str], None]) -> None:
    """Run a check, given the command's path, before a command's work."""
    work = not_none(command.callback)

    @wraps(work)
    def checked(*arguments: object, **options: object) -> Any:
        check(click.get_current_context().command_path)
        return work(*arguments, **options)

    command.callback = checked


def can_make(what: str, *packages: str, asked: bool = False) -> bool:
    """Tell whether a command can make a part of its report; if not, say so now, and that it is left out.

    Parameters
    ----------
    what : str
        The part, such as "picture".
    packages : str
        Packages of the extra "report" that it needs.
    asked : bool
        Whether the user asked for it: then its absence is an error.
    """
    try:
        require("report", *packages, purpose=f"A {what}")
    except MissingExtraError as error:
        if asked:
            raise
        click.echo(f"without {what}: {error}", err=True)
        return False
    return True


def suggested_slopes() -> str:
    """Return the name to suggest for a file of slopes: one that can be written here."""
    return "slopes.zarr" if present("zarr") else "slopes.npz"
