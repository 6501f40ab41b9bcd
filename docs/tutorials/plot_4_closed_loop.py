"""
A loop in simulation: baseline, window, Kalman filter
=====================================================

The Strehl ratio decides on the sky. A simulated 4.2 m telescope closes its loop on one faint star four times:
the same turbulence and photons, other slopes and other control.
"""

# %%
# Near the diffraction limit, 3 electrons of read noise, 20 photons a sub-aperture and frame: where
# brightest pixels lose the star. Values come from `faintspot loop magnitude`, which tunes each on other
# realisations of the turbulence.

from matplotlib.figure import Figure

import faintspot as fs
from faintspot.loop.simulation import Method, load_loop, simulate_loop

loop = load_loop("diffraction_limit").replace("camera", photons_per_subaperture=20.0)
loop = loop.replace("run", frames=400, settle_frames=80).replace("control", telemetry_frames=1000)
psf = fs.PSF.analytic(size=loop.spot_width_px / 2)
window = fs.Settings("window", window_fwhm_px=1.3 * loop.spot_width_px, flux_e=20.0)
posterior = fs.Settings("map", prior_std_px=0.7, flux_e=20.0)

methods = [
    Method("brightest pixels", fs.Settings("brightest", keep_brightest=20), gain=0.1),
    Method("fixed window", window, gain=0.4),
    Method("maximum a posteriori", posterior, gain=0.4, variants=("predicted",), psf=psf),
    Method(
        "the same, Kalman filter",
        posterior,
        gain=0.3,
        variants=("predicted",),
        psf=psf,
        control="kalman",
    ),
]
records = {method.label: simulate_loop(loop, [method]) for method in methods}

# %%
# One short realisation each: enough to see, not enough to judge by. :doc:`/results/closed_loop` has five
# realisations, with errors.

figure = Figure(figsize=(8, 3.8), layout="constrained")
axes = figure.add_subplot(xlabel="frame", ylabel="H-band Strehl ratio", ylim=(0, 1))
colours = ("#4477aa", "#000000", "#228833", "#aa3377")
for (label, record), colour in zip(records.items(), colours, strict=True):
    axes.plot(record.strehl, color=colour, label=f"{label}: {record.mean_strehl():.2f}")
axes.legend(loc="upper left", ncols=2, frameon=False)
