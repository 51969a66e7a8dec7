"""Names of scenes and agents are text: none is merged with another, however much both look like one number."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from ssmail.data.importing.rows import plain_name
from ssmail.data.trajectories import SPLITS
from tests.data.importing.walks import imported, table_of, walks

APART = [
    ("1_1", "11"),
    ("12345678901234567", "12345678901234568"),
    ("9007199254740993", "9007199254740993.0"),
    ("1e3", "1000"),
    ("007", "7"),
    ("1.50", "1.5"),
    ("+1", "1"),
    ("0.0", "-0.0"),
    ("inf", "1e999"),
    ("\u0667", "7"),  # an Arabic seven
]


def renamed(column: str, *names: str, scenes: int = 4) -> pd.DataFrame:
    """A table whose first scenes or agents have other names."""
    table = table_of(walks(scenes=scenes)).astype({column: str})
    return table.assign(**{column: table[column].replace(dict(zip("0123", names, strict=False)))})


@pytest.mark.parametrize(("one", "other"), APART)
def test_names_that_look_like_one_number_stay_apart(tmp_path: Path, one: str, other: str) -> None:
    renamed("scene", one, other, "2", "3").to_csv(tmp_path / "scenes.csv", index=False)
    experts, summary = imported(tmp_path / "scenes.csv")
    assert set(experts.scenes) == {plain_name(name) for name in (one, other, "2", "3")}
    assert summary.scenes == 4
    renamed("agent", one, other).to_csv(tmp_path / "agents.csv", index=False)
    assert imported(tmp_path / "agents.csv")[1].splits["train"]["most_agents"] == 2


def test_a_whole_number_is_the_same_name_as_pandas_writes_it(tmp_path: Path) -> None:
    """A column of numbers with a gap becomes 1.0, 2.0, ..."""
    table = table_of(walks())
    table[table["frame"] < 5].to_csv(tmp_path / "a.csv", index=False)
    later = table[table["frame"] >= 5].astype({"scene": float, "agent": float})
    later.to_csv(tmp_path / "b.csv", index=False)
    assert "1.0" in (tmp_path / "b.csv").read_text()
    experts, summary = imported(tmp_path / "a.csv", tmp_path / "b.csv")
    assert (experts.scenes, summary.scenes) == (("0", "1", "2", "3"), 4)
    table.to_csv(tmp_path / "c.csv", index=False)
    assert experts.hash == imported(tmp_path / "c.csv")[0].hash


@pytest.mark.parametrize(
    ("cell", "name"),
    [
        ("1.0", "1"),
        (" 20.0 ", "20"),
        ("-3.0", "-3"),
        ("0.0", "0"),
        ("9007199254740992.0", "9007199254740992"),
        ("9007199254740994.0", "9007199254740994.0"),
        ("1.00", "1.00"),
        ("01.0", "01.0"),
        ("-0.0", "-0.0"),
        ("1_0.0", "1_0.0"),
        ("1e3.0", "1e3.0"),
        ("a.0", "a.0"),
        (".0", ".0"),
        ("1.", "1."),
    ],
)
def test_only_the_plain_form_of_a_whole_number_is_changed(cell: str, name: str) -> None:
    assert plain_name(cell) == name


def test_parquet_keeps_all_digits(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    numbers = [12345678901234567, 12345678901234568, 2**63, 5]
    table = table_of(walks())
    large = table.assign(scene=np.array(numbers, dtype=np.uint64)[table["scene"]])
    large.to_parquet(tmp_path / "a.parquet")
    assert imported(tmp_path / "a.parquet")[0].scenes == tuple(map(str, sorted(numbers)))
    floats = table.assign(scene=np.array([1e7, 2.5, 2.0**53, 3.0])[table["scene"]])
    floats.to_parquet(tmp_path / "b.parquet")
    assert imported(tmp_path / "b.parquet")[0].scenes == ("2.5", "3", "10000000", str(2**53))


def test_numbers_are_in_their_order_and_other_names_by_letters(tmp_path: Path) -> None:
    def scenes(*names: str) -> tuple[str, ...]:
        renamed("scene", *names).to_csv(tmp_path / "a.csv", index=False)
        return imported(tmp_path / "a.csv")[0].scenes

    assert scenes("10", "9", "2", "-1") == ("-1", "2", "9", "10")
    assert scenes("10", "007", "8", "7") == ("007", "7", "8", "10")
    assert scenes("100000000000000001", "100000000000000000", "99999999999999999", "2.5") == (
        *("2.5", "99999999999999999"),
        *("100000000000000000", "100000000000000001"),
    )
    assert scenes("10", "9", "2", "x") == ("10", "2", "9", "x")


def test_a_scene_is_named_as_it_is_written(tmp_path: Path) -> None:
    renamed("scene", "007", "008", "7", "9").to_csv(tmp_path / "a.csv", index=False)
    experts, _ = imported(tmp_path / "a.csv", validation=("007",), test=("9.0",))
    assert {experts.scenes[scene] for scene in experts.validation.scene} == {"007"}
    assert {experts.scenes[scene] for scene in experts.test.scene} == {"9"}


@pytest.mark.parametrize("kind", [int, float])
def test_sets_of_plain_numbers_are_those_that_they_always_were(tmp_path: Path, kind: type) -> None:
    """The hash, over names, splits, order and positions, is the one before names were kept as text."""
    scene, frame, agent = (index.ravel() for index in np.indices((13, 9, 12)))
    columns = {"scene": 3 * scene, "frame": frame, "agent": 7_000_003 * (agent - 2)}
    table = pd.DataFrame(columns | {"x": (scene + frame**2) / 4, "y": (frame * agent) / 8})
    table.astype({"scene": kind, "agent": kind}).to_csv(tmp_path / "a.csv", index=False)
    experts, _ = imported(tmp_path / "a.csv")
    assert experts.scenes == tuple(str(3 * number) for number in range(13))
    assert [len(set(getattr(experts, split).scene.tolist())) for split in SPLITS] == [9, 2, 2]
    assert experts.hash.startswith("217b1e45cf385604")
