"""What a strength that is too strong for the image costs: slope errors with TV denoising over those without.

Spots of 20 to 200 e-, 1 and 3 e- read noise, windows of 8 and 16 px, the usual number of kept pixels.
Strengths are the suggested one, the automatic one and twice the suggested one. R = mean of (|dx| + |dy|) / 2
over all sub-apertures, one without light counting as at the centre; differences are paired, so that their
errors are smaller than those of R. docs/results/tv_settings.md has the table.
"""

import numpy as np

import faintspot as fs
from faintspot.slopes.estimators.automatic import automatic_strength
from faintspot.slopes.estimators.noise import suggested_strength

SPOTS, SEED = 4000, 2
FLUXES_E, READ_NOISES_E, SIDES = (20.0, 50.0, 100.0, 200.0), (1.0, 3.0), (8, 16)
OPTICAL_FWHM_PX = 1.77


def errors(images: np.ndarray, truth: np.ndarray, settings: fs.Settings) -> tuple[np.ndarray, fs.Slopes]:
    """Return (|dx| + |dy|) / 2 of every image, px, and the slopes."""
    n, side, _ = images.shape
    layout = fs.Layout.stacked(n, (side, side), np.zeros((n, 2)))
    slopes = fs.SlopePipeline(layout, settings)(images.reshape(n * side, side))
    return (abs(slopes.x - truth[:, 0]) + abs(slopes.y - truth[:, 1])) / 2, slopes


def main() -> None:
    """Print the table."""
    print(
        "| window | read noise | flux | R without | strength | lowered | lost | R with TV | with - without |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for number, (side, noise, flux) in enumerate(
        (side, noise, flux) for side in SIDES for noise in READ_NOISES_E for flux in FLUXES_E
    ):
        images, truth = fs.slopes.simulate.subapertures(
            SPOTS,
            shape=(side, side),
            flux_e=flux,
            detector=fs.slopes.simulate.Detector(read_noise_e=noise),
            rng=np.random.default_rng((SEED, number)),
        )
        without, plain = errors(images, truth, fs.Settings("brightest"))
        usual = float(suggested_strength(noise, flux, side**2))
        rule = float(automatic_strength(flux, noise, pixels=side**2, spot_fwhm_px=OPTICAL_FWHM_PX))
        for name, strength in (("1", usual), ("auto", rule), ("2", 2 * usual)):
            found, slopes = errors(images, truth, fs.Settings("tv", noise_std=strength))
            lowered = np.mean((slopes.flags & fs.SubapertureFlag.INFEASIBLE_STRENGTH) > 0)
            lost = np.count_nonzero(plain.valid & ~slopes.valid)
            change = found - without
            case = f"| {side} px | {noise:g} e- | {flux:g} e- | {without.mean():.3f} | {name} "
            print(
                f"{case}| {100 * lowered:.1f} % | {lost} | {found.mean():.3f} "
                f"| {change.mean():+.4f} ± {change.std() / SPOTS**0.5:.4f} |"
            )


if __name__ == "__main__":
    main()
