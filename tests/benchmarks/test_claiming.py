"""The benchmark of the queue runs, and measures claims of cells that wait."""

from pathlib import Path

import pytest

from benchmarks import claiming
from ssmail.store import Store


def test_what_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claiming, "listed", lambda where: (1.0, 2.0))
    where = str(tmp_path / "ssmail.db")
    rows = claiming.measure(where, 2, (20, 60), claims=1)
    assert [tuple(row) for row in rows] == [claiming.SHOWN] * 2
    assert [row["waiting"] for row in rows] == [20, 60]
    assert all(row["add_ms"] > 0 and 0 < row["claim_ms"] <= row["slowest_ms"] for row in rows)
    found = Store.open(where).queue.contents()
    assert (found.waiting, found.running) == (60 - 2 * (1 + 8), 2 * (1 + 8))
    with pytest.raises(AssertionError):  # negative control: nothing waits
        claiming.claim(Store.open(tmp_path / "other.db"), 1)
