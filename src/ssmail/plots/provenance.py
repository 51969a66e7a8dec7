"""Where a figure comes from, written into its files and read back: PNG text chunk, PDF information, SVG metadata.

The record is one line of JSON under one key of each format: `ssmail` (PNG), `Keywords` (PDF), `dc:description` (SVG); a
film (GIF) has it as its comment. The caption is in the record, and where other programs look for one: `Description`
(PNG), `Subject` (PDF), the title (SVG).
No date is written, so that equal runs give equal files.

Figures come from anywhere, so nothing in one is believed: its size is bounded, it has to be complete, entities in an
SVG are refused, no picture is decoded, and the record is checked key by key.
"""

import io
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self
from xml.parsers import expat

from PIL import Image
from pydantic import TypeAdapter

from ssmail import __version__
from ssmail.config.foreign_files import open_regular, read_whole
from ssmail.errors import InputError
from ssmail.store import RunRow
from ssmail.store.comparison import spec_differences

FORMATS = ("png", "pdf", "svg")

LARGEST = 256 * 2**20  # bytes of a figure
_SVG_DESCRIPTION = "http://purl.org/dc/elements/1.1/ description"


@dataclass(frozen=True)
class RunSource:
    """One run behind a figure, as it was when the figure was drawn."""

    id: str
    curve: str  # what the figure calls the group that the run is drawn in
    method: str
    environment: str
    profile: str
    seed: int
    state: str
    spec_hash: str
    dataset_hash: str | None
    code: str


@dataclass(frozen=True)
class Provenance:
    """The runs behind a figure and the code that computed and drew it. Hashes and versions are distinct and sorted."""

    figure: str
    run_ids: tuple[str, ...]  # full ids, in the order of the record
    spec_hashes: tuple[str, ...]
    dataset_hashes: tuple[str, ...]
    code: tuple[str, ...]  # of the runs: package version, "+", git commit, "-dirty" if the tree was changed
    drawn_with: str  # ssmail's version
    runs: tuple[RunSource, ...] = ()  # in the same order
    differs: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # by spec hash: see spec_differences
    options: Mapping[str, Any] = field(default_factory=dict)  # with which the figure was collected, beside the runs
    csv_sha256: str | None = None  # of the CSV that was written with the figure
    caption: str = ""  # what the figure shows, in a few sentences

    @classmethod
    def of(
        cls,
        figure: str,
        runs: Sequence[RunRow],
        *,
        curves: Mapping[str, str] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Self:
        """Return the provenance of a figure drawn from these runs.

        `curves` names, by run id, the curve that a run is drawn in; without a name it is the run's method. `options`
        are the arguments of `collect` other than the store and the runs, as JSON values.
        """
        curves = curves or {}
        return cls(
            figure=figure,
            run_ids=tuple(run.id for run in runs),
            spec_hashes=_distinct(run.spec_hash for run in runs),
            dataset_hashes=_distinct(run.dataset_hash for run in runs if run.dataset_hash),
            code=_distinct(run.code for run in runs),
            drawn_with=__version__,
            runs=tuple(_source(run, curves.get(run.id, run.method)) for run in runs),
            differs=spec_differences(runs),
            options=dict(options or {}),
        )

    @classmethod
    def of_data(cls, figure: str, dataset_hash: str) -> Self:
        """The provenance of a figure drawn from an expert set, without any run."""
        return cls(figure, (), (), (dataset_hash,), (), __version__)

    def as_json(self) -> str:
        """One line of ASCII."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """The inverse of `as_json`. Raises ValueError on any text that is not of its form."""
        found = TypeAdapter(cls).validate_json(text, strict=True)
        if len({*found.run_ids}) < len(found.run_ids):
            raise ValueError("a run is named twice")
        return found

    def metadata(self, format: str) -> dict[str, Any]:
        """What to pass as `metadata` to `Figure.savefig` for one of FORMATS."""
        title = f"ssmail {self.figure}"
        if format == "png":
            return {"Title": title, "Description": self.caption, "ssmail": self.as_json()}
        if format == "pdf":
            described = {"Title": title, "Subject": self.caption, "Keywords": self.as_json()}
            return {**described, "CreationDate": None, "ModDate": None}
        return {"Title": f"{title}: {self.caption}", "Description": self.as_json(), "Date": None}


def read(path: Path) -> Provenance:
    """The provenance inside a PNG, PDF, SVG or GIF that ssmail saved.

    Raises InputError for a file that cannot be read or that carries none.
    """
    readers = {".png": _png_text, ".pdf": _pdf_text, ".svg": _svg_text, ".gif": _gif_comment}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} is no figure of ssmail; give a file that ends in .png, .pdf, .svg or .gif.")
    try:
        with open_regular(path) as file:
            data = read_whole(file, LARGEST)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None
    if data is None:
        raise InputError(f"{path} has more than {LARGEST >> 20} MB; give a figure that ssmail saved.")
    try:
        return Provenance.from_json(reader(bytes(data)))
    except _DamagedError:
        kind = path.suffix[1:].upper()
        raise InputError(f"{path} is not a whole {kind} image; draw it again with `ssmail plot`.") from None
    except (ValueError, KeyError):
        raise InputError(f"{path} carries no run ids of ssmail; draw it again with `ssmail plot`.") from None


class _DamagedError(Exception):
    """The file is not of the format that its name says, or a part of it is missing or altered."""


def _distinct(values: Any) -> tuple[str, ...]:
    return tuple(sorted(set(values)))


def _source(run: RunRow, curve: str) -> RunSource:
    return RunSource(
        id=run.id,
        curve=curve,
        method=run.method,
        environment=run.environment,
        profile=run.profile,
        seed=run.seed,
        state=run.state.value,
        spec_hash=run.spec_hash,
        dataset_hash=run.dataset_hash,
        code=run.code,
    )


def _png_text(data: bytes) -> str:
    found = _checked(data, "PNG")["ssmail"]  # all chunks have the right checksums; nothing is decoded
    return str(found)


def _gif_comment(data: bytes) -> str:
    if not data.endswith(b";"):
        raise _DamagedError
    comment: bytes = _checked(data, "GIF")["comment"]
    return comment.decode("ascii")


def _checked(data: bytes, format: str) -> dict[Any, Any]:
    """Return the texts in an image, unless it is damaged. Pillow raises errors of many types on crafted files."""
    try:
        with warnings.catch_warnings(), Image.open(io.BytesIO(data), formats=[format]) as image:
            warnings.simplefilter("error")  # of an enormous image
            info = dict(image.info)
            image.verify()
    except Exception:
        raise _DamagedError from None
    return info


def _pdf_text(data: bytes) -> str:
    """The Keywords of the information dictionary, which matplotlib writes uncompressed."""
    if not data.startswith(b"%PDF-") or not data.rstrip().endswith(b"%%EOF"):
        raise _DamagedError
    found = re.search(rb"/Keywords \(((?:[^\\()]|\\.)*)\)", data, re.DOTALL)
    if found is None:
        raise ValueError("no keywords")
    return re.sub(rb"\\(.)", rb"\1", found.group(1)).decode("ascii")


def _svg_text(data: bytes) -> str:
    """The text of the dc:description. No tree is built, and entities are refused, which can expand without end."""
    path: list[str] = []
    texts: list[str] = []

    def refuse(*_: object) -> None:
        raise _DamagedError

    def read(text: str) -> None:
        if path[-1] == _SVG_DESCRIPTION:
            texts.append(text)

    parser = expat.ParserCreate(namespace_separator=" ")
    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = lambda name, _: path.append(name)
    parser.EndElementHandler = lambda _: path.pop()
    parser.CharacterDataHandler = read
    try:
        parser.Parse(data, True)
    except expat.ExpatError:
        raise _DamagedError from None
    return "".join(texts)
