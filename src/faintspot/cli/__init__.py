"""The command line: thin modules, of one command or a few that belong together."""

import logging
import os
import platform
import sys
import warnings
from importlib import import_module
from pathlib import Path

import click

from faintspot.base import __version__
from faintspot.base.errors import InputError, MissingExtraError

_COMMANDS = {
    "demo": "Simulate a faint star, measure it with and without denoising, and write a report.",
    "estimators": "List the estimators, or the options of one.",
    "export": "Write telemetry as FITS (AOT), or a C library that measures slopes.",
    "layout": "Find the sub-apertures in a frame and write a configuration.",
    "live": "Show a running engine as a web page.",
    "loop": "Compare methods in a simulated closed loop, and recommend one.",
    "realtime": "Measure frames as they arrive and publish slopes and commands.",
    "report": "Write a web page of pictures and tables from slopes, studies or telemetry.",
    "slopes": "Measure slopes from recorded frames.",
    "sodium": "Learn the sodium profile of a laser guide star from frames.",
    "study": "Measure the slope error by Monte-Carlo simulation.",
    "telemetry": "Report noise, turbulence, vibrations and control of a recorded or running loop.",
    "tune": "Recommend an estimator and settings for a camera and a star.",
    "wavefront": "Fit Zernike modes to slopes, and draw the wavefront.",
}

_HOMES = {"estimators": "tune:list_estimators", "live": "realtime.run:live", "loop": "study:loop_group"}
"""Module and function of commands whose module is not named after them."""
_OF_POSIX = ("fcntl", "resource")


def home_of(name: str) -> str:
    """Return module and function of a command, with a colon between them."""
    return f"{__name__}.{_HOMES.get(name, f'{name}:command')}"


class _Interrupted(Exception):
    """Ctrl-C, under a name that click does not print anything for."""


class _LazyGroup(click.Group):
    """Imports a command's module only when it is used, so that --help answers at once."""

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """Import one command."""
        if name not in self.commands:
            return None
        module, _, function = home_of(name).partition(":")
        command: click.Command = getattr(import_module(module), function)
        command.name = name  # most functions are called "command"
        return command

    def invoke(self, context: click.Context) -> object:
        """Run a command."""
        try:
            return super().invoke(context)
        except ModuleNotFoundError as error:
            if error.name not in _OF_POSIX:
                raise
            raise InputError(f"faintspot {context.invoked_subcommand} needs Linux") from None
        except KeyboardInterrupt:
            raise _Interrupted from None

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, listed.short_help or "") for name, listed in self.commands.items()])


def _print_versions(context: click.Context, _: click.Parameter, asked: bool) -> None:
    """Print versions, and the processor that kernels are compiled for."""
    if not asked or context.resilient_parsing:
        return
    from importlib.metadata import version

    from faintspot.slopes.kernels.compiling import compile_target
    from faintspot.slopes.kernels.host import lanes_for

    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "llvmlite"))
    click.echo(f"faintspot, version {__version__}, in {Path(__file__).parents[1]}")
    click.echo(f"Python {platform.python_version()} ({platform.platform()}), {packages}")
    target = compile_target()
    click.echo(f"kernels for {target.cpu} ({target.triple}), {lanes_for('float32').width} lanes of float32")
    context.exit()


@click.group(
    cls=_LazyGroup,
    commands={name: click.Command(name, short_help=text) for name, text in _COMMANDS.items()},
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_versions,
    help="Show versions and the processor, and exit.",
)
@click.pass_context
def group(context: click.Context) -> None:
    """Measure wavefront slopes from faint Shack-Hartmann spots.

    Estimators from brightest pixels to maximum likelihood, the choice between them for a camera and a star,
    closed-loop simulation, and an engine that turns pixels into slopes and commands in real time.

    \b
    With recorded frames:
      faintspot layout frames.fits -o faintspot.toml
      faintspot slopes frames.fits --config faintspot.toml -o slopes.zarr
      faintspot report slopes.zarr

    \b
    Without frames:
      faintspot tune --read-noise-e 3 --pixels 16 --fwhm-px 1.8 --flux-e 100
      faintspot loop magnitude diffraction_limit --quick
      faintspot demo
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help())


class _Terminal(logging.Handler):
    """Says on standard error, also while a progress bar is there, what takes time."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write one line."""
        click.echo(f"faintspot: {record.getMessage()}", err=True)


def main(arguments: list[str] | None = None) -> object:
    """Run the command line; an error of the user's ends with one line and exit code 2."""
    # Before NumPy is loaded: small matrices gain nothing from BLAS threads, which get in the way of our own.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    warnings.formatwarning = lambda message, *_: f"faintspot: warning: {' '.join(str(message).split())}\n"
    if sys.stderr.isatty():
        compiling = logging.getLogger("faintspot.slopes.kernels.compiling")
        compiling.addHandler(_Terminal())
        compiling.setLevel(logging.INFO)
    try:
        return group.main(args=arguments, prog_name="faintspot", standalone_mode=False)
    except click.ClickException as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "faintspot"
        message = " ".join(error.format_message().split())
        click.echo(f"faintspot: error: {message} (see {command} --help)", err=True)
        sys.exit(error.exit_code)
    except (InputError, MissingExtraError) as error:
        click.echo(f"faintspot: error: {' '.join(str(error).split())}", err=True)
        sys.exit(2)
    except (click.Abort, _Interrupted):
        click.echo(
            "faintspot: interrupted; the same command continues slopes, studies and loops where they stopped",
            err=True,
        )
        sys.exit(130)
    except MemoryError:
        click.echo("faintspot: error: not enough memory; try fewer frames at a time (--block)", err=True)
        sys.exit(2)
