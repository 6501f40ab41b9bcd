import faintspot as fs
from faintspot.engine.page.status import settings_rows
from faintspot.slopes.pipeline.settings import SharedOptions


def test_every_setting_is_a_row_of_the_form() -> None:
    values = {
        "estimator": "tv",
        "noise_std": 2.5,
        "rule": "subtract_next",
        "flux_e": None,
        "search_range_px": 3,
    }
    rows = {row["name"]: row for row in settings_rows(values)}
    assert list(rows) == list(values)
    assert "ml" in rows["estimator"]["choices"]
    assert rows["noise_std"]["value"] == "2.5"
    assert "noise" in rows["noise_std"]["meaning"]
    assert rows["rule"]["choices"][0] == "subtract_next"
    assert rows["flux_e"]["value"] == "none"


def test_values_of_subapertures_are_told_by_their_ends() -> None:
    def text(value: list[float]) -> str:
        (row,) = settings_rows({"noise_std": value})
        return str(row["value"])

    assert text([2.0] * 36) == "2"
    assert text([1.0, 2.5]) == "1,2.5"
    assert text([float(i) for i in range(36)]) == "(36 values, 0 to 35)"


def test_what_an_engine_answers_can_be_set_again() -> None:
    """The form's texts, parsed as `realtime send` parses them, are the settings."""
    from faintspot.base.tables import parse_changes

    settings = fs.Settings(estimator="ml", search_range_px=2.5)
    names = [*settings.estimator.declared(), *SharedOptions.declared()]
    values = {name: getattr(settings, name) for name in names}
    rows = settings_rows({"estimator": "ml", **values})
    changes = parse_changes([f"{row['name']}={row['value']}" for row in rows])
    assert fs.Settings(**changes) == settings
