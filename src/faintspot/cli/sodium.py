"""faintspot sodium: the profile of a laser guide star's light from recorded frames."""

import shlex
from pathlib import Path

import click
import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.files import derived
from faintspot.base.tables import save_tables
from faintspot.cli.commands import KEY, configuration_option, option
from faintspot.cli.output import picture_file, progress_bar, write_picture
from faintspot.io.frames import open_frames
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.recorded.sodium import MOST_FRAMES, sodium_of_frames

_SAME_PX = 0.05  # nearer centres stay


@click.command()
@click.argument("frames", nargs=-1, required=True, metavar="FRAMES...")
@configuration_option("Configuration with [layout] and [laser].")
@option("--launch-m", type=(float, float), metavar="X Y", help="Launch telescope, for a new [laser].")
@option(
    "--frames",
    "most",
    type=click.IntRange(1),
    default=MOST_FRAMES,
    metavar="N",
    help="Number of frames to read.",
)
@option("--picture", metavar="PNG", help="Picture to write.", show_default="beside the configuration")
@KEY
def command(
    frames: tuple[str, ...],
    config: str,
    launch_m: tuple[float, float] | None,
    most: int,
    picture: str | None,
    key: str | None,
    time_axis: int | None,
) -> None:
    """Learn the sodium profile of a laser guide star, and the width of its spots, from frames.

    All sub-apertures see the same profile, each stretched along its own direction: one profile is fitted to
    the mean image of FRAMES. The spots may move by about their width, as in a closed loop. The layout must
    know pixel_scale_arcsec, and subaperture_m or diameter_m. Writes TOML's name with .sodium.npz, and
    profile and spot_fwhm_arcsec of [laser]. `faintspot slopes` and the engine then know the shape of every
    spot; other keys of [laser] stay. Centres that `faintspot layout` found are put on the lattice of the
    spots' centres of gravity: those of the brightest points have the focus of a profile with several peaks.

    \b
    Examples:
      faintspot layout frames.fits --pixel-scale-arcsec 0.5 --diameter-m 8
      faintspot sodium frames.fits --launch-m -5 0
    """
    described = Configuration(config)
    tables = described.tables
    if launch_m is not None:
        tables["laser"] = {"spot_fwhm_arcsec": 1.0, **tables.get("laser", {}), "launch_m": list(launch_m)}
    laser = described.laser
    if laser is None:
        raise InputError(f"{config}: expected a table [laser], or --launch-m")
    layout, calibration = described.layout, described.calibration
    drawing = picture_file(Path(config), picture, ".sodium.png")
    with open_frames(frames, key=key, time_axis=time_axis) as source, progress_bar("sodium", "steps") as show:
        found = sodium_of_frames(source, layout, calibration, laser, most_frames=most, progress=show)
    known, path = found.sodium, derived(config, ".sodium.npz")
    profile = known.fit.profile
    profile.save(path)
    learnt = {"profile": path.name, "spot_fwhm_arcsec": float(f"{known.spot_fwhm_arcsec:.4g}")}
    save_tables(config, {"laser": {**tables["laser"], **learnt}})
    longest = np.hypot(*known.star.elongation_px(profile).T)
    click.echo(
        f"{path}: mean {profile.mean_m / 1e3:.1f} km, standard deviation {profile.std_m / 1e3:.1f} km; spots "
        f"of a single altitude {known.spot_fwhm_arcsec:.2f} arcsec wide, elongations {longest.min():.1f} to "
        f"{longest.max():.1f} px, mean flux {np.median(known.fit.flux_e):.3g} e-"
    )
    if found.left_out:
        click.echo(f"  {found.left_out}")
    click.echo(f"  {config}: profile and spot_fwhm_arcsec of [laser] written")
    if "centres" in tables["layout"]:
        lattice = found.lattice_of(layout)
        moved = np.abs(lattice.centres - layout.centres).max()
        if moved > _SAME_PX:
            lattice.save(config)
            click.echo(
                f"  centres of [layout] moved by up to {moved:.2f} px, to the spots' centres of gravity"
            )
    if drawing is not None:
        from faintspot.slopes.recorded.pictures import profile_figure

        before = {"before": known.star.focused(laser.profile)}
        write_picture(profile_figure({**before, "now": profile}).figure, drawing)
    click.echo(f"Next: faintspot slopes {shlex.join([*frames, '--config', config])}")
