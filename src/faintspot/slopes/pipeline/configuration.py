"""One TOML file (faintspot.toml) for layout, calibration, estimator, settings, PSF and weights.

Calibration maps, PSF and weights are stored beside it, in NAME.calibration.npz etc., and named in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import derived
from faintspot.base.tables import Tables, save_tables, tables_as_text
from faintspot.base.text_files import check_keys
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.binning import binned_layout
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

if TYPE_CHECKING:
    from faintspot.slopes.spots.laser_spots import LaserSpots

_FILTER = "laser.matched_filter"
_ANALYTIC_KEYS = ("profile", "size", "elongation", "angle_deg", "radius_px")

Item = Layout | Calibration | Settings | PSF | FixedWeights


class Configuration(Tables):
    """Contents of a configuration file, read once; each part is made when it is first asked for.

    Parameters
    ----------
    path, tables
        As for `Tables`.
    **parts
        Parts that replace those of the tables, by their names.

    Raises
    ------
    InputError
        As for `Tables`; parts also if their table is missing, or has an unknown key or an invalid value.
    """

    def __init__(self, path: str | Path, tables: Mapping[str, object] | None = None, **parts: object) -> None:
        super().__init__(path, tables)
        vars(self).update(parts)

    @cached_property
    def layout(self) -> Layout:
        """Sub-apertures on the detector."""
        return self.part(Layout)

    @cached_property
    def settings(self) -> Settings:
        """Estimator and its options."""
        return Settings.from_tables(self)

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration; the default without a table."""
        return Calibration.from_table(self.tables.get(Calibration.table, {}), self.path)

    @cached_property
    def laser(self) -> LaserSpots | None:
        """Laser guide star, or None."""
        if "laser" not in self:
            return None
        from faintspot.slopes.spots.laser_spots import LaserSpots  # few telescopes have one

        return self.part(LaserSpots)

    @cached_property
    def psf(self) -> PSF | None:
        """PSF that is described or named, else those of the laser guide star's sub-apertures, or None."""
        values = self.tables.get("psf")
        if values is None:
            return self._laser_psf()
        with errors_within(self.path, "psf."):
            if "profile" in values:
                check_keys("", values, _ANALYTIC_KEYS, what="key beside profile")
                return PSF.analytic(**values)
            return PSF.load(self._named_file(values, ("file", "profile")))

    @cached_property
    def weights(self) -> FixedWeights | None:
        """Score that is named, else the linear matched filter of a laser guide star, if wanted, or None."""
        values = self.tables.get("weights")
        if values is None:
            return self._laser_score()
        with errors_within(self.path, "weights."):
            return FixedWeights.load(self._named_file(values, ("file",)))

    @property
    def spot(self) -> dict[str, Any]:
        """PSF and weights, as a pipeline takes them."""
        return {"psf": self.psf, "weights": self.weights}

    def _laser_psf(self) -> PSF | None:
        """Return the PSF of each sub-aperture that sees the laser guide star, or None."""
        if self.laser is None or ("layout" not in vars(self) and Layout.table not in self):
            return None
        layout = binned_layout(self.layout)
        with errors_within(self.path):
            return self.laser.psf(self.laser.star_of(layout), layout.window)

    def _laser_score(self) -> FixedWeights | None:
        """Return the linear matched filter of the laser guide star, if the configuration wants it."""
        if self.laser is None or not self.laser.matched_filter or self.psf is None:
            return None
        from faintspot.slopes.spots.laser_spots import matched_filter

        layout, settings = self.layout, self.settings
        with errors_within(self.path):
            if layout.bin > 1:
                raise InputError(f"expected layout.bin = 1, got {layout.bin}", name=_FILTER)
            if settings.flux_e is None:
                raise InputError("expected flux_e in [settings], got none", name=_FILTER)
            flux = settings.values("flux_e", len(layout), layout.pixels)
            return matched_filter(self.psf, layout, self.calibration, flux)

    def _named_file(self, values: Mapping[str, object], known: tuple[str, ...]) -> Path:
        """Return the file that a table names, relative to the configuration file."""
        check_keys("", values, known)
        name = values.get("file")
        if not isinstance(name, str):
            raise InputError(f"expected the name of a file, found {name!r}", name="file")
        return self.path.parent / name


def has(path: str | Path, table: str) -> bool:
    """Return whether a configuration file has a table; for "settings", an [estimator] table is sufficient.

    Raises
    ------
    InputError
        If the file exists and cannot be read, or is not TOML.
    """
    if not Path(path).exists():
        return False
    tables = Tables(path)
    return table in tables or (table == "settings" and "estimator" in tables)


def save(path: str | Path, item: Item) -> None:
    """Write an object into its table of a configuration file; preserve other tables and comments.

    Raises
    ------
    InputError
        If the file exists and is not TOML, or cannot be written.
    """
    if not isinstance(item, PSF | FixedWeights):
        item.save(path)
        return
    table = "psf" if isinstance(item, PSF) else "weights"
    store = derived(path, f".{table}.npz")
    item.save(store)
    save_tables(path, {table: {"file": store.name}})


def to_text(*items: Layout | Calibration | Settings) -> str:
    """Return the configuration as TOML text; calibration maps are represented by their shapes."""
    tables: dict[str, object] = {}
    for item in items:
        if isinstance(item, Settings):
            tables |= {name: values for name, values in item.to_tables().items() if values}
        else:
            tables["layout" if isinstance(item, Layout) else "calibration"] = item.to_table()
    return tables_as_text(tables)
