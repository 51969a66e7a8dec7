"""Subjects of the CMU motion capture database, fetched from its own site into a cache.

The site asks not to be crawled: there is one connection at a time and a pause between files, and a file that is in the
cache is not asked for again. A file that stopped arriving is resumed by an HTTP range (RFC 9110, section 14), provided
that the server can tell (If-Range) that it is still the same file.
"""

import http.client
import re
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ssmail import __version__
from ssmail.data.mocap.cache import Cache, Partial, open_cache
from ssmail.data.mocap.source import LARGEST
from ssmail.errors import InputError, SsmailError

BASE_URL = "http://mocap.cs.cmu.edu/subjects"
LICENCE = (
    "The CMU Graphics Lab Motion Capture Database is free for all uses, but may not be resold, even in converted form.",
    'It asks for this acknowledgement: "The data used in this project was obtained from mocap.cs.cmu.edu. '
    'The database was created with funding from NSF EIA-0196217."',
)
PASSING = frozenset({408, 429, 500, 502, 503, 504})  # answers that may be better a little later
PATIENCE = 120.0  # the longest that a server's Retry-After is obeyed, in seconds
SLOWEST = 20.0  # one request may take so many timeouts, however the bytes trickle
AGAIN = "the same command goes on from here"

Report = Callable[[str], None]


class AbsentError(InputError):
    """The site has no such file."""


class _RequestError(Exception):
    """A request failed in a way that another may not.

    wait: seconds that the server asks for. restart: whether what has arrived so far is of no use.
    """

    def __init__(self, why: str, *, wait: float = 0.0, restart: bool = False) -> None:
        super().__init__(why)
        self.wait, self.restart = wait, restart


@dataclass(frozen=True)
class _Site:
    """Where files come from and how politely they are asked for; times in seconds."""

    base_url: str
    timeout: float
    attempts: int
    backoff: float
    report: Report


def fetch(
    subject: int | str,
    trials: Sequence[int | str],
    cache: Path,
    *,
    allow_missing: bool = False,
    base_url: str | None = None,
    pause_seconds: float = 1.5,
    backoff_seconds: float = 2.0,
    timeout_seconds: float = 30.0,
    attempts: int = 5,
    report: Report | None = None,
) -> Path:
    """The folder `cache`/SUBJECT, holding SUBJECT.asf and SUBJECT_TRIAL.amc of all the trials, each whole.

    Numbers are those of the site: subject 35, trials 1 or "01". What is missing is downloaded from
    `base_url`/SUBJECT/ (BASE_URL by default), with `pause_seconds` between files; a request that fails is repeated up
    to `attempts` times, after `backoff_seconds`, then twice that, and so on. `report` gets the licence and the
    progress, line by line; standard error by default. Interrupted at any moment, the next call goes on where this one
    stopped.

    Raises InputError for a subject or, unless `allow_missing`, a trial that the site does not have, and for a cache
    that cannot be used or was changed; SsmailError when the site cannot be reached, sends something else than the
    file, or another file than on an earlier visit.
    """
    base_url = base_url or BASE_URL
    if not re.fullmatch(r"https?://[^\s/?#]+[^\s?#]*", base_url):
        raise InputError(f"'{base_url}' is no address to download from; it must begin with http:// or https://")
    site = _Site(base_url.rstrip("/"), timeout_seconds, attempts, backoff_seconds, report or _to_stderr)
    who = _number(subject, "subject")
    names = [f"{who}.asf", *dict.fromkeys(f"{who}_{_number(trial, 'trial')}.amc" for trial in trials)]
    for line in LICENCE:
        site.report(line)
    with open_cache(cache / who) as folder:
        missing = [name for name in names if not folder.holds(name)]
        if len(missing) < len(names):
            site.report(f"{len(names) - len(missing)} of {len(names)} files are in {folder.folder} already")
        for count, name in enumerate(missing, start=1):
            if count > 1:
                time.sleep(pause_seconds)
            try:
                size = _download(site, folder, name, f"{site.base_url}/{who}/{name}")
            except AbsentError:
                if not allow_missing or name == names[0]:
                    raise
                site.report(f"{name}: not there [{count}/{len(missing)}]")
            else:
                site.report(f"{name}: {size / 1000:.0f} kB [{count}/{len(missing)}]")
        return folder.folder


def fault(name: str, contents: bytes) -> str | None:
    """What betrays that `contents` is not the .asf or .amc file of this name; None if nothing does.

    Only the first lines are read: comments, then `:version` in a skeleton, and a keyword such as `:FULLY-SPECIFIED` or
    the number of a frame in a motion.
    """
    lines = (line.strip() for line in contents.splitlines())
    first = next((line for line in lines if line and not line.startswith(b"#")), b"").split(maxsplit=1)[:1]
    word = first[0].lower() if first else b""
    if not word:
        return "is empty"
    if b"\0" in contents:
        return "is not text"
    if word.startswith(b"<"):
        return "is a web page"
    if name.endswith(".asf"):
        return None if word == b":version" else "is no skeleton (:version is missing)"
    is_motion = word.isdigit() or (word.startswith(b":") and word != b":version")
    return None if is_motion else "is no motion (neither a keyword nor the number of a frame comes first)"


def _number(value: int | str, what: str) -> str:
    """1 or "01" -> "01", as the site's files are named."""
    if not re.fullmatch(r"[0-9]{1,3}", str(value)) or int(value) == 0:
        raise InputError(f"'{value}' is no {what} of the CMU database; give a number such as 35")
    return f"{int(value):02d}"


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr)


def _download(site: _Site, cache: Cache, name: str, url: str) -> int:
    """Bring one file into the cache, in as many requests as it takes; return its size in bytes."""
    for attempt in range(1, site.attempts + 1):
        try:
            _request(site, cache, name, url)
            break
        except _RequestError as failure:
            if failure.restart:
                cache.discard(name)
            wait = max(site.backoff * 2 ** (attempt - 1), failure.wait)
            if attempt == site.attempts or failure.wait > PATIENCE:
                raise SsmailError(f"{url} could not be downloaded: {failure}; later {AGAIN}") from None
            site.report(f"{name}: {failure}; trying again in {wait:g} s")
            time.sleep(wait)
    size, wrong = cache.arrived(name), fault(name, cache.part(name).read_bytes())
    if wrong:
        cache.discard(name)
        raise SsmailError(f"what {url} gives {wrong}; look at it in a browser, and once it is right {AGAIN}")
    cache.finish(name, url)
    return size


def _request(site: _Site, cache: Cache, name: str, url: str) -> None:
    """One request, after which the part holds the whole file. Raises _RequestError where another request may help."""
    partial, have = cache.resumable(name, url), cache.arrived(name)
    if partial and have == partial.size:
        return
    headers = {"User-Agent": f"ssmail/{__version__}", "Accept-Encoding": "identity"}
    if partial and partial.validator:
        headers |= {"Range": f"bytes={have}-", "If-Range": partial.validator}
    with _answer(urllib.request.Request(url, headers=headers), site.timeout) as response:
        if partial and response.status == 206:
            size: int | None = _resumed_size(response, have, partial)
        elif response.status == 200:
            size = _announced_size(response, url)
            cache.begin(name, Partial(url=url, size=size, validator=_validator(response)))
        else:
            raise SsmailError(f"{url} could not be downloaded: the server answered {response.status}")
        with cache.part(name).open("ab") as file:
            for chunk in _chunks(response, site.timeout):
                file.write(chunk)
                if file.tell() > LARGEST[name[-4:]]:
                    raise SsmailError(f"{url} is larger than any such file of the database; look at it in a browser")
    have = cache.arrived(name)
    if size is not None and have != size:
        raise _RequestError(f"the connection was cut after {have} of {size} bytes", restart=have > size)


@contextmanager
def _answer(request: urllib.request.Request, timeout: float) -> Iterator[http.client.HTTPResponse]:
    """The server's answer, redirections followed. Raises what `_refusal` and `_broken` say when there is none."""
    try:
        response = urllib.request.urlopen(request, timeout=timeout)
    except urllib.error.HTTPError as error:
        with error:
            raise _refusal(request.full_url, error) from None
    except (OSError, http.client.HTTPException) as error:
        raise _broken(error, timeout) from None
    with response:
        yield response


def _refusal(url: str, error: urllib.error.HTTPError) -> Exception:
    """What an answer other than the file means."""
    answer = f"the server answered {error.code}"
    if error.code in (404, 410):
        return AbsentError(f"there is no {url} ({answer}); check the numbers of the subject and of its trials")
    if error.code == 416:
        return _RequestError(f"{answer}: it has fewer bytes than came before", restart=True)
    if error.code in PASSING:
        wait = error.headers.get("Retry-After", "")
        return _RequestError(answer, wait=float(wait) if re.fullmatch("[0-9]{1,9}", wait) else 0.0)
    return SsmailError(f"{url} could not be downloaded: {answer}; look at it in a browser")


def _broken(error: Exception, timeout: float) -> _RequestError:
    """What an error of the network means."""
    reason = error.reason if isinstance(error, urllib.error.URLError) else error
    if isinstance(reason, TimeoutError):
        return _RequestError(f"nothing came for {timeout:g} s")
    if isinstance(reason, ConnectionResetError | http.client.IncompleteRead):
        return _RequestError("the connection was cut")
    return _RequestError(f"the site cannot be reached ({getattr(reason, 'strerror', None) or reason})")


def _chunks(response: http.client.HTTPResponse, timeout: float) -> Iterator[bytes]:
    """The body as it comes. Raises _RequestError when nothing comes for `timeout`, or not all within SLOWEST of it."""
    give_up_at = time.monotonic() + SLOWEST * timeout
    while True:
        try:
            chunk = response.read1(1 << 16)
        except (OSError, http.client.HTTPException) as error:
            raise _broken(error, timeout) from None
        if not chunk:
            return
        yield chunk
        if time.monotonic() > give_up_at:
            raise _RequestError(f"it did not come within {SLOWEST * timeout:g} s")


def _announced_size(response: http.client.HTTPResponse, url: str) -> int | None:
    """Bytes of a file that comes from its beginning; None when it comes in chunks, which show their end."""
    if response.length is None and not response.chunked:
        raise SsmailError(f"the server does not say how long {url} is, so a cut connection could not be noticed")
    return response.length


def _resumed_size(response: http.client.HTTPResponse, have: int, partial: Partial) -> int:
    """Bytes of the whole file of which the rest comes. Raises _RequestError unless it is the rest, of that file."""
    found = re.fullmatch(r"bytes (\d+)-(\d+)/(\d+)", response.headers.get("Content-Range", ""))
    if found:
        first, last, size = map(int, found.groups())
        if first == have and last == size - 1 and partial.size in (None, size):
            return size
    raise _RequestError("the server sent another part than the one asked for", restart=True)


def _validator(response: http.client.HTTPResponse) -> str | None:
    """What If-Range may hold for this file: a strong ETag, else the date of its last change."""
    tag = response.headers.get("ETag", "")
    return tag if tag.startswith('"') else response.headers.get("Last-Modified")
