"""The download, against a site on this machine that misbehaves in every way we could think of."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.data.mocap import download
from ssmail.data.mocap.source import LARGEST
from ssmail.errors import InputError, SsmailError
from tests.data.mocap import misbehaving_site as site_that
from tests.data.mocap.misbehaving_site import (
    DATE,
    MOTION,
    NAMES,
    PAGE,
    SKELETON,
    Fetch,
    Site,
    assert_whole,
    cut,
    status,
    tag,
)


@pytest.fixture
def released() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


def test_every_file_is_asked_for_once_in_order(fetch: Fetch, site: Site) -> None:
    said: list[str] = []
    folder = fetch(("1", "02", 1), said)
    assert_whole(folder, site)
    assert site.names() == list(NAMES)
    assert site.most_open == 1
    assert all((agent or "").startswith("ssmail/") for agent in site.headers("User-Agent"))
    assert "may not be resold" in said[0]
    assert "obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217" in said[1]
    assert said[2:] == ["35.asf: 0 kB [1/3]", "35_01.amc: 7 kB [2/3]", "35_02.amc: 7 kB [3/3]"]


def test_a_second_visit_asks_for_nothing_new(fetch: Fetch, site: Site) -> None:
    fetch([1])
    said: list[str] = []
    fetch([1, 2], said)
    assert site.names() == list(NAMES)
    assert "2 of 3 files are in" in said[2]
    fetch([2])
    assert len(site.asked) == 3


def test_there_is_a_pause_between_files_only(fetch: Fetch, monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    fetch(pause_seconds=1.5)
    assert slept == [1.5, 1.5]
    fetch(pause_seconds=1.5)
    assert len(slept) == 2


def test_a_cut_connection_goes_on_where_it_stopped(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", cut(1000))
    said: list[str] = []
    assert_whole(fetch(said=said), site)
    assert site.names() == ["35.asf", "35_01.amc", "35_01.amc", "35_02.amc"]
    assert site.headers("Range") == [None, None, "bytes=1000-", None]
    assert site.headers("If-Range")[2] == tag(site.files["/subjects/35/35_01.amc"])
    size = len(site.files["/subjects/35/35_01.amc"])
    assert f"35_01.amc: the connection was cut after 1000 of {size} bytes; trying again in 0 s" in said


def test_a_later_visit_goes_on_too(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", cut(1000))
    with pytest.raises(SsmailError, match=r"cut after 1000 of \d+ bytes; later the same command goes on from here$"):
        fetch(attempts=1)
    folder = fetch()
    assert_whole(folder, site)
    assert site.headers("Range") == [None, None, "bytes=1000-", None]


def test_several_cuts_add_up(fetch: Fetch, site: Site) -> None:
    body = site.files["/subjects/35/35_01.amc"]

    def cut_again(request: Any, _: bytes) -> None:
        span = f"bytes 1000-{len(body) - 1}/{len(body)}"
        request.answer(206, body[1000:3000], length=len(body) - 1000, Content_Range=span)

    site.misbehaves("35_01.amc", cut(1000), cut_again)
    assert_whole(fetch(), site)
    assert site.headers("Range")[2:4] == ["bytes=1000-", "bytes=3000-"]


def test_the_date_of_the_last_change_serves_as_well(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", cut(1000, ETag='W/"weak"', Last_Modified=DATE))
    assert_whole(fetch(), site)
    assert site.headers("If-Range")[2] == DATE


def test_without_a_validator_it_starts_over(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", cut(1000, ETag='W/"weak"'))
    assert_whole(fetch(), site)
    assert site.headers("Range") == [None] * 4


def test_a_file_that_changed_meanwhile_is_not_patched_together(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", cut(1000))
    with pytest.raises(SsmailError, match="cut"):
        fetch(attempts=1)
    site.files["/subjects/35/35_01.amc"] = MOTION.replace(b"root", b"ROOT")
    assert_whole(fetch(), site)
    assert site.headers("Range")[2] == "bytes=1000-"


def test_a_server_that_ignores_ranges_gives_the_whole_file(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", cut(1000), site_that.without_ranges)
    assert_whole(fetch(), site)
    assert site.headers("Range")[2] == "bytes=1000-"


@pytest.mark.parametrize("wrong", [(900, 0), (1100, 0), (1000, 7), (1000, -7)])
def test_another_part_than_the_one_asked_for_is_not_used(fetch: Fetch, site: Site, wrong: tuple[int, int]) -> None:
    first, excess = wrong
    size = len(site.files["/subjects/35/35_01.amc"]) + excess
    site.misbehaves("35_01.amc", cut(1000), site_that.range_of(first, size))
    said: list[str] = []
    assert_whole(fetch(said=said), site)
    assert any("sent another part" in line for line in said)
    assert site.headers("Range") == [None, None, "bytes=1000-", None, None]


def test_a_part_that_the_server_cannot_go_on_from_is_dropped(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", cut(1000), status(416))
    assert_whole(fetch(), site)
    assert site.headers("Range")[2:4] == ["bytes=1000-", None]


def test_passing_failures_are_tried_again_after_growing_waits(
    fetch: Fetch, site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    site.misbehaves("35.asf", status(500), status(503, Retry_After="9"))
    said: list[str] = []
    assert_whole(fetch(said=said, backoff_seconds=2), site)
    assert [wait for wait in slept if wait] == [2, 9]
    assert said[2:4] == [
        "35.asf: the server answered 500; trying again in 2 s",
        "35.asf: the server answered 503; trying again in 9 s",
    ]


def test_failures_that_do_not_pass_end_it(fetch: Fetch, site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.misbehaves("35.asf", *[status(500)] * 3)
    with pytest.raises(SsmailError, match=r"35\.asf could not be downloaded: the server answered 500; later the same"):
        fetch()
    assert len(site.asked) == 3
    site.misbehaves("35.asf", status(503, Retry_After="86400"))
    with monkeypatch.context() as patch:
        patch.setattr(time, "sleep", pytest.fail)
        with pytest.raises(SsmailError, match="answered 503"):
            fetch()
    assert len(site.asked) == 4, "nobody waits for a day"
    site.misbehaves("35.asf", status(403))
    with pytest.raises(SsmailError, match="answered 403; look at it in a browser"):
        fetch()
    assert len(site.asked) == 5


def test_a_trial_that_there_is_not(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no http\S+/35_09\.amc \(the server answered 404\); check the num"):
        fetch([1, 9])
    assert len(site.asked) == 3, "404 is not tried again"
    assert not (tmp_path / "cache/35/35_09.amc").exists()


def test_a_missing_trial_can_be_insisted_on(fetch: Fetch, site: Site) -> None:
    said: list[str] = []
    assert_whole(fetch([1, 9, 2], said, allow_missing=True), site)
    assert said[3:] == ["35_01.amc: 7 kB [2/4]", "35_09.amc: not there [3/4]", "35_02.amc: 7 kB [4/4]"]
    with pytest.raises(InputError, match=r"there is no http\S+/36\.asf"):
        fetch([1], subject=36, allow_missing=True)


@pytest.mark.parametrize(
    ("name", "body", "fault"),
    [
        ("35.asf", PAGE, "is a web page"),
        ("35_01.amc", b"\n\n  <HTML>gone</HTML>", "is a web page"),
        ("35.asf", MOTION, "is no skeleton"),
        ("35_01.amc", SKELETON, "is no motion"),
        ("35_01.amc", b'{"error": "quota"}', "is no motion"),
        ("35_01.amc", MOTION + b"\0" * 100, "is not text"),
        ("35_01.amc", b"# nothing but\r\n# comments", "is empty"),
    ],
)
def test_status_200_with_something_else(fetch: Fetch, site: Site, name: str, body: bytes, fault: str) -> None:
    site.misbehaves(name, status(200, body, ETag='"x"'))
    with pytest.raises(SsmailError, match=rf"{name} gives {fault}") as caught:
        fetch()
    assert "\n" not in str(caught.value)
    assert site.names().count(name) == 1
    assert_whole(fetch(), site)
    assert set(site.headers("Range")) == {None}, "nothing of the wrong file is kept"


def test_no_length_no_file(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    site.misbehaves("35_01.amc", site_that.without_length)
    with pytest.raises(SsmailError, match=r"does not say how long \S+35_01\.amc is"):
        fetch()
    assert not (tmp_path / "cache/35/35_01.amc").exists()
    site.misbehaves("35_01.amc", status(200, b""))
    with pytest.raises(SsmailError, match="is empty"):
        fetch()


def test_chunks_tell_their_end(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", site_that.in_chunks(b""), site_that.in_chunks(b"0\r\n\r\n"))
    said: list[str] = []
    assert_whole(fetch(said=said), site)
    assert "35_01.amc: the connection was cut; trying again in 0 s" in said


def test_a_file_without_end_is_given_up(fetch: Fetch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LARGEST, ".amc", 2000)
    with pytest.raises(SsmailError, match=r"35_01\.amc is larger than"):
        fetch()


def test_a_silent_server(fetch: Fetch, site: Site, released: threading.Event) -> None:
    site.misbehaves("35.asf", site_that.silent(released))
    site.misbehaves("35_01.amc", site_that.silent(released, after=1000))
    said: list[str] = []
    assert_whole(fetch(said=said, timeout_seconds=0.3, attempts=9), site)
    assert "35.asf: nothing came for 0.3 s; trying again in 0 s" in said
    assert "35_01.amc: nothing came for 0.3 s; trying again in 0 s" in said
    assert "bytes=1000-" in site.headers("Range")


def test_a_trickling_server(
    fetch: Fetch, site: Site, released: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(download, "SLOWEST", 0.01)
    site.misbehaves("35_01.amc", site_that.trickling(released))
    said: list[str] = []
    assert_whole(fetch(said=said), site)
    assert "35_01.amc: it did not come within 0.1 s; trying again in 0 s" in said
    assert site.headers("Range")[2] is not None


def test_nobody_at_home(fetch: Fetch) -> None:
    with pytest.raises(SsmailError, match=r"the site cannot be reached \(Connection refused\)"):
        fetch(base_url="http://127.0.0.1:9")


def test_redirections_are_followed_with_the_range(fetch: Fetch, site: Site) -> None:
    site.files["/moved/35_01.amc"] = site.files["/subjects/35/35_01.amc"]
    there = status(301, b"", Location="/moved/35_01.amc")
    site.misbehaves("35_01.amc", there, there)
    site.script["/moved/35_01.amc"] = [cut(1000)]
    assert_whole(fetch(), site)
    assert [path for path, _ in site.asked].count("/moved/35_01.amc") == 2
    assert site.headers("Range")[2:5] == [None, "bytes=1000-", "bytes=1000-"]
    site.misbehaves("35_02.amc", *[status(301, b"", Location="/subjects/35/35_02.amc")] * 20)
    (fetch() / "35_02.amc").unlink()
    with pytest.raises(SsmailError, match="answered 301"):
        fetch()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"subject": "../35"}, "'../35' is no subject of the CMU database"),
        ({"subject": 0}, "'0' is no subject"),
        ({"trials": [1, "1a"]}, "'1a' is no trial"),
        ({"trials": [1, "1\n"]}, "is no trial"),
        ({"trials": ["١"]}, "is no trial"),  # noqa: RUF001 - a digit, but not one of ours
        ({"base_url": "file:///etc"}, "'file:///etc' is no address to download from"),
        ({"base_url": "http://a b"}, "is no address"),
    ],
)
def test_bad_input(fetch: Fetch, site: Site, tmp_path: Path, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence.replace(".", r"\.")):
        fetch(**options)
    assert site.asked == []
    assert not (tmp_path / "cache").exists()


def test_numbers_are_written_as_the_site_does(fetch: Fetch, site: Site) -> None:
    site.files |= {"/subjects/07/07.asf": SKELETON, "/subjects/07/07_10.amc": MOTION}
    folder = fetch(["010"], subject=7)
    assert folder.name == "07"
    assert site.names() == ["07.asf", "07_10.amc"]


@given(st.binary(max_size=60))
def test_any_bytes_are_judged(contents: bytes) -> None:
    for name in NAMES[:2]:
        verdict = download.fault(name, contents)
        assert verdict is None or verdict.startswith("is ")
        assert download.fault(name, b"<" + contents) is not None
    assert download.fault("35.asf", b"# x\n:version 1" + contents.replace(b"\0", b"")) is None
