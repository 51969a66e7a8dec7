"""The cache: nothing changed, half-written or foreign is taken for what was downloaded."""

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ssmail.data.mocap import download
from ssmail.data.mocap.cache import RECORD, open_cache
from ssmail.errors import InputError, SsmailError
from tests.data.mocap.misbehaving_site import MOTION, SKELETON, Fetch, Site, assert_whole, tag


def test_another_file_on_a_later_visit_is_refused(fetch: Fetch, site: Site) -> None:
    folder = fetch()
    before = (folder / "35_01.amc").read_bytes()
    site.files["/subjects/35/35_01.amc"] = MOTION.replace(b"17.9", b"18.0")
    (folder / "35_01.amc").unlink()
    with pytest.raises(
        SsmailError, match=r"35_01\.amc is another file than on 20\d\d-\d\d-\d\d \(SHA-256 .*empty --cac"
    ):
        fetch()
    assert not (folder / "35_01.amc").exists()
    site.files["/subjects/35/35_01.amc"] = before
    assert_whole(fetch(), site)


def test_a_file_that_was_changed_in_the_cache_is_refused(fetch: Fetch, site: Site) -> None:
    folder = fetch()
    path = folder / "35_01.amc"
    good = path.read_bytes()
    for bad in (good[:-1], good.replace(b"17.9", b"18.0", 1)):
        path.write_bytes(bad)
        with pytest.raises(InputError, match=r"35_01\.amc was changed after it was downloaded on .*; delete it"):
            fetch()
        assert path.read_bytes() == bad
    assert len(site.asked) == 3
    path.unlink()
    assert_whole(fetch(), site)


def test_a_file_of_somebody_else_is_left_alone(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    stray = tmp_path / "cache/35/35_01.amc"
    stray.parent.mkdir(parents=True)
    stray.write_bytes(MOTION)
    with pytest.raises(InputError, match=rf"{RECORD} does not record {stray} as a download; move it away"):
        fetch()
    assert stray.read_bytes() == MOTION
    assert site.asked == []


@pytest.mark.parametrize("text", ["", "{", "[]", '{"whole": {"35.asf": {"size": 1}}, "partial": {}}', '{"whol": {}}'])
def test_a_damaged_record(fetch: Fetch, site: Site, text: str) -> None:
    folder = fetch()
    (folder / RECORD).write_text(text)
    with pytest.raises(InputError, match=rf"{RECORD} is damaged"):
        fetch()
    assert len(site.asked) == 3


def test_two_at_a_time_are_one_too_many(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    with open_cache(tmp_path / "cache" / "35"), pytest.raises(InputError, match="another ssmail is downloading into"):
        fetch()
    assert_whole(fetch(), site)


def test_an_unusable_cache(fetch: Fetch, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("")
    with pytest.raises(InputError, match=r"cannot use the cache .*; choose another --cache"):
        fetch()


def test_killed_between_the_record_and_the_name(fetch: Fetch, site: Site) -> None:
    """The record is written first; the file comes again and has to have the recorded checksum."""
    folder = fetch()
    (folder / "35_01.amc").rename(folder / "35_01.amc.part")
    assert_whole(fetch(), site)
    assert site.names()[3:] == ["35_01.amc"]


def test_ctrl_c_leaves_what_can_be_resumed(
    fetch: Fetch, site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(response: Any, timeout: float) -> Iterator[bytes]:
        yield response.read(1000)
        raise KeyboardInterrupt

    site.files["/subjects/35/35.asf"] = SKELETON + b"# more\r\n" * 200
    with monkeypatch.context() as patch:
        patch.setattr(download, "_chunks", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fetch()
    assert sorted(path.name for path in (tmp_path / "cache/35").iterdir()) == ["35.asf.part", RECORD]
    assert_whole(fetch(), site)
    assert site.headers("Range") == [None, "bytes=1000-", None, None]


def _fetch_slowly(url: str, cache: Path) -> None:
    download.fetch(35, [1, 2], cache, base_url=url, pause_seconds=0, timeout_seconds=5, report=lambda _: None)


def test_sigkill_at_any_moment_leaves_nothing_half_written(site: Site, fetch: Fetch, tmp_path: Path) -> None:
    def dripping(request: Any, body: bytes) -> None:
        request.answer(200, b"", length=len(body), ETag=tag(body))
        for start in range(0, len(body), 500):
            request.wfile.write(body[start : start + 500])
            time.sleep(0.01)

    site.misbehaves("35_01.amc", dripping, dripping)
    process = multiprocessing.get_context("fork").Process(target=_fetch_slowly, args=(site.url, tmp_path / "cache"))
    process.start()
    part = tmp_path / "cache/35/35_01.amc.part"
    deadline = time.monotonic() + 10
    while not (part.exists() and part.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.002)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not (tmp_path / "cache/35/35_01.amc").exists()
    assert part.stat().st_size < len(MOTION)
    assert_whole(fetch(), site)
