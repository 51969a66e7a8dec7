"""docs/cluster.md is true: the recipe with PostgreSQL runs as it stands there, on a server that is thrown away.

`smaller` makes it small, and names that server. Commands of the administrator are done by the server's own user.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ssmail.store import Store
from tests.store.postgres_server import PASSWORD, Server

RECIPE = "A few desktops with PostgreSQL"
TEXT = (Path(__file__).parents[2] / "docs" / "cluster.md").read_text("utf-8")
(SECTION,) = re.findall(rf"^## {RECIPE}\n(.*?)(?=^## |\Z)", TEXT, re.DOTALL | re.MULTILINE)
COMMANDS = "".join(re.findall(r"```sh\n(.*?)```", SECTION, re.DOTALL))
SUDO = """#!/bin/sh
export PGHOST={folder} PGUSER=ssmail PGPASSWORD={password} PGDATABASE=postgres
case "$1" in
    apt-get) exit 0 ;;
    systemctl) exec psql -qtAc 'SELECT pg_reload_conf()' ;;
    -u) shift 2 ;;
esac
exec "$@"
"""


@pytest.fixture
def own_server() -> Iterator[Server]:
    running = Server()
    yield running
    running.close()


def smaller(commands: str, server: Server) -> str:
    changes = (
        ("@server.example/ssmail?", f"@/ssmail?host={server.folder}&"),
        ("--profile quick", "--profile smoke"),
        ("--seeds 0-4", "--seeds 0"),
        ("--seeds 0-9", "--seeds 0"),
        ("--idle-exit 600", "--idle-exit 0"),
    )
    for was, now in changes:
        assert was in commands
        commands = commands.replace(was, now)
    return commands


def write_program(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


@pytest.mark.slow
def test_a_few_desktops_with_postgresql(own_server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for program in ("psql", "createdb", "pg_dump", "pg_restore", "openssl"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed (Debian: apt-get install postgresql-client openssl)")
    programs, folder = tmp_path / "bin", tmp_path / "work"
    programs.mkdir()
    folder.mkdir()
    write_program(programs / "sudo", SUDO.format(folder=own_server.folder, password=PASSWORD))
    write_program(programs / "pip", "#!/bin/sh\n[ \"$*\" = 'install ssmail[postgres]' ]\n")
    write_program(programs / "ssmail", f'#!/bin/sh\nexec {sys.executable} -m ssmail_cli "$@"\n')
    settings = {name: value for name, value in os.environ.items() if not name.startswith(("SSMAIL_", "PG"))}
    settings |= {"PATH": f"{programs}:{os.environ['PATH']}", "PYTHONPATH": os.pathsep.join(sys.path)}
    script = "set -eu -o pipefail\n" + smaller(COMMANDS, own_server)
    done = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=settings, capture_output=True, text=True, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr
    (entry,) = (folder / "lab.pgpass").read_text().splitlines()
    password = entry.rpartition(":")[2]
    assert len(password) == 32
    assert password not in done.stdout + done.stderr
    assert (folder / "lab.pgpass").stat().st_mode & 0o077 == 0
    monkeypatch.chdir(folder)
    store = Store.open(f"postgresql://lab:{password}@/ssmail?host={own_server.folder}")
    assert sorted((run.method, str(run.state)) for run in store.runs()) == [
        (method, "finished") for method in ("gail", "ssail", "wail")
    ]
    store.close()
    assert (folder / "results/figures/fig4_stability.png").exists()
    (dump,) = folder.glob("ssmail-*.dump")
    listed = subprocess.run(["pg_restore", "--list", dump], capture_output=True, text=True, check=True).stdout
    assert "TABLE DATA public run " in listed
    with own_server.connect() as admin:
        rules = admin.execute("SELECT auth_method, address FROM pg_hba_file_rules WHERE user_name = '{lab}'").fetchall()
    assert rules == [("scram-sha-256", "192.168.1.0")]
