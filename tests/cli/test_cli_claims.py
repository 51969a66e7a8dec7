"""`ssmail claims`: verdicts as text, CSV and JSON."""

import json
from pathlib import Path

import pytest

from ssmail.config.experiments import ablation_specs
from ssmail.store import RunState, Store
from tests.cli.command_line import CommandLine

ERRORS = {
    0.0: (0.020, 0.024, 0.028, 0.032, 0.036),
    0.15: (0.0020, 0.0021, 0.0022, 0.0023, 0.0024),
    1.0: (0.020, 0.025, 0.030, 0.035, 0.040),
}


@pytest.fixture
def beta(db: Path) -> Path:
    """A database in which C3 is true and nothing else can be told."""
    store = Store.open(db)
    specs = ablation_specs("beta", "smoke", values=list(ERRORS))
    for value, errors in ERRORS.items():
        for seed, error in enumerate(errors):
            writer = store.start_run(specs[value], seed, dataset_hash="d" * 64, device="cpu")
            writer.epoch(1, {"train/mode_mse": error})
            writer.final(1, {"test/mode_mse": error, "test_last/mode_mse": error})
            writer.finish(RunState.FINISHED)
    store.close()
    return db


def test_json_has_everything(cli: CommandLine, beta: Path) -> None:
    found = cli("claims", "--json", "--only", "C3,alpha", "--db", beta)
    assert (found.code, found.err) == (0, "")
    claim, alpha = json.loads(found.out)
    assert (alpha["claim"], alpha["verdict"], alpha["runs"]) == ("C5", "inconclusive", [])
    assert alpha["command"] == "ssmail reproduce --only fig8 --profile quick --seeds 0-4"
    assert (claim["verdict"], claim["corrected_verdict"], claim["section"]) == ("supported", "inconclusive", "4.5")
    assert claim["p_holm"] == pytest.approx(8 * claim["p"])
    assert len(claim["runs"]) == 15
    lower = claim["parts"][0]
    assert lower["p_for"] == pytest.approx(1 / 252)
    assert lower["low"] < lower["effect"] < lower["high"]
    assert lower["samples"][0]["values"] == list(ERRORS[0.15])
    assert lower["samples"][0]["seeds"] == [0, 1, 2, 3, 4]


def test_csv_has_a_row_for_each_part(cli: CommandLine, beta: Path) -> None:
    found = cli("claims", "--db", beta)
    assert found.code == 0
    assert [row["claim"] for row in found.rows] == [
        c for c, n in zip("12345678", (4, 4, 6, 4, 2, 2, 2, 2), strict=True) for c in [f"C{c}"] * n
    ]
    supported = [row for row in found.rows if row["verdict"] == "supported"]
    assert {row["claim"] for row in supported} == {"C3"}
    assert {row["claim_verdict"] for row in supported} == {"supported"}
    assert {row["beside"] for row in found.rows} == {"False"}
    assert json.loads(supported[0]["samples"])[1]["label"] == "beta 0"
    assert "C3: missing of curriculum.beta" in found.err


def test_the_text_is_a_table_of_verdicts(cli: CommandLine, beta: Path) -> None:
    found = cli("claims", "--format", "table", "--db", beta)
    lines = found.out.splitlines()
    assert [line.split()[0] for line in lines[1:9]] == [f"C{number}" for number in range(1, 9)]
    assert " ".join(lines[1].split()) == "C1 stability smoke inconclusive 1 inconclusive 1 runs missing"
    assert "seed by seed" not in found.out
    assert f"`ssmail claims C4 --db {beta}` shows what" in " ".join(found.out.split())
    assert found.err == ""  # which runs were chosen is told with the details


@pytest.mark.parametrize("named", [("C1", "c3", "alpha"), ("--only", "C1,beta,alpha"), ("C1", "--only", "C3,C5")])
def test_named_claims_are_told_with_every_seed_and_what_is_missing(
    cli: CommandLine, beta: Path, named: tuple[str, ...]
) -> None:
    found = cli("claims", *named, "--format", "table", "--db", beta)
    assert [line.split()[0] for line in found.out.splitlines()[1:4]] == ["C1", "C3", "C5"]
    text = " ".join(found.out.split())
    assert "C3 beta (section 4.5, fig6): supported" in text
    assert "beta 0.15, seed by seed: 0: 0.002, 1: 0.0021, 2: 0.0022, 3: 0.0023, 4: 0.0024" in text
    unknown = "unknown for seeds 0, 1, 2, 3, 4 of ssail, without a stored validation/mode_mse"
    assert f"ssail ends with a lower error than gail: inconclusive, {unknown}" in text
    assert "; no runs of gail" in text
    assert "beside the claim" not in text
    assert "next: ssmail reproduce --only fig8 --profile quick --seeds 0-4" in text
    assert "C3: missing of curriculum.beta" in found.err


def test_what_stands_beside_a_claim_is_told_apart(cli: CommandLine, beta: Path) -> None:
    store = Store.open(beta)
    for seed in range(5):
        spec = ablation_specs("beta", "smoke", values=[0.02])[0.02]
        writer = store.start_run(spec, seed, dataset_hash="d" * 64, device="cpu")
        writer.epoch(1, {"train/mode_mse": 0.001})
        writer.final(1, {"test/mode_mse": 0.001, "test_last/mode_mse": 0.001})
        writer.finish(RunState.FINISHED)
    store.close()
    text = " ".join(cli("claims", "C3", "--format", "table", "--db", beta).out.split())
    first, _, rest = text.partition("beside the claim, without a part in its verdict: ")
    worse = "at the selected epoch beta 0.15 has a lower error than beta 0.02: contradicted"
    assert (worse in first, worse in rest, "C3 beta (section 4.5, fig6): supported" in first) == (False, True, True)
    (claim,) = json.loads(cli("claims", "--json", "C3", "--db", beta).out)
    assert [part["beside"] for part in claim["parts"]] == [False] * 6 + [True] * 4


@pytest.mark.parametrize("width", [40, 70, 120])
def test_no_word_is_broken_and_no_line_is_too_long(
    cli: CommandLine, beta: Path, monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    names = [f"C{number}" for number in range(1, 9)]
    monkeypatch.setenv("COLUMNS", "400")
    words = set(cli("claims", *names, "--format", "table", "--db", beta).out.split())
    monkeypatch.setenv("COLUMNS", str(width))
    lines = cli("claims", *names, "--format", "table", "--db", beta).out.splitlines()
    assert max(map(len, lines)) <= width
    assert lines[9].startswith("left out, as the terminal is narrow:") == (width < 90)
    legend = next(number for number, line in enumerate(lines) if line.startswith("Verdicts"))
    found = {word for line in lines[:9] + lines[legend:] for word in line.split()}
    assert {word for word in found - words if not word[0].isdigit()} == set()  # numbers have fewer digits


def test_another_profile_has_no_runs(cli: CommandLine, beta: Path) -> None:
    (claim,) = json.loads(cli("claims", "--json", "--only", "C3", "--profile", "paper", "--db", beta).out)
    assert (claim["verdict"], claim["runs"]) == ("inconclusive", [])


def test_a_misspelt_claim_is_answered_with_the_nearest(cli: CommandLine, beta: Path) -> None:
    assert (
        cli("claims", "--only", "stabilty", "--db", beta).sentence
        == "unknown claim 'stabilty'; did you mean stability?"
    )


def test_a_missing_database_is_not_made(cli: CommandLine, db: Path) -> None:
    assert "there is no database" in cli("claims", "--db", db).sentence
    assert not db.exists()
