"""What takes long says why, what does not says nothing."""

import time
from typing import Any

import pytest

from faintspot.cli.realtime import engine_requests

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("patience_s", "takes_s", "says"), [(0.0, 0.2, True), (60.0, 0.0, False)])
def test_reason_for_waiting(
    patience_s: float,
    takes_s: float,
    says: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def answer(path: object, command: str, timeout_s: float, **fields: Any) -> dict[str, Any]:
        time.sleep(takes_s)
        return {"command": command, **fields}

    monkeypatch.setattr(engine_requests, "request", answer)
    monkeypatch.setattr(engine_requests, "PATIENCE_S", patience_s)
    assert engine_requests.asked_at_length("engine", "set", changes={}) == {"command": "set", "changes": {}}
    said = capsys.readouterr()
    assert not said.out
    assert ("compiles" in said.err) == says
