"""The download, against a site on this machine that misbehaves in every way we could think of."""

import gzip
import hashlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ssmail.data.mocap import download
from ssmail.data.mocap.source import LARGEST
from ssmail.errors import InputError, SsmailError
from tests.data.mocap import misbehaving_site as site_that
from tests.data.mocap.misbehaving_site import (
    MOTION,
    NAMES,
    PAGE,
    SKELETON,
    Fetch,
    Request,
    Site,
    assert_whole,
    cut,
    status,
)

CMU = os.environ.get("SSMAIL_CMU_DIR")


@pytest.fixture
def released() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch, site: Site) -> list[float]:
    """The pauses, none of which is made."""
    pauses: list[float] = []
    monkeypatch.setattr(time, "sleep", pauses.append)
    return pauses


def test_every_file_is_asked_for_once_in_order(fetch: Fetch, site: Site) -> None:
    said: list[str] = []
    folder = fetch((1, 2, 1), said)
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


def test_there_is_a_pause_between_files_only(fetch: Fetch, slept: list[float]) -> None:
    fetch(pause_seconds=1.5)
    assert slept == [1.5, 1.5]
    fetch(pause_seconds=1.5)
    assert len(slept) == 2


def test_a_cut_connection_is_noticed_and_tried_again(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    site.misbehaves("35_01.amc", cut(1000))
    assert_whole(fetch(), site)
    assert site.names() == ["35.asf", "35_01.amc", "35_01.amc", "35_02.amc"]
    (tmp_path / "cache/35/35_01.amc").unlink()
    site.misbehaves("35_01.amc", *[cut(1000)] * 3)
    with pytest.raises(SsmailError, match=r"35_01\.amc could not be downloaded: the connection was cut; run the same"):
        fetch()
    assert not (tmp_path / "cache/35/35_01.amc").exists()


def test_transient_failures_are_tried_again_after_growing_waits(fetch: Fetch, site: Site, slept: list[float]) -> None:
    site.misbehaves("35.asf", status(500), status(503))
    assert_whole(fetch(), site)
    assert [wait for wait in slept if wait] == [1, 2]


def test_failures_that_do_not_pass_end_it(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35.asf", *[status(500)] * 3)
    with pytest.raises(SsmailError, match=r"35\.asf could not be downloaded: the server answered 500; run the same"):
        fetch()
    assert len(site.asked) == 3
    site.misbehaves("35.asf", status(403))
    with pytest.raises(SsmailError, match=r"the server answered 403; run the same .* --source"):
        fetch()
    assert len(site.asked) == 4


def test_a_server_that_asks_to_wait_is_left_alone(fetch: Fetch, site: Site, slept: list[float]) -> None:
    site.misbehaves("35.asf", status(503, Retry_After="86400"))
    with pytest.raises(SsmailError, match="answered 503; run the same command again later"):
        fetch()
    assert (len(site.asked), slept) == (1, [])


def test_a_trial_that_there_is_not(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no http\S+/35_09\.amc \(the server answered 404\); check the sub"):
        fetch([1, 9])
    assert len(site.asked) == 3, "404 is not tried again"
    assert not (tmp_path / "cache/35/35_09.amc").exists()


def test_a_missing_trial_can_be_insisted_on(fetch: Fetch, site: Site) -> None:
    said: list[str] = []
    assert_whole(fetch([1, 9, 2], said, allow_missing=True), site)
    assert said[3:] == ["35_01.amc: 7 kB [2/4]", "35_09.amc: not there [3/4]", "35_02.amc: 7 kB [4/4]"]
    with pytest.raises(InputError, match=r"there is no http\S+/36\.asf"):
        fetch([1], subject=36, allow_missing=True)


def test_a_wrong_digest_is_refused_and_not_kept(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    good = site.files["/subjects/35/35_01.amc"]
    site.files["/subjects/35/35_01.amc"] = MOTION.replace(b"17.9", b"18.0")
    with pytest.raises(
        SsmailError,
        match=r"35_01\.amc is not the file that ssmail knows \(its SHA-256 differs\) and was deleted; .*sou",
    ):
        fetch()
    assert [path.name for path in (tmp_path / "cache/35").iterdir()] == ["35.asf"]
    site.files["/subjects/35/35_01.amc"] = good
    assert_whole(fetch(), site)


def test_the_digest_of_a_file_that_nobody_knows_is_reported(fetch: Fetch, site: Site) -> None:
    site.files |= {"/subjects/36/36.asf": SKELETON, "/subjects/36/36_01.amc": MOTION}
    said: list[str] = []
    fetch([1], said, subject=36)
    digests = [hashlib.sha256(contents).hexdigest() for contents in (SKELETON, MOTION)]
    assert said[2:] == [
        f"36.asf: 0 kB, SHA-256 {digests[0]} [1/2]",
        f"36_01.amc: 7 kB, SHA-256 {digests[1]} [2/2]",
    ]


def test_a_file_that_comes_compressed_is_refused(fetch: Fetch, site: Site) -> None:
    """Unpacked, it may have any size."""
    site.misbehaves("35.asf", status(200, gzip.compress(SKELETON), Content_Encoding="gzip"))
    with pytest.raises(SsmailError, match=r"35\.asf comes compressed, which nobody asked for; run the same"):
        fetch()


ANSWERS = {
    "no HTTP": b"hello\r\n\r\n",
    "nothing": b"",
    "a long line": b"HTTP/1.1 200 OK\r\nX: " + b"x" * 100_000 + b"\r\n\r\n",
    "many lines": b"HTTP/1.1 200 OK\r\n" + b"X: x\r\n" * 1000 + b"\r\n",
    "a wrong length": b"HTTP/1.1 200 OK\r\nContent-Length: -5\r\n\r\n" + SKELETON,
    "no number as length": b"HTTP/1.1 200 OK\r\nContent-Length: \x1b[31m\r\n\r\n" + SKELETON,
    "two lengths": b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\n" + SKELETON,
    "an endless chunk": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + b"f" * 100_000,
    "no number as chunk": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n\x1b[31m\r\n",
    "a status of its own": b"HTTP/1.1 999 \x1b[31m\r\nContent-Length: 0\r\n\r\n",
    **{
        f"redirection to {place[:12]!r}": b"HTTP/1.1 302 Found\r\nContent-Length: 0\r\nLocation: " + place + b"\r\n\r\n"
        for place in (
            b"file:///etc/passwd",
            b"http://[::1",
            b"http://\xff\xfe/",
            b"http://" + b"x" * 5000,
            b"//",
            b"http://a..b/",
        )
    },
}


@pytest.mark.parametrize("answer", ANSWERS.values(), ids=ANSWERS)
def test_answers_of_a_hostile_site(fetch: Fetch, site: Site, tmp_path: Path, answer: bytes) -> None:
    def send(request: Request, _: bytes) -> None:
        request.wfile.write(answer)

    site.misbehaves("35.asf", *[send] * 99)  # more than the redirections that are followed: some lead back here
    with pytest.raises(SsmailError) as caught:
        fetch(attempts=2)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) <= 300
    assert list((tmp_path / "cache" / "35").iterdir()) == []


def test_temporary_files_of_killed_downloads_are_deleted_after_a_day(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    folder = tmp_path / "cache" / "35"
    folder.mkdir(parents=True)
    for name in ("tmpabcd_123", "tmpabcd_124", "tmpother"):
        (folder / name).write_text("half")
        if name != "tmpabcd_124":
            os.utime(folder / name, (0, 0))
    fetch()
    assert sorted(path.name for path in folder.iterdir()) == [*NAMES, "tmpabcd_124", "tmpother"]


def test_a_file_that_was_changed_in_the_cache_is_downloaded_again(fetch: Fetch, site: Site) -> None:
    path = fetch() / "35_01.amc"
    good = path.read_bytes()
    for bad in (good[:-1], good.replace(b"17.9", b"18.0", 1)):
        path.write_bytes(bad)
        assert_whole(fetch(), site)
    assert site.names()[3:] == ["35_01.amc"] * 2


@pytest.mark.skipif(not CMU, reason="SSMAIL_CMU_DIR does not name a folder with CMU's subject 35")
def test_the_known_digests_are_those_of_the_real_files() -> None:
    folder = Path(str(CMU))
    found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("35*.a[sm][fc]")}
    assert found == download.SHA256
    assert len(found) == 24


@pytest.mark.parametrize(
    ("name", "body", "fault"),
    [
        ("36.asf", PAGE, "is a web page or another file"),
        ("36_01.amc", b"\n\n  <HTML>gone</HTML>", "is a web page or another file"),
        ("36_01.amc", b'{"error": "quota"}', "is a web page or another file"),
        ("36_01.amc", b"", "is empty"),
    ],
)
def test_status_200_with_something_else(fetch: Fetch, site: Site, name: str, body: bytes, fault: str) -> None:
    """Of a subject whose digests nobody knows."""
    site.files |= {"/subjects/36/36.asf": SKELETON, "/subjects/36/36_01.amc": MOTION}
    site.script[f"/subjects/36/{name}"] = [status(200, body)]
    with pytest.raises(
        SsmailError, match=rf"{name} {fault}.*; run the same command again later, or read a loc"
    ) as caught:
        fetch([1], subject=36)
    assert "\n" not in str(caught.value)
    assert site.names().count(name) == 1
    folder = fetch([1], subject=36)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {"36.asf": SKELETON, "36_01.amc": MOTION}


def test_no_length_no_file(fetch: Fetch, site: Site, tmp_path: Path) -> None:
    site.misbehaves("35_01.amc", site_that.without_length)
    with pytest.raises(SsmailError, match=r"35_01\.amc comes without its length"):
        fetch()
    assert not (tmp_path / "cache/35/35_01.amc").exists()


def test_chunks_tell_their_end(fetch: Fetch, site: Site) -> None:
    site.misbehaves("35_01.amc", site_that.in_chunks(b""), site_that.in_chunks(b"0\r\n\r\n"))
    assert_whole(fetch(), site)
    assert site.names().count("35_01.amc") == 2


def test_a_file_without_end_is_given_up(fetch: Fetch, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LARGEST, ".amc", 2000)
    with pytest.raises(SsmailError, match=r"35_01\.amc is larger than"):
        fetch()
    assert [path.name for path in (tmp_path / "cache/35").iterdir()] == ["35.asf"]


def test_a_silent_server(fetch: Fetch, site: Site, released: threading.Event) -> None:
    site.misbehaves("35.asf", site_that.silent(released))
    site.misbehaves("35_01.amc", site_that.silent(released, after=1000))
    assert_whole(fetch(timeout_seconds=0.3), site)
    site.misbehaves("36.asf", *[site_that.silent(released)] * 3)
    site.script["/subjects/36/36.asf"] = [site_that.silent(released)]
    with pytest.raises(SsmailError, match=r"36\.asf could not be downloaded: nothing came for 0\.3 s; run"):
        fetch([1], subject=36, timeout_seconds=0.3, attempts=1)


def test_nobody_at_home(fetch: Fetch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "BASE_URL", "http://127.0.0.1:9")
    with pytest.raises(
        SsmailError, match=r"the site cannot be reached; run the same .* copy of the files with --source$"
    ):
        fetch()


def test_redirections_are_followed(fetch: Fetch, site: Site) -> None:
    site.files["/moved/35_01.amc"] = site.files["/subjects/35/35_01.amc"]
    site.misbehaves("35_01.amc", status(301, b"", Location="/moved/35_01.amc"))
    assert_whole(fetch(), site)
    assert [path for path, _ in site.asked].count("/moved/35_01.amc") == 1
    (fetch() / "35_02.amc").unlink()
    site.misbehaves("35_02.amc", *[status(301, b"", Location="/subjects/35/35_02.amc")] * 99)
    with pytest.raises(SsmailError, match="could not be downloaded: it redirects without end"):
        fetch(attempts=1)


def test_numbers_are_written_as_the_site_does(fetch: Fetch, site: Site) -> None:
    site.files |= {"/subjects/07/07.asf": SKELETON, "/subjects/07/07_10.amc": MOTION}
    folder = fetch([10], subject=7)
    assert folder.name == "07"
    assert site.names() == ["07.asf", "07_10.amc"]


def test_an_unusable_cache(fetch: Fetch, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("")
    with pytest.raises(InputError, match=r"cannot use the cache .*; choose another --cache"):
        fetch()


def test_ctrl_c_leaves_no_half_written_file(
    fetch: Fetch, site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(response: Any, size: int) -> Iterator[bytes]:
        yield SKELETON[:10]
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("requests.Response.iter_content", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fetch()
    assert list((tmp_path / "cache/35").iterdir()) == []
    assert_whole(fetch(), site)


def _fetch_slowly(cache: Path) -> None:
    download.fetch(35, [1, 2], cache, pause_seconds=0, timeout_seconds=5, report=lambda _: None)


def test_sigkill_at_any_moment_leaves_nothing_half_written(
    site: Site, fetch: Fetch, tmp_path: Path, released: threading.Event
) -> None:
    site.misbehaves("35_01.amc", site_that.silent(released, after=1000))
    process = multiprocessing.get_context("fork").Process(target=_fetch_slowly, args=(tmp_path / "cache",))
    process.start()
    assert site.asked_for("35_01.amc", within=10)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    folder = tmp_path / "cache/35"
    assert not (folder / "35_01.amc").exists()
    fetch()
    for name in NAMES:
        assert (folder / name).read_bytes() == site.files[f"/subjects/35/{name}"]
