"""`ssmail prep-mocap`."""

import json
import os
import resource
import signal
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssmail.data import expert_sets
from ssmail.data.mocap import download
from ssmail.errors import InputError
from tests.cli.command_line import CommandLine
from tests.data.mocap import misbehaving_site
from tests.data.mocap.handmade import amc, write_subject

SMALL = ("--train", "1-2", "--val", "3", "--test", "4")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_subject(tmp_path / "subject", {1: 101, 2: 151, 3: 60, 4: 110})


def test_a_set_is_written_and_told_of(cli: CommandLine, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "set.npz"
    outcome = cli("prep-mocap", "--source", folder, "--out", out, *SMALL)
    experts = expert_sets.load(out, "mocap")
    assert (outcome.code, outcome.err) == (0, "")
    first, positions, velocities = outcome.out.splitlines()
    wrote = f"wrote {out}: 5/1/1 training/validation/test windows of 5 joints, hash {experts.hash[:16]}"
    assert first == wrote
    scaling = experts.scaling
    assert positions == f"training positions from {scaling.position_min:#.6g} to {scaling.position_max:#.6g}"
    assert velocities == f"training velocities from {scaling.velocity_min:#.6g} to {scaling.velocity_max:#.6g}"


def test_json_for_programs(cli: CommandLine, folder: Path, tmp_path: Path) -> None:
    (folder / "35_02.amc").unlink()
    out = tmp_path / "set.npz"
    outcome = cli("prep-mocap", "--source", folder, "--out", out, *SMALL, "--allow-missing", "--json")
    told, experts = json.loads(outcome.out), expert_sets.load(out)
    assert told["path"] == str(out)
    assert told["hash"] == experts.hash
    assert told["windows"] == {"train": 2, "validation": 1, "test": 1}
    assert told["scaling"]["positions"] == [experts.scaling.position_min, experts.scaling.position_max]
    assert told["joints"] == list(experts.joints)
    assert told["missing"] == [2]
    assert told["parameters"] == experts.parameters
    assert told["sources"] == experts.sources
    assert outcome.err == "trials that do not exist and are not in the set: 02\n"


def test_another_subject_in_a_zip_file(cli: CommandLine, tmp_path: Path) -> None:
    folder = write_subject(tmp_path / "subject", {1: 51, 2: 51, 3: 101}, subject=7)
    with zipfile.ZipFile(tmp_path / "cmu.zip", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, f"subjects/07/{file.name}")
    options = ("--train", "1", "--validation", "2", "--test", "3", "--out", tmp_path / "set.npz")
    assert cli("prep-mocap", "--subject", 7, "--source", tmp_path / "cmu.zip", *options).code == 0
    assert expert_sets.load(tmp_path / "set.npz").parameters["subject"] == 7


def test_a_file_is_overwritten_only_with_force(cli: CommandLine, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "set.npz"
    prepare = ("prep-mocap", "--source", folder, "--out", out, *SMALL)
    assert cli(*prepare).code == 0
    before = out.read_bytes()
    (folder / "35_02.amc").unlink()
    assert cli(*prepare).sentence.startswith(f"{out} exists already")
    assert "lacks 35_02.amc" in cli(*prepare, "--force").sentence
    assert out.read_bytes() == before
    assert cli(*prepare, "--force", "--allow-missing").code == 0
    assert out.read_bytes() != before


BROKEN = {
    "cut": (lambda text: text[:3000], "35_02.amc, line "),
    "nan": (lambda text: text.replace(b"lfoot ", b"lfoot nan #", 1), "35_02.amc, line 7: 'nan' is not a finite number"),
    "another skeleton": (lambda text: text.replace(b"spine", b"back"), "35_02.amc, line 5: the skeleton has no joint"),
    "binary": (lambda text: bytes(range(256)) * 9, "35_02.amc, line 1: this is not text"),
    "empty": (lambda text: b"", "35_02.amc is empty"),
    "one long line": (lambda text: text + b"1 " * 10**6, "35_02.amc, line 758: the line has 2,000,000 characters"),
    "too short": (lambda text: amc({"root": (0,) * 6, "spine": (0,) * 3, "lleg": (0, 0), "lfoot": (0,)}), "too few"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_file(cli: CommandLine, folder: Path, tmp_path: Path, fault: str) -> None:
    breaks, complaint = BROKEN[fault]
    file = folder / "35_02.amc"
    file.write_bytes(breaks(file.read_bytes()))
    sentence = cli("prep-mocap", "--source", folder, "--out", tmp_path / "new" / "set.npz", *SMALL).sentence
    assert complaint in sentence
    assert str(folder) in sentence
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("", "give either --source with a folder or zip file of the CMU files, or --download"),
        ("--source . --download", "give either --source"),
        ("--source . --cache c", "--cache belongs to --download; leave --cache out, or let --download fetch the files"),
        ("--cache c", "--cache belongs to --download"),
        ("--source absent", "there is no absent; --source takes a folder or a zip file"),
        ("--source . --subject 35", "holds no 35.asf, the skeleton of subject 35; add it"),
        ("--source . --subject 0", "'--subject'"),
        ("--source . --train 12-01", "the range 12-01 in --train runs backwards"),
        ("--source . --val x", "--validation takes trials such as 01-12 or 1-3,7, not 'x'"),
        ("--source . --test 1", "trial 01 is in train and in test; name each trial once"),
    ],
)
def test_bad_input(
    cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert sentence in cli("prep-mocap", *options.split()).sentence
    assert not list(tmp_path.iterdir())


def test_an_unwritable_place(cli: CommandLine, folder: Path) -> None:
    outcome = cli("prep-mocap", "--source", folder, "--out", "/proc/none/set.npz", *SMALL)
    assert outcome.sentence.startswith("cannot write /proc/none/set.npz")


def test_what_a_killed_one_left_behind_is_gone_after_the_next(cli: CommandLine, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out" / "set.npz"
    child = os.fork()
    if child == 0:
        Path.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[method-assign, assignment]
        cli("prep-mocap", "--source", folder, "--out", out, *SMALL)
    assert os.WIFSIGNALED(os.waitpid(child, 0)[1])
    assert [path.name.startswith(".set.npz.") for path in out.parent.iterdir()] == [True]
    assert cli("prep-mocap", "--source", folder, "--out", out, *SMALL).code == 0
    assert list(out.parent.iterdir()) == [out]


def test_a_full_disk(cli: CommandLine, folder: Path, tmp_path: Path) -> None:
    """Which has room for 10 kB."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        outcome = cli("prep-mocap", "--source", folder, "--out", tmp_path / "out" / "set.npz", *SMALL)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert outcome.sentence == f"cannot write {tmp_path}/out/set.npz: File too large; choose a writable --out"
    assert list((tmp_path / "out").iterdir()) == []


def test_downloaded_files_are_a_source(
    cli: CommandLine, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(download.time, "sleep", lambda _: None)
    out = tmp_path / "set.npz"
    options = ("prep-mocap", "--download", "--cache", tmp_path / "cache", "--out", out, *SMALL)
    with misbehaving_site.serving() as site:
        monkeypatch.setattr(download, "BASE_URL", site.url)
        site.files = {f"/subjects/35/{file.name}": file.read_bytes() for file in folder.iterdir()}
        monkeypatch.setattr(download, "SHA256", misbehaving_site.digests(site))
        outcome = cli(*options)
        assert (outcome.code, len(site.asked)) == (0, 5)
        assert "may not be resold" in outcome.err
        assert expert_sets.load(out).hash == prepared_hash(cli, folder, tmp_path)
        assert cli(*options).sentence.endswith("overwrite it with --force")
        assert len(site.asked) == 5, "the site is asked only when the set may be written"
        del site.files["/subjects/35/35_02.amc"]
        elsewhere = (*options, "--cache", tmp_path / "empty", "--force")
        assert "35_02.amc (the server answered 404)" in cli(*elsewhere).err
        assert cli(*elsewhere, "--allow-missing").code == 0
        assert expert_sets.load(out).parameters["missing"] == [2]


def prepared_hash(cli: CommandLine, folder: Path, tmp_path: Path) -> str:
    cli("prep-mocap", "--source", folder, "--out", tmp_path / "given.npz", *SMALL)
    return expert_sets.load(tmp_path / "given.npz").hash


def test_a_download_that_fails(cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fetch(subject: int, trials: Any, cache: Path, **_: Any) -> Path:
        raise InputError(f"there is no such file in {cache}")

    monkeypatch.setattr(download, "fetch", fetch)
    sentence = cli("prep-mocap", "--download", "--out", tmp_path / "set.npz").sentence
    assert sentence == "there is no such file in data/cmu"
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif("SSMAIL_CMU_DIR" not in os.environ, reason="SSMAIL_CMU_DIR does not name a folder with subject 35")
def test_the_real_data(cli: CommandLine, tmp_path: Path) -> None:
    before = os.times()
    outcome = cli("prep-mocap", "--source", os.environ["SSMAIL_CMU_DIR"], "--out", tmp_path / "set.npz")
    after = os.times()
    first, positions, velocities = outcome.out.splitlines()
    assert ": 92/33/27 training/validation/test windows of 31 joints" in first
    assert positions == "training positions from -35.1817 to 58.2083"
    assert velocities == "training velocities from -1.69260 to 2.17829"
    assert after.user + after.system - before.user - before.system < 5  # seconds of work
    assert np.load(tmp_path / "set.npz")["train/positions"].shape == (92, 50, 31, 3)
