"""Which commit a run says it was computed with."""

import subprocess
from pathlib import Path

from ssmail.store import run_metadata


def test_the_commit_is_that_of_an_ssmail_checkout(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org", "-c", "commit.gpgsign=false"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    assert run_metadata.git_state(tmp_path) == (None, None)
    git("init")
    code = tmp_path / "src" / "ssmail" / "spec.py"
    code.parent.mkdir(parents=True)
    code.write_text("a = 1\n")
    (tmp_path / "experiments.yaml").write_text("")
    (tmp_path / "cli").mkdir()
    assert run_metadata.git_state(tmp_path) == (None, None)  # no commit yet
    git("add", ".")
    git("commit", "-m", "first")
    commit = git("rev-parse", "HEAD")
    assert run_metadata.git_state(tmp_path) == (commit, False)
    (tmp_path / "notes.txt").write_text("not code")
    assert run_metadata.git_state(tmp_path) == (commit, False)
    (tmp_path / "src" / "ssmail" / "new.py").write_text("")
    assert run_metadata.git_state(tmp_path) == (commit, True)


def test_another_repository_around_an_installed_ssmail_is_not_its_checkout(tmp_path: Path) -> None:
    subprocess.run(["git", "init", str(tmp_path)], check=True, capture_output=True)
    (tmp_path / "lib" / "ssmail").mkdir(parents=True)
    assert run_metadata.git_state(tmp_path) == (None, None)
    assert run_metadata.git_state(tmp_path / "lib") == (None, None)
