"""Constants of the automatic settings, fitted to simulated spots as described in docs/automatic.md.

Symbols are those of faintspot.slopes.estimators.automatic.
"""

from collections.abc import Mapping

Constants = Mapping[str, float]


_KEPT = {  # number of kept pixels, after method "none", "tv" or "smoothed"
    "threshold": (3.85, 0.116, 0.547),  # c, in standard deviations of a dark pixel
    # Exponent with which c falls with the photon noise of the core
    "threshold_photons": (0.231, 0.691, 0.781),
    # Exponent of ln(1 + N / A) with which c rises: larger windows have higher noise peaks
    "threshold_window": (1.28, 0.964, 1.31),
    "tail": (0.737, 0.281, 0.0882),  # weight of the background's noise in C, per electron
    # Pixels per area and ln(1 + C / c); 1/2 is the level set of a Gaussian
    "gaussian": (0.581, 0.226, 0.345),
    "gaussian_px": (1.08, 1.37, 0.439),  # added to the area, for the width of the pixels
    "core": (0.432, 0.182, 0.271),  # as `gaussian`, for the core of a sinc^2
    "core_px": (2.47, 0.831, 0.162),
    "lobe": (0.851, 1.09, 1.24),  # limit for the core of a sinc^2: lobe * A + lobe_px
    "lobe_px": (2.22, 3.53, 1.64),
    "wings": (0.038, 0.0088, 0.0339),  # as `core`, for the side lobes, from C / c = wings_from
    "wings_px": (10.6, 0.118, 2.98),
    "wings_from": (6.5, 213.0, 52.5),
    "edge": (4.83, 19.3, 9.77),  # limit of k where the kept region reaches the edge of the window
    "edge_exponent": (0.664, 1.38, 1.11),
    "lost": (2.33, 2.03, 1.57),  # C below which the spot is lost in noise, and its dependence on A, r and N
    "lost_area": (0.267, 0.442, 0.461),
    "lost_range": (0.486, 0.155, 0.483),
    "lost_window": (0.197, 0.0443, 0.204),
    "shrink": (6.49, 4.14, 3.81),  # b, its exponent, and the dependence of k on A for a lost spot
    "shrink_exponent": (1.57, 1.33, 1.08),
    "shrink_area": (0.0, 0.115, 0.023),
    "off_lost": (0.0, 0.38, 0.106),  # D^2 r^2 / N below which a lost spot is not denoised
    "off": (0.0, 0.902, 0.575),  # (range / error of a single spot)^2 below which an image is not denoised
    "off_photons": (0.0, 0.46, 0.385),  # q below which an image is not denoised
}
KEPT: dict[str, Constants] = {
    method: {name: values[column] for name, values in _KEPT.items()}
    for column, method in enumerate(("none", "tv", "smoothed"))
}
STRENGTH: Constants = {  # of the denoising
    "diffraction": 1.1,  # a
    "gaussian": 1.09,
    "decline": 0.0635,  # d
    "tail": 0.177,  # weight of the background's noise, per electron
    "core_freedom": 1.71,  # degrees of freedom left by denoising, per A
    # The same due to noise taken for flux, for faint spots: up to D = noise_freedom_at
    "noise_freedom": 159.0,
    "noise_freedom_at": 5.03,
    "noise_freedom_exponent": 6.92,
    "wings": 0.438,  # part of the flux's noise that is removed for a sinc^2; zero for a Gaussian
    "wings_window": 4.99,  # decrease with A / N: in a small window most flux is in the core
    "lost": 0.606,  # in units of sqrt(v), if the spot is lost
}
SMOOTHING: Constants = {  # of the Gaussian smoothing
    "diffraction": 0.323,  # width at A = 9 of a bright spot, px
    "gaussian": 0.374,
    "area_exponent": 0.133,
    "faint": 1.16,
    "faint_exponent": 0.47,
    "tail": 1.1,  # of the background's noise, per electron
    "photons_diffraction": 0.059,  # exponents of 1 + photon noise of the core / v
    "photons_gaussian": 0.0005,
    "lost": 0.567,  # width at A = 9 where the spot is lost, px
}
FEW: Constants = {  # of spots of few photons, without denoising
    "photons": 1.05,  # the spot's photon noise in D^2
    "diffraction": 59.4,  # pixels per area
    "gaussian": 24.0,
    "rarity": 0.51,  # q up to which photons are few
    "variance": 0.0059,  # v up to which each stands out
    "range_exponent": 4.0,
}
