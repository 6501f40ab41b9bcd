"""One TOML file (faintspot.toml) for layout, calibration, estimator, settings, PSF and score.

Calibration maps, PSF and score are stored beside it, in NAME.calibration.npz etc., and named in it.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from faintspot.base.config.tables import errors_of_table, read_tables, save_tables, tables_as_text
from faintspot.base.errors import InputError
from faintspot.base.files import derived
from faintspot.base.toml_files import check_keys
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.binning import binned_layout
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.laser_spots import laser_of, matched_filter
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.score import Score, load_score

_PACKED, _MOST_PACKED_BYTES = "faintspot.toml", 1 << 20
_ANALYTIC_KEYS = ("profile", "size", "elongation", "angle_deg", "radius_px")

Item = Layout | Calibration | Settings | PSF | Score


class Parts(NamedTuple):
    """Parts of a pipeline except the layout."""

    settings: Settings
    calibration: Calibration
    psf: PSF | None
    score: Score | None

    @classmethod
    def from_tables(cls, path: Path, document: Mapping[str, dict[str, Any]]) -> Parts:
        """Read the parts from the tables of a configuration file; PSF and score may be absent."""
        settings = Settings.from_tables(path, document)
        calibration, psf = Calibration.from_tables(path, document), psf_of(path, document)
        return cls(settings, calibration, psf, score_of(path, document, psf))


class Configuration(NamedTuple):
    """Contents of a configuration file."""

    layout: Layout
    settings: Settings
    calibration: Calibration
    psf: PSF | None
    score: Score | None


def load(path: str | Path, table: str) -> Any:
    """Read one part of a configuration file.

    Parameters
    ----------
    path : path
    table : {"layout", "calibration", "settings"}

    Returns
    -------
    Layout, Calibration or Settings
        A file without a calibration table gives `Calibration()`.

    Raises
    ------
    InputError
        If the file cannot be read, is not TOML, lacks the table, or has an unknown key or an invalid value.
    """
    kinds: dict[str, Any] = {"layout": Layout, "calibration": Calibration, "settings": Settings}
    return kinds[table].load(path)


def load_all(path: str | Path) -> Configuration:
    """Read all parts of a configuration file; PSF and score may be absent."""
    path = Path(path)
    document = read_tables(path)
    return Configuration(Layout.from_tables(path, document), *Parts.from_tables(path, document))


def has(path: str | Path, table: str) -> bool:
    """Return whether a configuration file has a table; for "settings", an [estimator] table is sufficient.

    Raises
    ------
    InputError
        If the file exists and cannot be read, or is not TOML.
    """
    if not Path(path).exists():
        return False
    document = read_tables(path)
    return table in document or (table == "settings" and "estimator" in document)


def save(path: str | Path, item: Item) -> None:
    """Write an object into its table of a configuration file; preserve other tables and comments.

    Raises
    ------
    InputError
        If the file exists and is not TOML, or cannot be written.
    """
    if not isinstance(item, PSF | Score):
        item.save(path)
        return
    table = "psf" if isinstance(item, PSF) else "score"
    store = derived(path, f".{table}.npz")
    item.save(store)
    save_tables(path, {table: {"file": store.name}})


def packed(calibration: Calibration, psf: PSF | None, score: Score | None) -> dict[str, str] | None:
    """Return the files that `save` writes, as base64 text by name; None if they exceed 1 MiB in total."""
    with TemporaryDirectory() as folder:
        for item in (calibration, psf, score):
            if item is not None:
                save(Path(folder) / _PACKED, item)
        files = list(Path(folder).iterdir())
        if sum(file.stat().st_size for file in files) > _MOST_PACKED_BYTES:
            return None
        return {file.name: base64.b64encode(file.read_bytes()).decode() for file in files}


def unpacked(files: Mapping[str, str]) -> tuple[Calibration, PSF | None, Score | None]:
    """Return the inputs of `packed` from its result.

    Raises
    ------
    InputError
        If the files are invalid.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / _PACKED
        try:
            for name, text in files.items():
                (Path(folder) / Path(name).name).write_bytes(base64.b64decode(text, validate=True))
        except (OSError, ValueError, TypeError, AttributeError):
            raise InputError("configuration: expected files in base64") from None
        document = read_tables(path)
        calibration, psf = Calibration.from_tables(path, document), psf_of(path, document)
        return calibration, psf, score_of(path, document, psf)


def to_text(*items: Layout | Calibration | Settings) -> str:
    """Return the configuration as TOML text; calibration maps are represented by their shapes."""
    tables: dict[str, Any] = {}
    for item in items:
        if isinstance(item, Settings):
            tables |= {name: values for name, values in item.to_tables().items() if values}
        else:
            tables["layout" if isinstance(item, Layout) else "calibration"] = item.to_table()
    return tables_as_text(tables)


def psf_of(path: Path, document: Mapping[str, dict[str, Any]]) -> PSF | None:
    """Return the PSF that a configuration file describes or names, or None.

    Without a table [psf] it is that of the laser guide star, one for each sub-aperture.
    """
    if "psf" not in document:
        return _laser_psf(path, document)
    values = document["psf"]
    with errors_of_table(path, "psf"):
        if "profile" in values:
            check_keys("psf.", values, _ANALYTIC_KEYS, what="key beside profile")
            return PSF.analytic(**values)
        return PSF.load(_named_file(path, "psf", values, ("file", "profile")))


def _laser_psf(path: Path, document: Mapping[str, dict[str, Any]]) -> PSF | None:
    """Return the PSF of each sub-aperture that sees the laser guide star of a configuration, or None."""
    laser = laser_of(path, document)
    if laser is None or "layout" not in document:
        return None
    layout = binned_layout(Layout.from_tables(path, document))
    with errors_of_table(path, "laser"):
        return laser.psf(laser.star_of(layout), layout.window)


def _laser_score(path: Path, document: Mapping[str, dict[str, Any]], psf: PSF | None) -> Score | None:
    """Return the linear matched filter of a laser guide star, if the configuration wants it."""
    laser = laser_of(path, document)
    if laser is None or not laser.matched_filter:
        return None
    psf = psf_of(path, document) if psf is None else psf
    if psf is None:
        return None
    layout, settings = Layout.from_tables(path, document), Settings.from_tables(path, document)
    if layout.bin > 1:
        raise InputError(f"{path}: laser.matched_filter: expected layout.bin = 1, got {layout.bin}")
    if settings.flux_e is None:
        raise InputError(f"{path}: laser.matched_filter: expected flux_e in [settings], got none")
    flux = settings.values("flux_e", len(layout), layout.pixels)
    with errors_of_table(path, "laser"):
        return matched_filter(psf, layout, Calibration.from_tables(path, document), flux)


def score_of(path: Path, document: Mapping[str, dict[str, Any]], psf: PSF | None = None) -> Score | None:
    """Return the score that a configuration file names, or None.

    Without a table [score] it is the linear matched filter of a laser guide star, if [laser] wants it, for
    the PSF of `psf_of`, which is made here if it is not given.
    """
    if "score" not in document:
        return _laser_score(path, document, psf)
    with errors_of_table(path, "score"):
        return load_score(_named_file(path, "score", document["score"], ("file",)))


def _named_file(path: Path, table: str, values: Mapping[str, Any], known: tuple[str, ...]) -> Path:
    """Return the file that a table names, relative to the configuration file."""
    check_keys(f"{table}.", values, known)
    name = values.get("file")
    if not isinstance(name, str):
        raise InputError(f"{table}.file: expected the name of a file, found {name!r}")
    return path.parent / name
