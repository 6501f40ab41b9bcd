from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from tests.estimate.image_cases import refused

import faintspot as fs
from faintspot.settings import PER_SUBAPERTURE, PerSubaperture


class TestSettings:
    def test_scalars_become_plain(self) -> None:
        settings = fs.Settings(noise_std=np.float32(0.5), keep_brightest=np.int8(7), denoise=np.True_)
        assert type(settings.noise_std) is float
        assert type(settings.keep_brightest) is int
        assert settings.denoise is True
        assert settings == fs.Settings(noise_std=0.5, keep_brightest=7)
        assert settings != fs.Settings(noise_std=0.5, keep_brightest=8)
        assert settings != 0.5

    def test_is_immutable_and_private(self) -> None:
        strengths = np.array([1.0, 2.0])
        settings = fs.Settings(noise_std=strengths, rule=["threshold", "subtract_kth"], denoise=[True, False])
        strengths[0] = 9.0
        assert settings.noise_std[0] == 1.0
        for array in (settings.noise_std, settings.rule, settings.denoise):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = array[1]
        with pytest.raises(FrozenInstanceError):
            settings.algorithm = "chambolle"  # type: ignore[misc]

    def test_defaults(self) -> None:
        settings = fs.Settings(noise_std=1.0)
        assert settings.values("keep_brightest", 3, 256).tolist() == [20] * 3
        assert settings.values("keep_brightest", 1, 16).tolist() == [5]
        assert settings.values("tolerance", 2, 16).tolist() == [0.01, 0.01]
        fast = settings.replace(preset="fast")
        assert fast.values("tolerance", 2, 16).tolist() == [0.0, 0.0]
        assert fast.values("max_iterations", 2, 16).tolist() == [8, 8]
        assert fast.replace(max_iterations=5).values("max_iterations", 1, 16).tolist() == [5]
        assert fs.Settings(denoise=False).values("noise_std", 2, 16).tolist() == [0.0, 0.0]

    @pytest.mark.parametrize(
        ("words", "arguments"),
        [
            ("noise_std: expected a number (electrons)", {"noise_std": None}),
            ("noise_std", {"noise_std": None, "denoise": [False, True]}),
            ("noise_std = -1", {"noise_std": -1.0}),
            ("noise_std", {"noise_std": np.nan}),
            ("noise_std", {"noise_std": [1.0, np.nan]}),
            ("noise_std", {"noise_std": "1"}),
            ("noise_std", {"noise_std": [[1.0]]}),
            ("noise_std", {"noise_std": []}),
            ("tolerance = 2", {"tolerance": 2.0}),
            ("flux_floor", {"flux_floor": None}),
            ("preset = 'slow': expected", {"preset": "slow"}),
            ("max_iterations = 0", {"max_iterations": 0}),
            ("max_iterations = 1.5", {"max_iterations": 1.5}),
            ("max_iterations", {"max_iterations": 1e9}),
            ("keep_brightest = 0", {"keep_brightest": 0}),
            ("keep_brightest = 2.5", {"keep_brightest": [1, 2.5]}),
            ("rule = 'brightest'", {"rule": "brightest"}),
            ("rule", {"rule": ["threshold", "x"]}),
            ("rule", {"rule": 3}),
            ("denoise = 'yes'", {"denoise": "yes"}),
            ("denoise", {"denoise": [1, 0]}),
            ("denoise", {"denoise": 1}),
            ("algorithm = 'newton': expected one of 'fgp', 'chambolle'", {"algorithm": "newton"}),
            ("algorithm", {"algorithm": ["fgp"]}),
            ("flux_floor = -0.1", {"flux_floor": -0.1}),
            ("max_bad_fraction = 1.1", {"max_bad_fraction": 1.1}),
            (
                "arrays of one length, got noise_std 2, keep_brightest 3",
                {"noise_std": [1, 2], "keep_brightest": [1, 2, 3]},
            ),
        ],
    )
    def test_bad_values(self, words: str, arguments: dict[str, Any]) -> None:
        with refused(words):
            fs.Settings(**{"noise_std": 1.0, **arguments})


class TestReplace:
    base = fs.Settings(noise_std=1.0, keep_brightest=10)

    def test_everywhere(self) -> None:
        changed = self.base.replace(noise_std=2.0, algorithm="chambolle")
        assert changed == fs.Settings(noise_std=2.0, keep_brightest=10, algorithm="chambolle")
        assert self.base.noise_std == 1.0

    @pytest.mark.parametrize(
        "where", [[1, 3], np.array([1, 3]), (1, 3), np.array([False, True, False, True, False])]
    )
    def test_some(self, where: Any) -> None:
        changed = self.base.replace(where=where, noise_std=2.0)
        assert changed.values("noise_std", 5, 256).tolist() == [1, 2, 1, 2, 1]
        each = self.base.replace(where=where, noise_std=[2.0, 3.0])
        assert each.values("noise_std", 5, 256).tolist() == [1, 2, 1, 3, 1]
        assert self.base.noise_std == 1.0

    def test_one(self) -> None:
        assert self.base.replace(where=0, rule="threshold").values("rule", 2, 16).tolist() == [
            "threshold",
            "subtract_next",
        ]

    def test_again_and_again(self) -> None:
        changed = self.base.replace(where=[0, 1], noise_std=2.0).replace(where=[1, 2], noise_std=3.0)
        assert changed.values("noise_std", 4, 16).tolist() == [2, 3, 3, 1]
        assert changed.replace(noise_std=5.0).noise_std == 5.0

    def test_of_arrays(self) -> None:
        arrays = fs.Settings(noise_std=[1, 2, 3], rule=["threshold"] * 3)
        changed = arrays.replace(where=2, noise_std=9.5).replace(where=[0], rule="subtract_next")
        assert changed.values("noise_std", 3, 16).tolist() == [1, 2, 9.5]
        assert changed.values("rule", 3, 16).tolist() == ["subtract_next", "threshold", "threshold"]
        assert arrays.rule.tolist() == ["threshold"] * 3

    def test_nothing_selected(self) -> None:
        changed = self.base.replace(where=[], noise_std=2.0)
        assert changed.values("noise_std", 2, 16).tolist() == [1.0, 1.0]

    def test_default_that_depends_on_the_window(self) -> None:
        changed = fs.Settings(noise_std=1.0).replace(where=1, keep_brightest=3)
        assert changed.values("keep_brightest", 3, 256).tolist() == [20, 3, 20]

    def test_per_subaperture(self) -> None:
        values = PerSubaperture(1.0, {2: 5.0})
        assert [values[i] for i in range(3)] == [1.0, 1.0, 5.0]
        assert fs.Settings(noise_std=values) == fs.Settings(noise_std=1.0).replace(where=2, noise_std=5.0)
        with refused("noise_std = -5"):
            fs.Settings(noise_std=PerSubaperture(1.0, {2: -5.0}))

    @pytest.mark.parametrize(
        ("words", "where", "changes"),
        [
            ("'noise_sd'", None, {"noise_sd": 1.0}),
            ("'noise_sd'", [0], {"noise_sd": 1.0}),
            ("where", [-1], {"noise_std": 1.0}),
            ("where = 0.5", [0.5], {"noise_std": 1.0}),
            ("where", "all", {"noise_std": 1.0}),
            ("noise_std = -1", [0], {"noise_std": -1.0}),
            ("as many as `where`, got 3", [0, 1], {"noise_std": [1.0, 2.0, 3.0]}),
            ("algorithm", [0], {"algorithm": "chambolle"}),
            ("keep_brightest: expected a value", [0], {"keep_brightest": None}),
        ],
    )
    def test_bad(self, words: str, where: Any, changes: dict[str, Any]) -> None:
        with refused(words):
            self.base.replace(where=where, **changes)

    def test_beyond_the_sensor(self) -> None:
        with refused("where", "sub-aperture 3 does not exist; there are 3"):
            fs.Settings(noise_std=[1, 2, 3]).replace(where=3, noise_std=1.0)
        with refused("noise_std", "sub-aperture 7 does not exist; there are 5"):
            self.base.replace(where=7, noise_std=2.0).values("noise_std", 5, 16)
        for name in PER_SUBAPERTURE:
            assert len(self.base.values(name, 5, 16)) == 5


class TestStrengthIsNeededWhereSomethingIsDenoised:
    def test_not_elsewhere(self) -> None:
        off = fs.Settings(denoise=False)
        assert off.replace(where=[1], noise_std=2.0, denoise=True).values("noise_std", 2, 16).tolist() == [
            0,
            2,
        ]
        assert fs.Settings(denoise=[False, False]).noise_std is None
        fs.Settings(noise_std=PerSubaperture(None, {0: 1.0}), denoise=[True, False])

    @pytest.mark.parametrize(
        ("noise_std", "denoise"),
        [
            (PerSubaperture(None, {0: 1.0}), True),
            (PerSubaperture(None, {0: 1.0}), [True, True]),
            (PerSubaperture(None, {0: 1.0}), PerSubaperture(False, {1: True})),
            (None, PerSubaperture(False, {3: True})),
            (None, PerSubaperture(True, {3: False})),
        ],
    )
    def test_missing(self, noise_std: Any, denoise: Any) -> None:
        with refused("noise_std: expected a number (electrons)"):
            fs.Settings(noise_std=noise_std, denoise=denoise)
