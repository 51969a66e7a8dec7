"""Saved figures: run ids in every format, equal bytes for equal runs, sentences for what cannot be done."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from html import unescape
from pathlib import Path
from typing import Any

import matplotlib
import pypdf
import pytest
from PIL import Image

import ssmail
from ssmail.errors import InputError
from ssmail.paper.results import FIGURES
from ssmail.plots import provenance, saving
from ssmail.store import RunState, Store
from tests.paper.figure_files import save

NAMES = ("fig3", "fig4", "fig5", "fig6", "fig7", "fig8", "fig9")
FORMATS = {name: provenance.FORMATS if name == "fig4" else ("svg",) for name in NAMES}  # all of each would take minutes


@pytest.fixture
def filled(store: Store, add_run: Any) -> Store:
    add_run(0)
    add_run(1, [0.06, 0.03, 0.02], shift=0.1)
    add_run(2, [0.5], RunState.DIVERGED)
    return store


@pytest.fixture
def whole(filled: Store, ablate: Any, add_forecast: Any, vary_alpha: Any) -> Store:
    """With runs for the other figures too."""
    vary_alpha({(0, 1): [0.01, None], (-1, 1): [0.003, 0.002]})
    add_forecast(0, 0.001, "dnri")
    ablate("curriculum", {"teacher-forcing": [0.04, 0.03], "trajectory-forcing": [0.02, None]})
    return filled


def saved(store: Store, name: str, outdir: Path, formats: Sequence[str] = provenance.FORMATS) -> list[Path]:
    record = FIGURES[name].collect(store)
    return save(name, record, FIGURES[name].draw(record), outdir, formats)


@pytest.mark.parametrize("name", NAMES)
def test_each_format_gives_its_provenance_back(whole: Store, tmp_path: Path, name: str) -> None:
    record = FIGURES[name].collect(whole)
    expected = saving.embedded(record, saving.csv_text(record.table()))
    assert expected.caption == record.caption
    assert record.caption.endswith(".")
    assert 100 < len(record.caption) < 700
    *images, csv = saved(whole, name, tmp_path, FORMATS[name])
    stem = FIGURES[name].stem
    assert [path.name for path in images] == [f"{stem}.{format}" for format in FORMATS[name]]
    assert csv.name == f"{stem}.csv"
    assert [provenance.read(path) for path in images] == [expected] * len(images)


def test_the_caption_is_where_other_programs_look_for_it(filled: Store, tmp_path: Path) -> None:
    png, pdf, svg, _ = saved(filled, "fig4", tmp_path)
    caption = FIGURES["fig4"].collect(filled).caption
    assert "(3 of ssail, of which 1 diverged)" in caption
    assert Image.open(png).info["Description"] == caption
    assert pypdf.PdfReader(pdf).metadata["/Subject"] == caption
    assert f"ssmail fig4: {caption}" in unescape(svg.read_text())


def test_provenance_names_runs_specs_data_and_code(filled: Store) -> None:
    runs = filled.runs()
    found = FIGURES["fig4"].collect(filled).provenance
    assert found.figure == "fig4"
    assert found.run_ids == tuple(run.id for run in runs)
    assert found.spec_hashes == (runs[0].spec_hash,)
    assert found.dataset_hashes == ("d" * 64,)
    (code,) = found.code
    assert code.startswith(ssmail.__version__)
    assert (runs[0].git_commit or "") in code
    assert code.endswith("-dirty") is bool(runs[0].git_dirty)
    assert found.drawn_with == ssmail.__version__


def test_other_readers_find_it_and_no_date(filled: Store, tmp_path: Path) -> None:
    png, pdf, svg, _ = saved(filled, "fig4", tmp_path)
    record = FIGURES["fig4"].collect(filled)
    text = saving.embedded(record, saving.csv_text(record.table())).as_json()
    with Image.open(png) as image:
        assert image.info["ssmail"] == text
        assert image.size[0] == pytest.approx(3.4 * 300)
    information = pypdf.PdfReader(pdf).metadata
    assert information is not None
    assert information["/Keywords"] == text
    assert not {"/CreationDate", "/ModDate"} & set(information)
    assert "<dc:date>" not in svg.read_text()


@pytest.mark.parametrize("awkward", ["plain", "(brackets)", "back\\slash", 'a "quoted" <tag> & é', "line\nbreak", ")"])
def test_any_text_survives_every_format(filled: Store, tmp_path: Path, awkward: str) -> None:
    record = FIGURES["fig9"].collect(filled)
    odd = provenance.Provenance("fig9", (awkward,), (), (), (awkward,), "0")
    figure = FIGURES["fig9"].draw(record)
    for format in provenance.FORMATS:
        path = tmp_path / f"odd.{format}"
        figure.savefig(path, metadata=odd.metadata(format))
        assert provenance.read(path) == odd


DRAW = """
import json
import sys
from pathlib import Path
from ssmail.paper.results import FIGURES
from ssmail.plots.saving import save_figure
from ssmail.store import Store
store = Store.open(sys.argv[1])
for name, formats in json.loads(sys.argv[3]).items():
    record = FIGURES[name].collect(store)
    save_figure(FIGURES[name].stem, record, FIGURES[name].draw(record), Path(sys.argv[2]), formats)
assert "matplotlib.pyplot" not in sys.modules, "a figure must not touch pyplot's global state"
"""


def test_equal_runs_give_equal_bytes_in_any_process(whole: Store, tmp_path: Path) -> None:
    here = [path for name in NAMES for path in saved(whole, name, tmp_path / "here", FORMATS[name])]
    environment = {**os.environ, "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo", "SOURCE_DATE_EPOCH": "1"}
    command = [sys.executable, "-c", DRAW, whole.url, str(tmp_path / "there"), json.dumps(FORMATS)]
    subprocess.run(command, env=environment, check=True)
    assert len(here) == 4 + 2 * (len(NAMES) - 1)
    for path in here:
        assert path.read_bytes() == (tmp_path / "there" / path.name).read_bytes(), path.name


def test_a_changed_value_changes_every_file(filled: Store, add_run: Any, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in saved(filled, "fig4", tmp_path / "before", ["png"])}
    add_run(1, [0.06, 0.03, 0.03])
    after = {path.name: path.read_bytes() for path in saved(filled, "fig4", tmp_path / "after", ["png"])}
    assert before.keys() == after.keys()
    assert all(before[name] != after[name] for name in before)


def test_the_users_matplotlib_settings_neither_matter_nor_change(filled: Store, tmp_path: Path) -> None:
    plain = saved(filled, "fig4", tmp_path / "plain", ["svg"])
    with matplotlib.rc_context({"lines.linewidth": 9.0, "axes.facecolor": "red", "svg.hashsalt": "mine"}):
        mine = dict(matplotlib.rcParams)
        odd = saved(filled, "fig4", tmp_path / "odd", ["svg"])
        assert dict(matplotlib.rcParams) == mine
    assert [path.read_bytes() for path in odd] == [path.read_bytes() for path in plain]


def test_what_cannot_be_saved_is_said(filled: Store, tmp_path: Path) -> None:
    record = FIGURES["fig9"].collect(filled)
    figure = FIGURES["fig9"].draw(record)
    with pytest.raises(InputError, match=r"^unknown figure format 'jpg'; choose from png, pdf, svg\.$"):
        save("fig9", record, figure, tmp_path / "new", ["png", "jpg"])
    assert not (tmp_path / "new").exists()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file cannot be written: .*; choose another folder\.$"):
        save("fig9", record, figure, tmp_path / "file", ["png"])


def test_what_cannot_be_read_is_said(filled: Store, tmp_path: Path) -> None:
    figure = FIGURES["fig9"].draw(FIGURES["fig9"].collect(filled))
    for format in provenance.FORMATS:
        foreign, broken = tmp_path / f"foreign.{format}", tmp_path / f"broken.{format}"
        figure.savefig(foreign)  # without metadata
        broken.write_bytes(b"nothing of the kind")
        for path in (foreign, broken):
            with pytest.raises(
                InputError, match=f"^{path} (carries no run ids of ssmail|is not a whole {format.upper()} image); "
            ):
                provenance.read(path)
        with pytest.raises(InputError, match="cannot be read: No such file"):
            provenance.read(tmp_path / f"missing.{format}")
    with pytest.raises(InputError, match=r"is no figure of ssmail; give a file that ends in .*, \.svg or \.gif\.$"):
        provenance.read(tmp_path / "figure.jpg")
