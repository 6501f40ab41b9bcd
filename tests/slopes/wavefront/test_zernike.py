import numpy as np
import pytest

from faintspot.slopes.wavefront.zernike import mean_gradients, mode_name, noll_to_nm, osa_index, zernike

R, ANGLE = np.meshgrid(np.linspace(0, 1.3, 14), np.linspace(0, 2 * np.pi, 25))
X, Y = R * np.cos(ANGLE), R * np.sin(ANGLE)

# Noll (1976), table 1.
TABLE = {
    1: 1 + 0 * R,
    2: 2 * R * np.cos(ANGLE),
    3: 2 * R * np.sin(ANGLE),
    4: np.sqrt(3) * (2 * R**2 - 1),
    5: np.sqrt(6) * R**2 * np.sin(2 * ANGLE),
    6: np.sqrt(6) * R**2 * np.cos(2 * ANGLE),
    7: np.sqrt(8) * (3 * R**3 - 2 * R) * np.sin(ANGLE),
    8: np.sqrt(8) * (3 * R**3 - 2 * R) * np.cos(ANGLE),
    9: np.sqrt(8) * R**3 * np.sin(3 * ANGLE),
    10: np.sqrt(8) * R**3 * np.cos(3 * ANGLE),
    11: np.sqrt(5) * (6 * R**4 - 6 * R**2 + 1),
    22: np.sqrt(7) * (20 * R**6 - 30 * R**4 + 12 * R**2 - 1),
}


@pytest.mark.parametrize("j", TABLE)
def test_modes_are_those_of_the_table(j: int) -> None:
    np.testing.assert_allclose(zernike(j, X, Y), TABLE[j], atol=1e-12)


def test_orders_go_up_and_every_mode_comes_once() -> None:
    found = [noll_to_nm(j) for j in range(1, 67)]
    assert [n for n, _ in found] == sorted(n for n, _ in found)
    assert set(found) == {(n, m) for n in range(11) for m in range(-n, n + 1, 2)}
    assert mode_name(4) == "defocus"
    assert mode_name(46) == "n = 9, m = 1"
    assert len({mode_name(j) for j in range(1, 67)}) == 66


# Standards for reporting the optical aberrations of eyes (Thibos et al. 2002), table 2: index, n, m.
OSA = [(0, 0, 0), (1, 1, -1), (2, 1, 1), (3, 2, -2), (4, 2, 0), (5, 2, 2), (6, 3, -3), (7, 3, -1)]
OSA += [(8, 3, 1), (9, 3, 3), (10, 4, -4), (11, 4, -2), (12, 4, 0), (13, 4, 2), (14, 4, 4), (15, 5, -5)]

NAMES = {
    2: "tilt along x",
    3: "tilt along y",
    5: "astigmatism, 45°",
    6: "astigmatism, 0°",
    7: "coma along y",
    8: "coma along x",
    9: "trefoil, sine",
    11: "spherical",
    12: "secondary astigmatism, 0°",
    15: "tetrafoil, sine",
    17: "secondary coma along y",
    22: "secondary spherical",
    37: "tertiary spherical",
    45: "octafoil, sine",
}


def test_osa_indices_are_those_of_the_standard() -> None:
    ours = sorted((osa_index(j), *noll_to_nm(j)) for j in range(1, 67))
    assert ours[:16] == OSA
    assert [index for index, _, _ in ours] == list(range(66))


@pytest.mark.slow  # the import of HCIPy
def test_indices_and_modes_are_those_of_hcipy() -> None:
    hcipy = pytest.importorskip("hcipy")
    grid = hcipy.CartesianGrid(hcipy.SeparatedCoords([np.linspace(-0.7, 0.7, 8)] * 2))
    for j in range(1, 46):
        assert hcipy.zernike_to_ansi(*noll_to_nm(j)) == osa_index(j)
        theirs = hcipy.zernike_ansi(osa_index(j), D=2.0, grid=grid, radial_cutoff=False)
        np.testing.assert_allclose(zernike(j, grid.x, grid.y), theirs, atol=1e-9)


@pytest.mark.parametrize("j", NAMES)
def test_modes_have_their_names(j: int) -> None:
    assert mode_name(j) == NAMES[j]


def test_modes_are_orthonormal_over_the_disk() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(12)  # exact for the squares of r up to order 10
    radius, angle = np.sqrt((nodes + 1) / 2), 2 * np.pi * np.arange(24) / 24
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    modes = np.array([zernike(j, x, y) for j in range(1, 67)])
    products = np.einsum("iab,jab,a->ij", modes, modes, weights / 2 / len(angle))
    np.testing.assert_allclose(products, np.eye(66), atol=1e-11)


def polygon(corners: int, radius: float, turned: float, middle: tuple[float, float]) -> np.ndarray:
    angle = turned + 2 * np.pi * np.arange(corners) / corners
    return np.array(middle) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@pytest.mark.parametrize("corners", [4, 6])
def test_mean_gradients_are_those_of_many_points(corners: int) -> None:
    outline = polygon(corners, 0.3, 0.2, (0.4, -0.5))
    line = np.linspace(-0.3, 0.3, 401)
    x, y = (axis.ravel() for axis in np.meshgrid(0.4 + line, -0.5 + line))
    edges = np.roll(outline, -1, axis=0) - outline
    sides = [e[0] * (y - p[1]) - e[1] * (x - p[0]) for e, p in zip(edges, outline, strict=True)]
    inside = np.all(np.array(sides) > 0, axis=0)
    x, y, step = x[inside], y[inside], 1e-5
    modes = np.arange(2, 37)
    found = mean_gradients(modes, outline[None])[:, 0]
    for place, j in enumerate(modes.tolist()):
        along_x = (zernike(j, x + step, y) - zernike(j, x - step, y)) / (2 * step)
        along_y = (zernike(j, x, y + step) - zernike(j, x, y - step)) / (2 * step)
        # 1e-3 of the largest: the points do not fill the polygon's edge exactly.
        limit = 1e-3 * max(np.abs(along_x).max(), np.abs(along_y).max())
        np.testing.assert_allclose(found[:, place], [along_x.mean(), along_y.mean()], atol=limit)
