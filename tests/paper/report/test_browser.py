"""The page in headless Chromium: it runs without an error, fetches nothing, and its tables sort."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from tests.paper.report.conftest import Written

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--virtual-time-budget=5000"),
)
ERRORS = "<script>window.errors = []; addEventListener('error', (event) => errors.push(event.message));</script>"
PROBE = """<script>
const shown = (cell) => cell.dataset.value ?? cell.textContent;
const column = (table, index) => [...table.tBodies[0].rows].map((row) => shown(row.cells[index]));
const click = (table, heading) => {
  const index = [...table.tHead.rows[0].cells].findIndex((cell) => cell.textContent === heading);
  table.tHead.rows[0].cells[index].querySelector("button").click();
  return [column(table, index), table.tHead.rows[0].cells[index].ariaSort];
};
const runs = document.querySelector("#runs table"), verdicts = document.querySelector("#verdicts table");
const found = {
  time: click(runs, "time"), again: click(runs, "time"), method: click(runs, "method"),
  seeds: click(verdicts, "more seeds"), claims: click(verdicts, "claim"),
  marked: verdicts.querySelectorAll("[aria-sort]").length,
  pictures: [...document.images].map((image) => image.naturalWidth),
  fetched: performance.getEntriesByType("resource").map((entry) => entry.name).filter((name) => !/^data:/.test(name)),
  paper: getComputedStyle(document.body).backgroundColor,
};
const closed = document.querySelector("#specs details");
found.before = closed.open;
location.hash = closed.id;
setTimeout(() => {
  found.after = closed.open;
  const told = document.createElement("pre");
  told.id = "told";
  told.textContent = JSON.stringify({ ...found, errors });
  document.body.append(told);
}, 1000);
</script>"""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt-get install chromium)")


def seen(html: str, folder: Path, *flags: str) -> dict[str, Any]:
    """What the probe finds in the page."""
    page = folder / "page.html"
    page.write_text(html.replace("<head>", f"<head>{ERRORS}", 1).replace("</body>", f"{PROBE}</body>"))
    command = [str(CHROMIUM), *FLAGS, f"--user-data-dir={folder / 'profile'}", *flags, "--dump-dom", page.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    told = re.search(r'<pre id="told">(.*?)</pre>', shown, re.DOTALL)
    assert told, shown[-2000:]
    found: dict[str, Any] = json.loads(unescape(told[1]))
    return found


def test_the_page_works(written: Written, tmp_path: Path) -> None:
    found = seen(written.html, tmp_path)
    assert found["errors"] == []
    assert found["fetched"] == []
    assert len(found["pictures"]) == 1
    assert found["pictures"][0] > 500
    assert found["paper"] == "rgb(255, 255, 255)"
    times, direction = found["time"]
    assert direction == "ascending"
    assert [float(value) for value in times] == sorted(run.wall_seconds for run in written.report.runs)
    assert found["again"] == [times[::-1], "descending"]
    methods = [run.method for run in written.report.runs]
    assert found["method"] == [sorted(methods), "ascending"]
    needed = {found.claim.name: found.decision.more_seeds for found in written.report.judgements}
    known = sorted(value for value in needed.values() if value is not None)
    assert found["seeds"][0] == [*map(str, known), *[""] * (len(needed) - len(known))]  # what is unknown comes last
    assert found["claims"][0] == [f"C{number}" for number in range(1, 9)]
    assert found["marked"] == 1
    assert (found["before"], found["after"]) == (False, True)


def test_a_page_whose_script_fails_is_caught(written: Written, tmp_path: Path) -> None:
    broken = written.html.replace(
        '"use strict";', '"use strict"; setTimeout(() => { throw new Error("planted"); });', 1
    )
    assert found_errors(seen(broken, tmp_path)) == ["Uncaught Error: planted"]


def found_errors(found: dict[str, Any]) -> list[str]:
    return list(found["errors"])
