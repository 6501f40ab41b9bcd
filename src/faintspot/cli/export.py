"""faintspot export: telemetry and slope pipelines for other software."""

from pathlib import Path

import click

from faintspot.base.errors import InputError
from faintspot.base.files import derived
from faintspot.cli.commands import REFERENCE, needs, needs_linux, option


@click.group("export")
def command() -> None:
    """Write telemetry as FITS (AOT), or a C library that measures slopes without Python.

    \b
    Examples:
      faintspot export telemetry night.zarr -o night.fits
      faintspot export library faintspot.toml -o library
    """


@needs("realtime", "zarr", "aotpy")
@click.command("telemetry")
@click.argument("telemetry", type=click.Path(path_type=Path))
@option("--output", "-o", metavar="FITS", help="File to write.", show_default="TELEMETRY.fits")
@option(
    "--ao-mode",
    type=click.Choice(["SCAO", "SLAO", "GLAO", "MOAO", "LTAO", "MCAO"]),
    default="SCAO",
    help="What an AOT file says the sensor serves.",
)
def _telemetry(telemetry: Path, output: str | None, ao_mode: str) -> None:
    """Write telemetry as a file of the Adaptive Optics Telemetry standard (AOT).

    TELEMETRY is what `faintspot realtime record` wrote.

    \b
    Example:
      faintspot export telemetry night.zarr -o night.fits
    """
    from faintspot.io import read_telemetry, write_aot

    out = Path(output or derived(telemetry, ".fits"))
    if out.suffix != ".fits":
        raise InputError(f"{out}: expected a name that ends in .fits")
    recorded = read_telemetry(telemetry)
    write_aot(out, recorded, ao_mode=ao_mode)
    click.echo(f"{out}: {len(recorded.frame)} frames, {len(recorded.image_frame)} images")


@needs_linux
@click.command("library")
@click.argument("config", default="faintspot.toml", metavar="[TOML]")
@option("--output", "-o", metavar="FOLDER", default="library", help="Folder to write.")
@option(
    "--cpu",
    "cpus",
    multiple=True,
    metavar="NAME",
    help="Processor to compile for: x86-64, x86-64-v3 (AVX2), x86-64-v4 (AVX-512) or aarch64.",
    show_default="all of x86-64, chosen when the library starts",
)
@REFERENCE
@option("--no-build", is_flag=True, help="Write the sources, but do not build the library.")
def _library(config: str, output: str, cpus: tuple[str, ...], reference: str | None, no_build: bool) -> None:
    """Write a C library that measures slopes without Python, and a bundle of tables for this sensor.

    TOML is a configuration (default: faintspot.toml). FOLDER gets faintspot.h, faintspot.c, object files and
    NAME.bundle, named after the configuration. A C compiler builds libfaintspot.so from them. Several
    configurations may share a folder and its library.

    \b
    Examples:
      faintspot export library faintspot.toml -o library
      faintspot export library --cpu x86-64-v3
    """
    from faintspot.adapters.library.folder import export_library
    from faintspot.cli.output import progress_bar
    from faintspot.io.slopes import read_reference
    from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

    positions = None if reference is None else read_reference(reference)
    pipeline = SlopePipeline.from_file(config, reference=positions)
    with progress_bar("compile", "kernels") as progress:
        result = export_library(
            pipeline,
            output,
            Path(config).stem,
            cpus=cpus,
            compiler=None if no_build else "cc",
            progress=progress,
        )
    click.echo(f"{result.bundle}: {result.bundle.stat().st_size / 1e3:.0f} kB")
    if result.library is None:
        click.echo(f"build the library: {result.build_line}")
    else:
        click.echo(f"{result.library}: built")


command.add_command(_telemetry)
command.add_command(_library)
