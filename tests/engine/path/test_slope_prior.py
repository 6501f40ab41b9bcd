import numpy as np

from faintspot.engine.path.workers import SlopePrior


def test_what_is_expected_and_how_surely() -> None:
    """Widths are the rms of both axes; what no frame can hold is not expected, what says nothing is NaN."""
    prior = SlopePrior(3, 10.0)
    mean = np.array([1.0, 11.0, np.nan, -2.0, 3.0, -10.0])
    std = np.array([3.0, 1.0, np.inf, 4.0, 0.0, 1.0])
    prior.expect(mean, std)
    np.testing.assert_array_equal(prior.mean_px, [[[1.0, 0.0, 0.0], [-2.0, 3.0, -10.0]]])
    np.testing.assert_allclose(prior.std_px, [np.sqrt(12.5), np.nan, np.nan])
    assert prior.changes == 1
    prior.expect(-mean, std)  # as sure as before
    assert prior.changes == 1
    prior.expect(mean, std.copy())
    assert prior.changes == 2
    prior.forget()
    assert not prior.mean_px.any()
    assert np.isnan(prior.std_px).all()
    assert prior.changes == 3
