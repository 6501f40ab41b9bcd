"""Options, commands and groups whose help is alike everywhere: units, defaults, sections, near misses."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import click

_GENERAL = "Options"
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class _Option(click.Option):
    """An option that belongs to a section of its command's help."""

    def __init__(self, *arguments: Any, section: str = _GENERAL, **attributes: Any) -> None:
        super().__init__(*arguments, **attributes)
        self.section = section

    def get_help_extra(self, context: click.Context) -> Any:
        """Return default and range, in words."""
        extra = super().get_help_extra(context)
        if isinstance(self.show_default, str):
            extra["default"] = self.show_default
        if "range" in extra:
            extra["range"] = _range_in_words(self.type)
        return extra


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


class Group(click.Group):
    """A group that suggests the nearest command for an unknown one, and may list its commands by section."""

    sections: ClassVar[Mapping[str, Sequence[str]]] = {}
    """Names of commands by heading; those that are not named come first."""

    def resolve_command(
        self, context: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a command."""
        name = args[0] if args else ""
        if name and not name.startswith("-") and self.get_command(context, name) is None:
            near = difflib.get_close_matches(name, self.list_commands(context), n=1)
            also = (
                f"did you mean {near[0]!r}?" if near else f"expected {', '.join(self.list_commands(context))}"
            )
            raise click.UsageError(f"no command {name!r}: {also}", context)
        return super().resolve_command(context, args)

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands."""
        named = {name for names in self.sections.values() for name in names}
        rest = [name for name in self.list_commands(context) if name not in named]
        for heading, names in {"Commands": rest, **self.sections}.items():
            rows = [(name, self.summary(context, name)) for name in names]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)

    def summary(self, context: click.Context, name: str) -> str:
        """Return the line that describes a command."""
        found = self.get_command(context, name)
        return "" if found is None else found.get_short_help_str(limit=100)


def _range_in_words(kind: Any) -> str:
    if None not in (kind.min, kind.max) and not (kind.min_open or kind.max_open):
        return f"{kind.min:g} to {kind.max:g}"
    least = None if kind.min is None else f"{'above' if kind.min_open else 'at least'} {kind.min:g}"
    most = None if kind.max is None else f"{'below' if kind.max_open else 'at most'} {kind.max:g}"
    return ", ".join(part for part in (least, most) if part)


def option(*names: str, **attributes: Any) -> Decorator:
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
