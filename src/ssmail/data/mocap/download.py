"""Download of a subject from the CMU motion capture database into a local cache, with pooch.

The site asks not to be crawled, so there is one connection at a time, a pause between files, and no request for a file
that is already in the cache. It speaks plain HTTP only, so anyone on the way could change a file. A file is checked
before it gets its name in the cache: against its SHA-256 where the package knows it (cmu_sha256.txt: the trials of
subject 35 that the paper uses), else against its first bytes, and its SHA-256 is reported.
"""

import re
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import pooch
import requests

from ssmail import __version__
from ssmail.data.atomic_file import PATIENCE
from ssmail.data.mocap.source import LARGEST
from ssmail.errors import InputError, SsmailError

BASE_URL = "http://mocap.cs.cmu.edu/subjects"
LICENCE = (
    "The CMU Graphics Lab Motion Capture Database is free for all uses, but may not be resold, even in converted form.",
    'It asks for this acknowledgement: "The data used in this project was obtained from mocap.cs.cmu.edu. '
    'The database was created with funding from NSF EIA-0196217."',
)
SHA256 = dict(line.split() for line in Path(__file__).with_name("cmu_sha256.txt").read_text("ascii").splitlines())
TRANSIENT = frozenset({408, 429, 500, 502, 503, 504})  # HTTP statuses after which another attempt may succeed
BEGINNING = re.compile(rb"\s*[#:0-9]")  # a skeleton or a motion begins with a comment, a keyword or a frame number
REMEDY = "run the same command again later, or read a local copy of the files with --source"


class AbsentError(InputError):
    """The site has no such file."""


def fetch(
    subject: int,
    trials: Sequence[int],
    cache: Path,
    *,
    allow_missing: bool = False,
    pause_seconds: float = 1.5,
    timeout_seconds: float = 30.0,
    attempts: int = 4,
    report: Callable[[str], None] | None = None,
) -> Path:
    """Return the folder `cache`/SUBJECT, which holds SUBJECT.asf and SUBJECT_TRIAL.amc of all the trials.

    Files that the cache lacks, or whose SHA-256 is wrong, are downloaded from BASE_URL/SUBJECT/. `report` gets the
    licence and the progress, line by line; by default they go to standard error. If the download is interrupted, the
    next call fetches only the files that are still missing.

    Raises InputError if the site lacks the subject or (without `allow_missing`) a trial, or if the cache cannot be
    used; SsmailError if the site cannot be reached or does not send the expected file.
    """
    report = report or partial(print, file=sys.stderr)
    names = [f"{subject:02d}.asf", *dict.fromkeys(f"{subject:02d}_{trial:02d}.amc" for trial in trials)]
    folder = cache / f"{subject:02d}"
    for line in LICENCE:
        report(line)
    site = pooch.create(
        path=folder,
        base_url=f"{BASE_URL}/{subject:02d}/",
        registry={name: SHA256.get(name) for name in names},
        retry_if_failed=attempts - 1,  # pooch waits 1 s before the second attempt, 2 s before the third, ...
    )
    pooch.get_logger().setLevel("WARNING")  # pooch's progress would repeat what `report` gets
    _delete_leftovers(folder)
    missing = [name for name in names if not _is_cached(folder / name)]
    if len(missing) < len(names):
        report(f"{len(names) - len(missing)} of {len(names)} files are in {folder} already")
    for count, name in enumerate(missing, start=1):
        if count > 1:
            time.sleep(pause_seconds)
        try:
            path = _fetch_file(site, name, timeout_seconds)
        except AbsentError:
            if not allow_missing or name == names[0]:
                raise
            report(f"{name}: not there [{count}/{len(missing)}]")
        else:
            digest = "" if name in SHA256 else f", SHA-256 {pooch.file_hash(path)}"
            report(f"{name}: {path.stat().st_size / 1000:.0f} kB{digest} [{count}/{len(missing)}]")
    return folder


def _delete_leftovers(folder: Path) -> None:
    """Delete the temporary files of pooch that killed downloads left behind."""
    for path in folder.glob("tmp????????"):
        with suppress(OSError):
            if time.time() - path.lstat().st_mtime > PATIENCE:
                path.unlink()


def _is_cached(path: Path) -> bool:
    known = SHA256.get(path.name)
    return path.is_file() and (known is None or pooch.file_hash(path) == known)


def _fetch_file(site: pooch.Pooch, name: str, timeout: float) -> Path:
    """Download one file into the cache. Every failure becomes one sentence that names the remedy."""
    url = site.get_url(name)
    try:
        return Path(site.fetch(name, downloader=partial(_stream, timeout=timeout)))
    except requests.RequestException as error:
        raise SsmailError(f"{url} could not be downloaded: {_reason(error, timeout)}; {REMEDY}") from None
    except ValueError:  # the last attempt brought a file with another digest
        raise SsmailError(
            f"{url} is not the file that ssmail knows (its SHA-256 differs) and was deleted; {REMEDY}"
        ) from None
    except OSError as error:
        raise InputError(
            f"cannot use the cache {site.path}: {error.strerror or error}; choose another --cache"
        ) from None


def _stream(url: str, output: str, _: pooch.Pooch, *, timeout: float) -> None:
    """Write the file at `url` to `output`; a downloader for pooch.

    Raises requests.RequestException where pooch should try again, and SsmailError where that would not help.
    """
    headers = {"User-Agent": f"ssmail/{__version__}", "Accept-Encoding": "identity"}
    with requests.get(url, headers=headers, stream=True, timeout=timeout) as response:
        status, path, largest = response.status_code, Path(output), LARGEST[url[-4:]]
        if status in (404, 410):
            raise AbsentError(f"there is no {url} (the server answered {status}); check the subject and its trials")
        if status in TRANSIENT and "Retry-After" not in response.headers:
            response.raise_for_status()
        if status != 200:
            raise SsmailError(f"{url} could not be downloaded: the server answered {status}; {REMEDY}")
        if "Transfer-Encoding" not in response.headers and not response.headers.get("Content-Length", "").isdecimal():
            raise SsmailError(f"{url} comes without its length, so a cut connection would not be noticed; {REMEDY}")
        if response.headers.get("Content-Encoding", "identity") != "identity":
            raise SsmailError(f"{url} comes compressed, which nobody asked for; {REMEDY}")
        with path.open("wb") as file:
            for chunk in response.iter_content(2**16):
                if not file.tell() and not BEGINNING.match(chunk):
                    raise SsmailError(f"{url} is a web page or another file, not motion capture data; {REMEDY}")
                file.write(chunk)
                if file.tell() > largest:
                    raise SsmailError(f"{url} is larger than any such file of the database; {REMEDY}")
        if not path.stat().st_size:
            raise SsmailError(f"{url} is empty; {REMEDY}")


def _reason(error: requests.RequestException, timeout: float) -> str:
    if isinstance(error, requests.HTTPError) and error.response is not None:
        return f"the server answered {error.response.status_code}"
    if isinstance(error, requests.TooManyRedirects):
        return "it redirects without end"
    if isinstance(error, requests.Timeout):
        return f"nothing came for {timeout:g} s"
    if isinstance(error, requests.ConnectionError):
        return "the site cannot be reached"
    return "the connection was cut"
