"""A saved figure tells its runs, and a database agrees or does not: every figure, format and kind of change."""

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from ssmail.errors import InputError
from ssmail.evaluation.statistics import Statistic
from ssmail.paper.explanation import compare, explain
from ssmail.paper.reads import contents
from ssmail.paper.results import FIGURES
from ssmail.plots import NoRuns, provenance, training_curves
from ssmail.plots.saving import digest, save_figure
from ssmail.store import RunState, Store
from ssmail.store.maintenance.compact import export_compact
from tests.paper.figure_files import save


@pytest.fixture
def filled(store: Store, add_run: Any) -> Store:
    """Two methods, one of them with two seeds, one of which diverged."""
    add_run(0)
    add_run(1, [0.5], RunState.DIVERGED)
    add_run(0, method="dnri", shift=0.1)
    return store


@pytest.fixture
def whole(filled: Store, ablate: Any, add_forecast: Any, vary_alpha: Any) -> Store:
    """With runs for the other figures too."""
    vary_alpha({(0, 1): [0.01, None], (-1, 1): [0.003, 0.002]})
    add_forecast(0, 0.001, "dnri")
    ablate("curriculum", {"teacher-forcing": [0.04, 0.03], "trajectory-forcing": [0.02, None]})
    ablate("beta", {0.0: [0.04, 0.03], 0.4: [0.02, 0.01]})
    return filled


def saved(store: Store, name: str, outdir: Path, *formats: str, **options: Any) -> list[Path]:
    record = FIGURES[name].collect(store, **options)
    return save(name, record, FIGURES[name].draw(record), outdir, formats or ("svg",))


def change(store: Store, statement: str, *values: Any) -> None:
    store.close()
    with closing(sqlite3.connect(store.where)) as connection, connection:
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute(statement, values)


def test_every_format_and_the_csv_tell_the_runs_of_each_curve(filled: Store, tmp_path: Path) -> None:
    ours, diverged, theirs = filled.runs()
    paths = saved(filled, "fig5", tmp_path, *provenance.FORMATS)
    assert [path.suffix for path in paths] == [".png", ".pdf", ".svg", ".csv"]
    for path in paths:
        found = explain(path)
        runs = found.provenance.runs
        assert [(run.id, run.curve, run.seed, run.state) for run in runs] == [
            (ours.id, "ssail", 0, "finished"),
            (diverged.id, "ssail", 1, "diverged"),
            (theirs.id, "dnri", 0, "finished"),
        ]
        assert runs[0].spec_hash == ours.spec_hash
        assert runs[0].dataset_hash == "d" * 64
        assert runs[0].code == found.provenance.code[0]
        assert (found.csv, found.csv_state) == (paths[-1], "as written")
        assert found.provenance.csv_sha256 == digest(paths[-1].read_text())


def test_what_differs_among_the_specs_and_what_the_curves_are_called(whole: Store, tmp_path: Path) -> None:
    found = explain(saved(whole, "fig6", tmp_path)[0]).provenance
    assert {"beta 0.0", "beta 0.4"} <= {run.curve for run in found.runs}
    for run in found.runs:
        assert found.differs[run.spec_hash] == {"curriculum.beta": float(run.curve.split()[1])}


@pytest.mark.parametrize("name", sorted({module.name for module in FIGURES.values()}))
def test_the_database_agrees_with_each_figure_as_long_as_nothing_changes(
    name: str, whole: Store, tmp_path: Path
) -> None:
    try:
        image, csv = saved(whole, name, tmp_path)
    except NoRuns:
        pytest.skip(f"the handmade database has no runs for {name}")
    before = compare(explain(image), whole)
    assert (before.agrees, before.values, before.reason) == (True, "same", None)
    assert set(before.runs.values()) == {"same"}
    for table in ("metric", "metric_latest"):
        change(whole, f"UPDATE {table} SET value = value * 1.001")
    change(whole, "DELETE FROM array WHERE name LIKE 'test%/mse'")
    after = compare(explain(image), whole)
    if name in ("fig5", "fig7", "fig9"):  # drawn from arrays alone: fig7 cannot be collected, the others are untouched
        assert after.agrees is (None if name == "fig7" else True)
    else:
        assert (after.agrees, after.values) == (False, "different")
        assert str(after.reason).startswith("line ")
        assert f" of {csv.name} was " in str(after.reason)


@pytest.mark.parametrize("statistic", list(Statistic))
def test_figures_are_collected_again_with_their_own_options(
    statistic: Statistic, whole: Store, vary_alpha: Any, tmp_path: Path
) -> None:
    image, _ = saved(whole, "fig4", tmp_path, statistic=statistic)
    assert explain(image).provenance.options == {"statistic": statistic.value}
    assert compare(explain(image), whole).agrees is True
    vary_alpha({(0, 1): [0.01], (-1, 1): [0.003]}, "yjunction")
    image, _ = saved(whole, "fig8", tmp_path, statistic=statistic, environment="yjunction")
    assert compare(explain(image), whole).agrees is True


def test_training_curves_too(filled: Store, tmp_path: Path) -> None:
    record = training_curves.collect(
        filled, filled.runs(), ["actor/loss", "train/mode_mse"], "seed", Statistic.MEDIAN_IQR
    )
    image, _ = save_figure(record.stem, record, training_curves.draw(record), tmp_path, ["png"])
    found = explain(image)
    assert found.provenance.options == {
        "metrics": ["actor/loss", "train/mode_mse"],
        "group_by": "seed",
        "statistic": "median-iqr",
    }
    assert compare(found, filled).agrees is True
    change(filled, "UPDATE metric SET value = 7 WHERE name = 'actor/loss' AND step = 1")
    assert compare(found, filled).agrees is False


def test_a_compact_export_agrees(filled: Store, tmp_path: Path) -> None:
    image, _ = saved(filled, "fig5", tmp_path)
    runs = filled.runs()
    export_compact(filled.where, tmp_path / "small.db", runs, contents(filled, runs).wanted)
    small = Store.open(tmp_path / "small.db")
    assert compare(explain(image), small).agrees is True
    small.close()


CHANGES: dict[str, tuple[str, str | None, str]] = {
    "deleted": ("DELETE FROM run WHERE seed = 1", None, "missing"),
    "other spec": ("UPDATE run SET spec_hash = '0123456789abcdef' WHERE seed = 1", None, "spec was "),
    "other data": ("UPDATE run SET dataset_hash = 'eee' WHERE seed = 1", None, f"data was {'d' * 64}, is eee"),
    "other end": ("UPDATE run SET state = 'failed' WHERE seed = 1", None, "state was diverged, is failed"),
}


@pytest.mark.parametrize(("statement", "values", "state"), CHANGES.values(), ids=CHANGES)
def test_a_run_that_is_not_what_it_was_is_told(
    statement: str, values: str | None, state: str, filled: Store, tmp_path: Path
) -> None:
    image, _ = saved(filled, "fig4", tmp_path)
    run_id = next(run.id for run in filled.runs() if run.seed == 1)
    change(filled, statement)
    found = compare(explain(image), filled)
    assert found.agrees is False
    assert found.runs.pop(run_id).startswith(state)
    assert set(found.runs.values()) == {"same"}


def test_another_database_holds_none_of_the_runs(filled: Store, tmp_path: Path) -> None:
    image, _ = saved(filled, "fig4", tmp_path)
    other = Store.open(tmp_path / "other.db")
    found = compare(explain(image), other)
    assert (found.agrees, set(found.runs.values())) == (False, {"missing"})
    other.close()


def test_new_runs_change_nothing(filled: Store, add_run: Any, tmp_path: Path) -> None:
    """The figure is of the runs that it shows, whatever the default choice would be now."""
    image, _ = saved(filled, "fig4", tmp_path)
    add_run(0, [0.04, 0.02, 0.02])
    add_run(5, [0.04, 0.02, 0.02])
    assert compare(explain(image), filled).agrees is True


def test_last_digits_may_differ_and_text_may_not(filled: Store, tmp_path: Path) -> None:
    image, _ = saved(filled, "fig4", tmp_path)
    change(filled, "UPDATE metric SET value = value * (1 + 1e-9)")
    nearly = compare(explain(image), filled)
    assert (nearly.agrees, nearly.values, nearly.reason) == (True, "same", "to within 1e-06 of each number")
    change(filled, "UPDATE metric SET value = value * (1 + 1e-5)")
    assert compare(explain(image), filled).agrees is False


def test_the_csv_beside_it(filled: Store, tmp_path: Path) -> None:
    image, csv = saved(filled, "fig4", tmp_path)
    csv.write_text(csv.read_text().replace("0.02", "0.03", 1))
    assert explain(image).csv_state == explain(csv).csv_state == "altered"
    change(filled, "UPDATE metric SET value = 7")
    told = compare(explain(image), filled)
    assert (told.agrees, told.reason) == (None, "its hash differs, and the CSV that was written with it is not there")
    csv.unlink()
    assert explain(image).csv_state == "missing"
    with pytest.raises(InputError, match="cannot be read: there is no such file"):
        explain(csv)
    lonely = tmp_path / "elsewhere" / csv.name
    lonely.parent.mkdir()
    shutil.copy(saved(filled, "fig4", tmp_path)[1], lonely)
    with pytest.raises(InputError, match="has no figure beside it that tells its runs"):
        explain(lonely)


def without(*names: str) -> Callable[[provenance.Provenance], dict[str, Any]]:
    """What an older ssmail wrote."""
    return lambda source: {key: value for key, value in vars(source).items() if key not in names}


def test_figures_of_an_older_ssmail_tell_what_they_know(filled: Store, tmp_path: Path) -> None:
    record = FIGURES["fig9"].collect(filled)
    source = provenance.Provenance(**without("runs", "differs", "options", "csv_sha256")(record.provenance))
    figure = FIGURES["fig9"].draw(record)
    figure.savefig(tmp_path / "old.png", metadata=source.metadata("png"))
    found = explain(tmp_path / "old.png")
    assert (found.provenance, found.csv_state) == (source, None)
    told = compare(found, filled)
    assert (told.agrees, told.values, list(told.runs.values())) == (None, None, ["same"])
    assert "older ssmail" in str(told.reason)


def test_a_figure_without_runs_or_of_an_unknown_name_cannot_be_compared(filled: Store, tmp_path: Path) -> None:
    figure = FIGURES["fig9"].draw(FIGURES["fig9"].collect(filled))
    of_data = provenance.Provenance.of_data("skeleton", "abc")
    unknown = provenance.Provenance("fig99", (filled.runs()[0].id,), (), (), (), "9", csv_sha256="0")
    for name, source, reason in (("data", of_data, "an expert set"), ("new", unknown, "draws no figure fig99")):
        path = tmp_path / f"{name}.svg"
        figure.savefig(path, metadata=source.metadata("svg"))
        told = compare(explain(path), filled)
        assert told.agrees is None
        assert reason in str(told.reason)
