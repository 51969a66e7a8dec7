"""The files to import, and what reads each."""

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from ssmail.config.foreign_files import IrregularFileError, open_regular
from ssmail.data.importing.arrays import read_array
from ssmail.data.importing.rows import RowCollector, Rows, SourceFile, quoted
from ssmail.data.importing.tables import Columns, read_csv, read_parquet
from ssmail.errors import InputError, printable

MOST_FILES = 10_000
LARGE = 5 * 10**7  # bytes; reading such a file takes seconds, and is reported
TABLES = {".csv": read_csv, ".tsv": read_csv, ".txt": read_csv, ".parquet": read_parquet}
ARRAYS = (".npy", ".npz")
SUFFIXES = (*TABLES, *ARRAYS)


def find_files(
    sources: Sequence[Path], report: Callable[[str], None] = lambda _: None, out: Path | None = None
) -> list[SourceFile]:
    """Return the given files, and those with a known suffix anywhere in the given folders, in the order of their names.

    Of a folder, hidden files and folders are left out, and so is `out`, the file to write, which is reported. A file's
    scene is its path without the suffix, from the folder on. Raises InputError if there are no files or too many, or if
    one is missing, of an unknown kind or there twice.
    """
    found: list[SourceFile] = []
    for source in sources:
        if source.is_dir():
            paths = _inside(source)
            if out is not None and out.exists():
                own = [path for path in paths if path.samefile(out)]
                paths = [path for path in paths if path not in own]
                for path in own:
                    report(f"leaving out {quoted(path, 80)}, which is the file to write")
            if not paths:
                raise InputError(f"no file in {quoted(source, 80)} ends in one of {', '.join(SUFFIXES)}; name another")
            found += [SourceFile(path, path.relative_to(source).with_suffix("").as_posix()) for path in paths]
        elif source.suffix.lower() in SUFFIXES:
            found.append(SourceFile(source, source.stem))
        elif not source.exists():
            raise InputError(f"there is no file or folder {quoted(source, 80)}; name another")
        else:
            raise InputError(f"{quoted(source, 80)} ends in none of {', '.join(SUFFIXES)}; save it as one of them")
    if len(found) > MOST_FILES:
        raise InputError(
            f"there are {len(found):,} files, and {MOST_FILES:,} are the most; join them, with a column scene"
        )
    if len({file.scene for file in found}) < len(found):
        found = [SourceFile(file.path, file.path.with_suffix("").as_posix()) for file in found]
    scenes = [file.scene for file in found]
    if len(set(scenes)) < len(scenes):
        twice = next(scene for number, scene in enumerate(scenes) if scene in scenes[:number])
        raise InputError(f"two files are called {quoted(twice, 80)}, apart from their suffix; name each once")
    return found


def _inside(folder: Path) -> list[Path]:
    """Return the files of a folder with a known suffix, at any depth, without the hidden ones."""
    found = (path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    return sorted(path for path in found if not any(part.startswith(".") for part in path.relative_to(folder).parts))


def read_files(
    files: Sequence[SourceFile], columns: Columns, report: Callable[[str], None]
) -> tuple[Rows, dict[str, str]]:
    """Read all files; return their rows, and the SHA-256 of each file.

    Raises InputError that names the file, and the line and column if it is one of them.
    """
    collector, digests = RowCollector(), {}
    for file in files:
        try:
            with open_regular(file.path) as opened:
                if (size := os.fstat(opened.fileno()).st_size) >= LARGE:
                    report(f"reading {file.label}, {size / 1e6:,.0f} MB")
                digests[printable(file.scene + file.path.suffix)] = hashlib.file_digest(opened, "sha256").hexdigest()
            suffix = file.path.suffix.lower()
            if suffix in TABLES:
                TABLES[suffix](file, columns, collector)
            else:
                read_array(file, collector)
        except FileNotFoundError:
            raise InputError(f"there is no file {file.label}; name another") from None
        except IrregularFileError:
            raise InputError(f"{file.label} is a pipe or device; name a file") from None
        except PermissionError as error:
            raise InputError(f"{file.label} cannot be read: {error.strerror}; check its permissions") from None
        except MemoryError:
            raise InputError(f"{file.label} does not fit into memory; import it in parts") from None
    return collector.finish(), digests
