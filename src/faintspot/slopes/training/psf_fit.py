"""The PSF that fits stacked spots best: a product of two profiles, and where the data ask for it more."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.slopes.training.registration import FINE, Sums, offsets

NODES_PER_PX = 2
_MOST_NODES = 41  # along one axis, for what is not a product
_SWEEPS = 8
_SIGNIFICANTLY_LONG = 1.1
_MOMENT_STEPS = 12
_LEAST_VARIANCE_PX2 = 0.05
_TINY = 1e-12
_HARMLESS = 0.3  # of chi-square, for each spot
_DEVIATION_FLOOR = 0.02  # of the peak: deviations from the product that wings may have


class Form(NamedTuple):
    """Regularisation of a PSF fit."""

    rotated: bool
    """Whether the product's axes are the spot's own; else the pixels'."""
    square: bool
    """Whether both profiles are the same."""
    bend: float
    """Standard deviation of the profiles' second differences about a Gaussian's, of the peak."""
    deviation: float
    """Standard deviation of what is not a product, relative to the product; 0: nothing."""


FIRST_FORM = Form(rotated=True, square=False, bend=0.03, deviation=0.0)
_PRODUCTS = tuple(
    Form(rotated, square, bend, 0.0)
    for rotated, square in ((False, True), (False, False), (True, False))
    for bend in (0.3, 0.1, 0.03, 0.01)
)
_DEVIATIONS = (0.05, 0.15, 0.5, 2.0)


class PSFFit(NamedTuple):
    """A PSF on the fine grid, and the background left in the images, electrons per pixel."""

    plane: Floats
    background_e: float


def spline_basis(at: Floats, radius_px: float, nodes_per_px: float) -> Floats:
    """Cubic B-splines at nodes within the radius, (n, n_nodes): they fall to zero a little inside it."""
    reach = round(radius_px * nodes_per_px) - 2
    element = scipy.interpolate.BSpline.basis_element(np.arange(-2, 3), extrapolate=False)
    u = at[:, None] * nodes_per_px - np.arange(-reach, reach + 1)
    basis: Floats = np.nan_to_num(element(u))
    return basis


def fit_psf(sums: Sums, form: Form, radius_px: float) -> PSFFit:
    """Return the PSF of a given form that fits best, point-symmetric."""
    symmetric = sums.folded(sums.planes[:, ::-1, ::-1])
    moments = core_moments(symmetric)
    (short, long), axes = np.linalg.eigh(moments)
    angle = 0.0
    if form.rotated and long > _SIGNIFICANTLY_LONG**2 * short:
        angle = float(np.arctan2(axes[1, 1], axes[0, 1]))
        moments = np.diag([long, short])
    fit = _product(symmetric, form, radius_px, angle, np.sqrt(np.diagonal(moments)))
    return _with_deviation(symmetric, fit, form.deviation, radius_px) if form.deviation > 0 else fit


def held_out_loss(sums: Sums, fit: PSFFit) -> float:
    """Return the weighted square of what a fit to other spots leaves, but for a constant."""
    b, (square, cross, product) = fit.background_e, sums.planes
    flux = square * fit.plane**2 - 2 * fit.plane * (product - b * cross)
    return float(flux.sum() + b * b * sums.weight - 2 * b * sums.image)


def choose_form(halves: Sequence[tuple[Sums, Sums]], n_spots: float, radius_px: float) -> Form:
    """Return the form whose fit to one half of the spots predicts the other half best.

    A product is preferred, because measuring with it is faster, unless the flux that it leaves out stands
    out of a single spot's noise: being point-symmetric it moves no position by itself, and on real spots the
    slope error was the same with and without it even where it stood out more than that.
    """

    def loss(form: Form) -> float:
        return sum(
            held_out_loss(b, fit_psf(a, form, radius_px)) + held_out_loss(a, fit_psf(b, form, radius_px))
            for a, b in halves
        )

    losses = {form: loss(form) for form in _PRODUCTS}
    product = min(losses, key=losses.__getitem__)
    freer = {product._replace(deviation=d): loss(product._replace(deviation=d)) for d in _DEVIATIONS}
    best = min(freer, key=freer.__getitem__)
    return best if losses[product] - freer[best] > _HARMLESS * n_spots else product


def core_moments(sums: Sums) -> Floats:
    """Return the covariance of a spot's core, (2, 2) in x and y, px^2.

    Moments weighted with a Gaussian of the spot's own shape (Bernstein & Jarvis 2002, AJ 123, 583): wings
    and noise far out do not count.
    """
    square, _, product = sums.planes
    u = offsets(len(square))
    y, x = np.meshgrid(u, u, indexing="ij")
    flux = np.divide(product, square, out=np.zeros_like(square), where=square > 0)
    moments = np.diag([1.5, 1.5])
    for _ in range(_MOMENT_STEPS):
        inverse = np.linalg.inv(moments)
        exponent = inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y
        values = flux * np.exp(-0.5 * exponent)
        total = max(values.sum(), _TINY)
        xx, xy, yy = ((values * product).sum() / total for product in (x * x, x * y, y * y))
        # The weight halved the covariance. Stay within what the grid can show.
        variances, axes = np.linalg.eigh(2 * np.array([[xx, xy], [xy, yy]]))
        moments = (axes * np.clip(variances, _LEAST_VARIANCE_PX2, (u[-1] / 2) ** 2)) @ axes.T
    return moments


def _turned(sums: Sums, angle: float) -> Sums:
    """Return the sums on a grid whose x axis lies at that angle."""
    if angle == 0.0:
        return sums
    side = sums.planes.shape[1]
    middle = (side - 1) // 2
    row, column = np.indices((side, side)) - middle
    x = np.rint(np.cos(angle) * column + np.sin(angle) * row).astype(np.int64) + middle
    y = np.rint(np.cos(angle) * row - np.sin(angle) * column).astype(np.int64) + middle
    inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
    cell = (y * side + x)[inside]
    planes = [np.bincount(cell, plane[inside], side * side).reshape(side, side) for plane in sums.planes]
    return replace(sums, planes=np.stack(planes))


def _product(sums: Sums, form: Form, radius_px: float, angle: float, stds: Floats) -> PSFFit:
    """Alternate least squares for both profiles and the background; mirror-symmetric along both axes."""
    turned = _turned(sums, angle)
    turned = turned.folded(turned.planes[:, :, ::-1])
    if form.square:
        turned, stds = turned.folded(turned.transposed().planes), np.full(2, np.sqrt(np.mean(stds**2)))
    u = offsets(sums.planes.shape[1])
    basis = spline_basis(u, radius_px, NODES_PER_PX)
    gaussians = np.exp(-0.5 * (u / stds[:, None]) ** 2)
    nodes = np.linalg.lstsq(basis, gaussians.T, rcond=None)[0].T
    profile_x, profile_y = gaussians
    background = 0.0
    for _ in range(_SWEEPS):
        profile_x, _ = _profile(turned, profile_y, basis, nodes[0], form.bend)
        profile_x = profile_x / max(float(profile_x.max()), _TINY)
        profile_y, background = _profile(turned.transposed(), profile_x, basis, nodes[1], form.bend)
    if angle == 0.0:
        plane = np.outer(profile_y, profile_x)
        return PSFFit(0.5 * (plane + plane.T) if form.square else plane, background)
    y, x = np.meshgrid(u, u, indexing="ij")
    along = np.interp(np.cos(angle) * x + np.sin(angle) * y, u, profile_x, 0, 0)
    return PSFFit(along * np.interp(np.cos(angle) * y - np.sin(angle) * x, u, profile_y, 0, 0), background)


def _profile(sums: Sums, other: Floats, basis: Floats, gaussian: Floats, bend: float) -> tuple[Floats, float]:
    """Least squares for the profile along columns and the background, the other profile given.

    Its second differences are held to those of a Gaussian (spline coefficients), scaled to the same height.
    """
    square, cross, product = sums.planes
    square, cross, product = other**2 @ square, other @ cross, other @ product
    n = basis.shape[1]
    normal = np.empty((n + 1, n + 1))
    normal[:n, :n] = (basis.T * square) @ basis
    normal[:n, n] = normal[n, :n] = basis.T @ cross
    normal[n, n] = sums.weight
    right = np.append(basis.T @ product, sums.image)
    height = max(gaussian @ right[:n] / max(gaussian @ normal[:n, :n] @ gaussian, _TINY), _TINY)
    second = np.diff(np.pad(np.eye(n), ((1, 1), (0, 0))), 2, axis=0) / (bend * height)
    penalty = second.T @ second
    normal[:n, :n] += penalty
    right[:n] += penalty @ (height * gaussian)
    normal[range(n + 1), range(n + 1)] *= 1 + 1e-10
    solution = np.linalg.solve(normal, right)
    profile: Floats = basis @ solution[:n]
    return 0.5 * (profile + profile[::-1]), float(solution[n])


def _with_deviation(sums: Sums, fit: PSFFit, deviation: float, radius_px: float) -> PSFFit:
    """Add to the product what the data say beyond it, shrunk towards nothing; point-symmetric."""
    (square, cross, image), (product, background) = sums.planes, fit
    u = offsets(len(product))
    nodes_per_px = NODES_PER_PX if 2 * radius_px * NODES_PER_PX <= _MOST_NODES else 1
    basis = spline_basis(u, radius_px, nodes_per_px)
    n = basis.shape[1]
    reach = (n - 1) // 2
    node = (len(u) - 1) // 2 + np.arange(-reach, reach + 1) * (FINE // nodes_per_px)
    expected = np.abs(product[np.ix_(node, node)]) + _DEVIATION_FLOOR * product.max()
    normal = _normal_matrix(square, basis)
    normal[range(n * n), range(n * n)] += 1 / (deviation * expected.ravel()) ** 2
    remaining = image - square * product - background * cross
    right = (basis.T @ remaining @ basis).ravel()
    half = n * n // 2 + 1  # coefficient i is the same as i from the end
    right = right[:half] + right[: half - 2 : -1]
    normal = normal[:half] + normal[: half - 2 : -1]
    normal = normal[:, :half] + normal[:, : half - 2 : -1]
    first = scipy.linalg.solve(normal, right, assume_a="pos")
    first[-1] *= 2  # the middle one, added to itself
    coefficients = np.concatenate([first, first[-2::-1]]).reshape(n, n)
    plane = product + basis @ coefficients @ basis.T
    background = (sums.image - float((cross * plane).sum())) / max(sums.weight, _TINY)
    return PSFFit(0.5 * (plane + plane[::-1, ::-1]), background)


def _normal_matrix(square: Floats, basis: Floats) -> Floats:
    """Normal matrix of all products of splines along y and x, (n^2, n^2); only neighbours overlap."""
    n = basis.shape[1]
    low, apart = np.meshgrid(np.arange(n), np.arange(4), indexing="ij")
    first, second = low[low + apart < n], (low + apart)[low + apart < n]
    pairs = basis[:, first] * basis[:, second]
    values = pairs.T @ square @ pairs
    normal = np.zeros((n, n, n, n))
    for row_a, row_b in ((first, second), (second, first)):
        for column_a, column_b in ((first, second), (second, first)):
            normal[row_a[:, None], column_a, row_b[:, None], column_b] = values
    return normal.reshape(n * n, n * n)


def samples_of(plane: Floats, radius_px: int, oversampling: int) -> NDArray[np.float64]:
    """Return every so many-th node of a fine plane, out to the radius."""
    step = FINE // oversampling
    middle = (len(plane) - 1) // 2
    reach = radius_px * oversampling
    chosen = middle + step * np.arange(-reach, reach + 1)
    return plane[np.ix_(chosen, chosen)]
