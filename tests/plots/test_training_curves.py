"""`ssmail plot training`: how runs are grouped and never mixed, unknown names, divergence, and what is drawn."""

import sqlite3
import xml.etree.ElementTree as ElementTree
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ssmail.errors import InputError, printable
from ssmail.evaluation.statistics import Statistic
from ssmail.plots import provenance
from ssmail.plots.saving import save_figure
from ssmail.plots.training_curves import collect, draw
from ssmail.store import RunState, Store

ERROR, LOSS = "train/mode_mse", "actor/loss"


def groups(store: Store, group_by: str = "method", metric: str = ERROR) -> dict[str, list[str]]:
    (panel,) = collect(store, store.runs(), [metric], group_by).panels
    return {band.label: [curve.run_id for curve in band.curves] for band in panel.bands}


def test_runs_are_grouped_by_method_seed_or_any_key(store: Store, add_run: Any) -> None:
    a, b = add_run(0), add_run(1)
    assert groups(store) == {"ssail": [a, b]}
    assert groups(store, "seed") == {"seed 0": [a], "seed 1": [b]}
    c = add_run(0, overrides=["curriculum.beta=0.5"])
    default = f"beta {store.runs()[0].spec['curriculum']['beta']:g}"
    assert groups(store, "curriculum.beta") == {default: [a, b], "beta 0.5": [c]}
    d = add_run(0, method="bc")
    assert groups(store, "curriculum.beta")["no beta"] == [d]


def test_runs_of_different_specs_are_never_averaged(store: Store, add_run: Any) -> None:
    a = add_run(0)
    b = add_run(0, overrides=["curriculum.beta=0.5"])
    default = f"{store.runs()[0].spec['curriculum']['beta']:g}"
    assert groups(store) == {f"ssail, beta {default}": [a], "ssail, beta 0.5": [b]}
    c = add_run(0, method="wail")
    assert [len(runs) for runs in groups(store, "seed").values()] == [1, 1, 1]
    d = add_run(0, overrides=["curriculum.beta=0.5", "sac.gamma=0.5", "adversarial.input_noise=0.2"])
    specs = {run.id: f"ssail, spec {run.spec_hash[:8]}" for run in store.runs()}
    assert groups(store) == {specs[a]: [a], specs[b]: [b], specs[d]: [d], "wail": [c]}


def test_methods_tell_the_parts_of_a_seed_apart(store: Store, add_run: Any) -> None:
    a, b = add_run(0), add_run(0, method="wail")
    assert groups(store, "seed") == {"seed 0, ssail": [a], "seed 0, wail": [b]}


def test_the_newest_run_of_a_cell_that_has_the_metric_is_drawn(store: Store, add_run: Any) -> None:
    add_run(0)
    newest = add_run(0, [0.5])
    add_run(0, [], RunState.RUNNING)
    assert groups(store) == {"ssail": [newest]}
    notes = collect(store, store.runs(), [ERROR]).notes
    assert notes == (f"{ERROR}: 1 of the chosen runs have none.", "1 older run of the same spec and seed left out.")


def test_a_compact_database_says_that_it_kept_one_value(store: Store, add_run: Any) -> None:
    add_run(0, [0.3, 0.2, 0.1])
    add_run(1, [0.3, 0.2, 0.1])
    (whole,) = collect(store, store.runs()[:1], [LOSS]).notes or ("",)
    assert "compact" not in whole
    with closing(sqlite3.connect(store.where)) as connection, connection:
        connection.execute("DELETE FROM metric WHERE name = ? AND step < 3", (LOSS,))
    note = f"{LOSS}: of 2 runs the last value alone is stored, for {store.where} is compact: it keeps the curves that "
    assert collect(store, store.runs(), [ERROR, LOSS]).notes == (f"{note}figures and claims read.",)
    with closing(sqlite3.connect(store.where)) as connection, connection:
        row = (store.runs()[0].id, "last", "x/last.pt", "0" * 64, 1)
        connection.execute("INSERT INTO artifact (run_id, name, path, sha256, size_bytes) VALUES (?, ?, ?, ?, ?)", row)
    assert f"{LOSS}: of 1 run the last value" in collect(store, store.runs(), [LOSS]).notes[0]  # a checkpoint is there


def test_a_diverged_run_is_the_worst_in_errors_and_unknown_in_anything_else(store: Store, add_run: Any) -> None:
    for seed in range(2):
        add_run(seed, [0.1, 0.1, 0.1])
    lost = add_run(2, [0.3], RunState.DIVERGED)
    record = collect(store, store.runs(), [ERROR, LOSS, "test/on_lane"], statistic=Statistic.MEDIAN_IQR)
    error, loss, final = (panel.bands[0] for panel in record.panels)
    np.testing.assert_allclose(error.summary.centre, [0.1, 0.1, 0.1])
    np.testing.assert_allclose(loss.summary.centre, [-1, np.nan, np.nan])
    np.testing.assert_allclose(final.summary.centre, [np.nan])
    assert [band.curves[2].diverged_at for band in (error, loss, final)] == [2, 2, 2]
    figure = draw(record)
    crosses = [[line for line in axes.lines if line.get_gid() == f"diverged-{lost}"] for axes in figure.axes]
    assert [len(found) for found in crosses] == [1, 1, 0]
    assert crosses[0][0].get_ydata()[0] == figure.axes[0].get_ylim()[1]
    assert crosses[1][0].get_ydata()[0] == -1
    assert figure.legends[0].get_texts()[0].get_text() == "ssail: 3 runs, 1 diverged (x)"


def test_a_value_that_is_not_finite_is_no_divergence_of_a_finished_run(store: Store, add_run: Any) -> None:
    add_run(0, epochs={"lag": [0.1, np.nan, 0.2]})
    (panel,) = collect(store, store.runs(), ["lag"]).panels
    assert panel.bands[0].diverged == 0
    np.testing.assert_array_equal(panel.bands[0].summary.centre, [0.1, np.nan, 0.2])


@pytest.mark.parametrize(
    ("metric", "nearest"),
    [("mode_mse", "test_constant_velocity/mode_mse, train/mode_mse"), ("train/mode_msi", "train/mode_mse")],
)
def test_an_unknown_metric_names_the_nearest(store: Store, add_run: Any, metric: str, nearest: str) -> None:
    add_run(0)
    with pytest.raises(InputError) as unknown:
        collect(store, store.runs(), [ERROR, metric])
    sentence = str(unknown.value)
    assert sentence.startswith(f"none of the chosen runs has a metric '{metric}'; the nearest stored are {nearest}")


def test_unknown_keys_and_silent_runs_are_refused(store: Store, add_run: Any) -> None:
    add_run(0, [], RunState.RUNNING)
    with pytest.raises(InputError, match="none of the 1 chosen runs has recorded a metric yet"):
        collect(store, store.runs(), [ERROR])
    add_run(1)
    with pytest.raises(InputError, match=r"unknown key to group by 'curriculum\.bta'; did you mean curriculum\.beta\?"):
        collect(store, store.runs(), [ERROR], "curriculum.bta")
    add_run(2, dataset_hash="e" * 64)
    with pytest.raises(InputError, match="would mix runs on different data"):
        collect(store, store.runs(), [ERROR])


def test_the_scale_suits_the_values(store: Store, add_run: Any) -> None:
    add_run(0, [1.0, 0.1, 0.01], epochs={"some/share": [0.5, 0.6, 0.7], "constant": [2.0] * 3})
    names = [ERROR, LOSS, "some/share", "constant"]
    axes = draw(collect(store, store.runs(), names)).axes
    assert [panel.get_yscale() for panel in axes] == ["log", "linear", "linear", "linear"]
    assert [panel.get_ylabel() for panel in axes] == [f"{ERROR}\n(squared scaled units)", *names[1:]]
    for panel, value in zip(axes, (0.1, -1.0, 0.6, 2.0), strict=True):
        low, high = panel.get_ylim()
        assert low < value < high
    assert axes[-1].get_xlabel() == "epoch"


def test_files_carry_their_runs_and_the_csv_is_what_is_drawn(store: Store, add_run: Any, tmp_path: Path) -> None:
    runs = [add_run(0), add_run(1, [0.4, 0.2]), add_run(0, method="gail")]
    record = collect(store, store.runs(), [ERROR, LOSS])
    figure = draw(record)
    image, table = save_figure(record.stem, record, figure, tmp_path, ["svg"])
    assert image.name == "training_train-mode_mse_actor-loss.svg"
    assert sorted(provenance.read(image).run_ids) == sorted(runs)
    csv = pd.read_csv(table)
    for axes, metric in zip(figure.axes, (ERROR, LOSS), strict=True):
        rows = csv[csv["metric"] == metric]
        drawn = {str(line.get_gid()): line for line in axes.lines if line.get_gid()}
        for kind, name in (("run", "run_id"), ("mean", "label")):
            for value, points in rows[rows["kind"] == kind].groupby(name):
                line = drawn.pop(f"{'run' if kind == 'run' else 'centre'}-{value}")
                np.testing.assert_array_equal(line.get_xdata(), points["epoch"])
                np.testing.assert_array_equal(line.get_ydata(), points["value"])
        assert drawn == {}


def test_many_groups_have_legible_legends_beside_the_curves(store: Store, add_run: Any) -> None:
    for beta in (0.01, 0.03, 0.06, 0.11, 0.21, 0.31, 0.41, 0.51):
        add_run(0, overrides=[f"curriculum.beta={beta}"])
    figure = draw(collect(store, store.runs(), [ERROR], "curriculum.beta"))
    (axes,), (legend,) = figure.axes, figure.legends
    figure.canvas.draw()
    box = legend.get_window_extent()
    assert not box.overlaps(axes.get_window_extent())
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width
    assert axes.get_window_extent().height > 80
    means = [line for line in axes.lines if str(line.get_gid()).startswith("centre")]
    assert len({line.get_color() for line in means}) == 8


@pytest.mark.parametrize(
    "method",
    ["$x$", "$\\nosuch{$", "a $ b $ c", "_hid", "two\nlines\x1b[2J\u202e", "<b>&]]>-->", "x" * 5000, "日本"],
)
def test_a_stored_method_is_drawn_as_it_is(
    method: str, store: Store, add_run: Any, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """Neither as mathematics, which may not parse, nor left out of the legend; the files stay readable."""
    add_run(0)
    with closing(sqlite3.connect(store.where)) as connection, connection:
        connection.execute("UPDATE run SET method = ?1, spec_json = json_set(spec_json, '$.method', ?1)", (method,))
    record = collect(store, store.runs(), [ERROR])
    figure = draw(record)
    (text, *_) = (item.get_text() for item in figure.legends[0].get_texts())
    assert text.lstrip().replace(r"\$", "$").startswith(printable(method)[:40])
    svg, csv = save_figure(record.stem, record, figure, tmp_path, ["svg"])
    assert not recwarn.list
    ElementTree.parse(svg)
    assert all(character.isprintable() or character == "\n" for character in csv.read_text())
    assert printable(method).replace('"', '""') in csv.read_text()
