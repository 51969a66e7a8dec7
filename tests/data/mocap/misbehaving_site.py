"""A web site on this machine that serves a subject, and misbehaves as told."""

import hashlib
import json
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from ssmail.data.mocap.cache import RECORD

NAMES = ("35.asf", "35_01.amc", "35_02.amc")
FRAMES = "".join(f"{frame}\r\nroot {frame}.5 17.9 -21 0 -8 -7\r\n" for frame in range(1, 200)).encode()
SKELETON = b"# AST/ASF file\r\n:version 1.10\r\n:name VICON\r\n"
MOTION = b"#!OML:ASF\r\n:FULLY-SPECIFIED\r\n:DEGREES\r\n" + FRAMES
PAGE = b"<!DOCTYPE html>\n<html><body>404 Not Found</body></html>\n"

Fetch = Callable[..., Path]
Answer = Callable[["Request", bytes], None]


class Site:
    """`files` by path; `script` by path: how the next requests are answered, well when nothing is left."""

    def __init__(self, address: str) -> None:
        self.url = f"{address}/subjects"
        self.files = {"/subjects/35/35.asf": SKELETON}
        self.files |= {f"/subjects/35/35_0{trial}.amc": MOTION + b"%d\r\n" % (200 + trial) for trial in (1, 2)}
        self.script: dict[str, list[Answer]] = {}
        self.asked: list[tuple[str, Message]] = []
        self.open_now = self.most_open = 0
        self.lock = threading.Lock()

    def misbehaves(self, name: str, *answers: Answer) -> None:
        self.script[f"/subjects/35/{name}"] = list(answers)

    def names(self) -> list[str]:
        return [path.rpartition("/")[2] for path, _ in self.asked]

    def headers(self, header: str) -> list[str | None]:
        return [headers.get(header) for _, headers in self.asked]


class Request(BaseHTTPRequestHandler):
    site: Site

    def do_GET(self) -> None:
        with self.site.lock:
            self.site.asked.append((self.path, self.headers))
            self.site.open_now += 1
            self.site.most_open = max(self.site.most_open, self.site.open_now)
        left = self.site.script.get(self.path, [])
        try:
            (left.pop(0) if left else well)(self, self.site.files.get(self.path, b""))
        finally:
            with self.site.lock:
                self.site.open_now -= 1

    def answer(self, status: int, body: bytes, *, length: int | None = None, **headers: str) -> None:
        """`length` is what is announced, that of the body by default, nothing when negative."""
        self.send_response(status)
        if length is None or length >= 0:
            self.send_header("Content-Length", str(len(body) if length is None else length))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@contextmanager
def serving() -> Iterator[Site]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (Request,), {}))
    server.daemon_threads = True
    site = Site(f"http://127.0.0.1:{server.server_port}")
    server.RequestHandlerClass.site = site  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def assert_whole(folder: Path, site: Site) -> None:
    """Each file as served, nothing else but the record, and the record right."""
    assert sorted(path.name for path in folder.iterdir()) == [*NAMES, RECORD]
    record = json.loads((folder / RECORD).read_text())
    assert record["partial"] == {}
    for name in NAMES:
        served = site.files[f"/subjects/35/{name}"]
        assert (folder / name).read_bytes() == served
        assert record["whole"][name]["sha256"] == hashlib.sha256(served).hexdigest()
        assert record["whole"][name]["size"] == len(served)


def tag(body: bytes) -> str:
    return f'"{len(body)}-{sum(body)}"'


def well(request: Request, body: bytes) -> None:
    """As RFC 9110 has it."""
    if not body:
        request.answer(404, PAGE)
        return
    asked = re.fullmatch(r"bytes=(\d+)-", request.headers.get("Range", ""))
    if asked and request.headers.get("If-Range") in (tag(body), DATE):
        first = int(asked[1])
        if first >= len(body):
            request.answer(416, b"", Content_Range=f"bytes */{len(body)}")
            return
        span = f"bytes {first}-{len(body) - 1}/{len(body)}"
        request.answer(206, body[first:], ETag=tag(body), Content_Range=span)
        return
    request.answer(200, body, ETag=tag(body))


DATE = "Sat, 21 Feb 2004 10:00:00 GMT"


def cut(after: int, **headers: str) -> Answer:
    """The whole length is announced, the connection ends after so many bytes."""

    def answer(request: Request, body: bytes) -> None:
        request.answer(200, body[:after], length=len(body), **(headers or {"ETag": tag(body)}))

    return answer


def status(code: int, body: bytes = PAGE, **headers: str) -> Answer:
    return lambda request, _: request.answer(code, body, **headers)


def without_ranges(request: Request, body: bytes) -> None:
    request.answer(200, body, ETag=tag(body))


def without_length(request: Request, body: bytes) -> None:
    request.answer(200, body[:-10], length=-1)


def in_chunks(end: bytes) -> Answer:
    """Chunked transfer, whole if `end` is the last chunk (0)."""

    def answer(request: Request, body: bytes) -> None:
        request.protocol_version = "HTTP/1.1"
        request.answer(200, b"%x\r\n%b\r\n%b" % (len(body), body, end), length=-1, Transfer_Encoding="chunked")
        request.close_connection = True

    return answer


def range_of(first: int, size: int) -> Answer:
    """A 206 with the rest from `first` of a file said to have `size` bytes, whatever was asked for."""

    def answer(request: Request, body: bytes) -> None:
        request.answer(206, body[first:], Content_Range=f"bytes {first}-{size - 1}/{size}")

    return answer


def silent(released: threading.Event, after: int = 0) -> Answer:
    """So many bytes, and then nothing until the test is over."""

    def answer(request: Request, body: bytes) -> None:
        if after:
            request.answer(200, body[:after], length=len(body), ETag=tag(body))
            request.wfile.flush()
        released.wait(10)

    return answer


def trickling(released: threading.Event) -> Answer:
    """A byte now and then."""

    def answer(request: Request, body: bytes) -> None:
        request.answer(200, b"", length=len(body), ETag=tag(body))
        for byte in body:
            if released.wait(0.01):
                return
            request.wfile.write(bytes([byte]))

    return answer
