"""Public functions and safety rules with any values: a result, or an InputError in one line."""

import ipaddress
import socket
import warnings
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import hypothesis
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from tests.engine.control.test_control_loop import any_control
from tests.refusals import refused_in_one_line
from tests.slopes.estimators.test_python import BRIGHT, FAULTS, FRAME, pipeline, raising

import faintspot as fs
from faintspot.engine.page.client_requests import Access
from faintspot.io.telemetry import LARGEST_GAP, left_out
from faintspot.slopes.estimators import estimators
from faintspot.slopes.pipeline.settings import option_names

_EXAMPLES = 100

NUMBERS = st.one_of(
    st.integers(-3, 40),
    st.floats(-3, 40),
    st.floats(),
    st.sampled_from([1e300, -1e300, 2**31, 2**63, 10**40, 1e-300, True, None, "auto", "x", "", b"1", 1j]),
)
_KINDS: Any = st.sampled_from([np.dtype(kind) for kind in ("f4", "f8", "i8", "u2", "?", "c8", "U3")])
ARRAYS: Any = arrays_of.arrays(
    _KINDS, arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=12)
)
PAIRS = st.lists(st.lists(st.one_of(st.integers(-2, 30), NUMBERS), min_size=1, max_size=3), max_size=9)
ANYTHING = st.one_of(
    NUMBERS, ARRAYS, PAIRS, st.lists(NUMBERS, max_size=9), st.dictionaries(st.text(max_size=3), NUMBERS)
)
SOUND = fs.Layout.grid((3, 3), pixels=8)


def some_of(**fields: Any) -> Any:
    """Keyword arguments, some of which are left out."""
    return st.fixed_dictionaries({}, optional=fields)


def any_settings(name: Any, options: dict[str, Any]) -> None:
    made = refused_in_one_line(lambda: fs.Settings(name, **options))
    if made is not None:
        refused_in_one_line(lambda: fs.SlopePipeline(SOUND, made, fs.Calibration(read_noise_e=1.0), psf=_PSF))
        refused_in_one_line(lambda: made.replace(where=[0, 3], search_range_px=2.0))


def any_layout(frame_shape: Any, window: Any, corners: Any, others: dict[str, Any]) -> None:
    refused_in_one_line(lambda: fs.Layout(frame_shape, window, corners, **others))
    refused_in_one_line(lambda: fs.Layout((40, 40), (8, 8), corners))
    refused_in_one_line(lambda: fs.Layout((40, 40), (8, 8), np.array([[0, 0], [8, 9]]), **others))
    refused_in_one_line(lambda: SOUND[corners])


def any_grid(shape: Any, others: dict[str, Any]) -> None:
    refused_in_one_line(lambda: fs.Layout.grid(shape, **{"pixels": 8, **others}))
    refused_in_one_line(lambda: fs.Layout.grid((3, 3), **{"pixels": 8, **others}))


def any_calibration(fields: dict[str, Any]) -> None:
    made = refused_in_one_line(lambda: fs.Calibration(**fields))
    if made is not None:
        refused_in_one_line(lambda: made.maps((8, 12)))
        refused_in_one_line(lambda: fs.SlopePipeline(SOUND, fs.Settings("ml"), made, psf=_PSF))


def any_psf(samples: Any, oversampling: Any, index: Any, positions: Any, shape: Any) -> None:
    made = refused_in_one_line(lambda: fs.PSF(samples, oversampling, index))
    for psf in (made, _PSF):
        if psf is not None:
            refused_in_one_line(partial(psf.images, positions, shape))
            refused_in_one_line(partial(psf.blurred, oversampling))
    if made is not None:
        refused_in_one_line(
            lambda: fs.SlopePipeline(
                SOUND, fs.Settings("map", flux_e=99.0), fs.Calibration(read_noise_e=1.0), psf=made
            )
        )


def any_frame(frame: Any, prior: Any, reference: Any) -> None:
    refused_in_one_line(lambda: _PIPELINE(frame))
    refused_in_one_line(lambda: _PIPELINE(np.zeros((24, 24), np.float32), prior))
    refused_in_one_line(lambda: fs.SlopePipeline(SOUND, fs.Settings("centroid"), reference=reference))
    refused_in_one_line(lambda: fs.tv_denoise(frame, prior))
    refused_in_one_line(lambda: fs.centre_of_gravity(frame))


def any_plug_in(fault: BaseException, result: Any) -> None:
    """What code of others raises or returns is refused; in the frame path it flags the frame."""
    for action in (raising(fault), lambda images, sensor: result):
        refused_in_one_line(lambda: pipeline(action, always=True))  # noqa: B023  (called at once)
        slopes = pipeline(action)(FRAME * BRIGHT)
        assert np.isfinite(slopes.vector).all()


def any_headers(host: str, origin: str) -> None:
    """Only this machine's names, and the page's own origin, are let in."""
    access = Access("127.0.0.1")
    if access.permits_host(host):
        name = urlsplit(f"http://{host}").hostname or ""
        if name not in ("localhost", socket.gethostname().lower()):
            ipaddress.ip_address(name)
        if access.permits_origin({"Host": host, "Origin": origin}):
            assert urlsplit(origin).netloc == host


def any_frame_numbers(before: int, after: int) -> None:
    """A jump is a plausible number of lost frames, or a restart."""
    lost = left_out(before, after)
    assert lost == -1 or (0 <= lost <= LARGEST_GAP and after == before + 1 + lost)


HOSTS = st.builds(
    str.__add__,
    st.sampled_from(["127.0.0.1", "127.0.0.1:8642", "[::1]", "localhost", "localhost:8642", ""]),
    st.sampled_from(["", "evil.com", ".evil.com", "@evil.com", "/x", ":99999"]) | st.text(max_size=5),
)
FRAME_NUMBERS = st.integers(0, 2**63 - 1) | st.integers(0, 9) | st.integers(LARGEST_GAP - 5, LARGEST_GAP + 5)
_PSF = fs.PSF.analytic("gaussian", radius_px=5)
_PIPELINE = fs.SlopePipeline(SOUND, fs.Settings("brightest", keep_brightest=5))
CALIBRATION = [each.name for each in fields(fs.Calibration) if each.name != "estimated"]
CHECKS: tuple[tuple[Callable[..., None], tuple[Any, ...]], ...] = (
    (
        any_settings,
        (
            st.sampled_from([*estimators(), "x", None]),
            st.dictionaries(st.sampled_from(option_names()[1:]), ANYTHING, max_size=4),
        ),
    ),
    (
        any_layout,
        (
            ANYTHING,
            ANYTHING,
            ANYTHING,
            some_of(
                centres=ANYTHING, cells=ANYTHING, pitch_px=ANYTHING, angle_deg=ANYTHING, geometry=ANYTHING
            ),
        ),
    ),
    (
        any_grid,
        (
            ANYTHING,
            some_of(
                pixels=ANYTHING,
                outer_radius=ANYTHING,
                inner_radius=ANYTHING,
                pitch=ANYTHING,
                origin=ANYTHING,
                frame_shape=ANYTHING,
            ),
        ),
    ),
    (any_calibration, (some_of(**dict.fromkeys(CALIBRATION, ANYTHING)),)),
    (any_psf, (ANYTHING, ANYTHING, ANYTHING, ANYTHING, ANYTHING)),
    (any_frame, (ANYTHING, ANYTHING, ANYTHING)),
    (any_control, (st.data(),)),
    (any_plug_in, (st.sampled_from(FAULTS), ANYTHING)),
    (any_headers, (HOSTS, st.builds("http://{}".format, HOSTS))),
    (any_frame_numbers, (FRAME_NUMBERS, FRAME_NUMBERS)),
)


def run(seed: int) -> None:
    """Try a hundred values of one function."""
    check, values = CHECKS[seed % len(CHECKS)]
    quietly = settings(
        deadline=None,
        max_examples=_EXAMPLES,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", module="hypothesis")
        hypothesis.seed(seed)(quietly(given(*values)(check)))()  # type: ignore[no-untyped-call]
