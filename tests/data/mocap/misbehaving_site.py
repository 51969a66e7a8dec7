"""A web site on this machine that serves a subject, and misbehaves as told."""

import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

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

    def asked_for(self, name: str, within: float) -> bool:
        """Whether a file is asked for in so many seconds."""
        deadline = time.monotonic() + within
        while name not in self.names() and time.monotonic() < deadline:
            threading.Event().wait(0.005)  # time.sleep is patched
        return name in self.names()

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
    """Each file as served, and nothing else."""
    assert sorted(path.name for path in folder.iterdir()) == list(NAMES)
    for name in NAMES:
        assert (folder / name).read_bytes() == site.files[f"/subjects/35/{name}"]


def digests(site: Site) -> dict[str, str]:
    """The SHA-256 of every file that the site serves well, by name."""
    return {path.rpartition("/")[2]: hashlib.sha256(body).hexdigest() for path, body in site.files.items()}


def well(request: Request, body: bytes) -> None:
    request.answer(200 if body else 404, body or PAGE)


def cut(after: int) -> Answer:
    """The whole length is announced, the connection ends after so many bytes."""
    return lambda request, body: request.answer(200, body[:after], length=len(body))


def status(code: int, body: bytes = PAGE, **headers: str) -> Answer:
    return lambda request, _: request.answer(code, body, **headers)


def without_length(request: Request, body: bytes) -> None:
    request.answer(200, body[:-10], length=-1)


def in_chunks(end: bytes) -> Answer:
    """Chunked transfer, whole if `end` is the last chunk (0)."""

    def answer(request: Request, body: bytes) -> None:
        request.protocol_version = "HTTP/1.1"
        request.answer(200, b"%x\r\n%b\r\n%b" % (len(body), body, end), length=-1, Transfer_Encoding="chunked")
        request.close_connection = True

    return answer


def silent(released: threading.Event, after: int = 0) -> Answer:
    """So many bytes, and then nothing until the test is over."""

    def answer(request: Request, body: bytes) -> None:
        if after:
            request.answer(200, body[:after], length=len(body))
            request.wfile.flush()
        released.wait(10)

    return answer
