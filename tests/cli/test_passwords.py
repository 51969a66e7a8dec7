"""No command shows the password of a database URL, and no file that it writes holds it."""

from pathlib import Path

import pytest
from sqlalchemy import make_url

from ssmail.store import Store
from ssmail.store.connection import name_of
from ssmail_cli import options, plot
from tests.cli.command_line import CommandLine
from tests.store.databases import add

URLS = ("postgresql://me:SECRET@host/name", "postgresql://host/name?user=me&password=SECRET")
COMMANDS = (
    ("runs", "list", "--method", "nosuch"),
    ("runs", "list"),
    ("runs", "show", "zz"),
    ("runs", "compare", "--metric", "nosuch"),
    ("report", "--out", "figures"),
    ("plot", "training", "--metric", "validation/mode_mse", "--out", "figures"),
    ("plot", "training", "--method", "bc", "--out", "figures"),
    ("plot", "fig4", "--out", "figures"),
    ("plot", "fig9", "--out", "figures"),
    ("claims", "--json"),
    ("db", "info"),
    ("db", "merge", "other.db"),
    ("runs", "list", "--help"),
)


@pytest.fixture
def server(db: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The environment names a database on a server, whose place a file takes: there is no server here."""
    store = Store.open(db)
    add(store)
    monkeypatch.setattr(options, "open_store", lambda _: store)
    monkeypatch.setattr(plot, "open_store", lambda _: store)
    return str(db)


@pytest.mark.parametrize("url", URLS)
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_password_is_nowhere(
    url: str, command: tuple[str, ...], server: str, cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = options.open_store(server)
    monkeypatch.setattr(store, "where", name_of(make_url(url)))
    monkeypatch.setattr(store, "url", url)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SSMAIL_DB", url)
    outcome = cli(*command)
    assert "SECRET" not in outcome.out + outcome.err
    assert "unexpected" not in outcome.err
    for path in tmp_path.rglob("*"):
        if path.is_file():
            assert b"SECRET" not in path.read_bytes(), path


def test_the_command_in_a_report_names_the_database_without_its_password(
    server: str, cli: CommandLine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli("report", "--out", "figures", "--db", URLS[0]).code == 3
    assert "`ssmail report --db 'postgresql://me:***@host/name'`" in (tmp_path / "report.md").read_text()
