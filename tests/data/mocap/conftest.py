"""A site on this machine, and hasty downloads from it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ssmail.data.mocap import download
from tests.data.mocap import misbehaving_site
from tests.data.mocap.misbehaving_site import Fetch, Site


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """The site, whose files have the digests that ssmail knows."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    with misbehaving_site.serving() as served:
        monkeypatch.setattr(download, "BASE_URL", served.url)
        monkeypatch.setattr(download, "SHA256", misbehaving_site.digests(served))
        yield served


@pytest.fixture
def fetch(site: Site, tmp_path: Path) -> Fetch:
    """fetch(trials=(1, 2), said=[], **options): without pauses, three attempts, ten seconds of patience."""

    def call(trials: Any = (1, 2), said: list[str] | None = None, **options: Any) -> Path:
        haste: dict[str, Any] = {"pause_seconds": 0, "timeout_seconds": 10, "attempts": 3}
        report = (said if said is not None else []).append
        return download.fetch(
            options.pop("subject", 35), trials, tmp_path / "cache", **{"report": report, **haste, **options}
        )

    return call
