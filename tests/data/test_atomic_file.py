import os
from pathlib import Path

import pytest

from ssmail.data.atomic_file import atomic_write


def test_the_folder_is_made_and_the_file_replaced(tmp_path: Path) -> None:
    target = tmp_path / "new" / "file.txt"
    for text in ("old", "new"):
        with atomic_write(target) as partial:
            partial.write_text(text)
            assert partial.parent == target.parent
        assert target.read_text() == text
    assert list(target.parent.iterdir()) == [target]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "file.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(target) as partial:  # noqa: PT012
        partial.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_appeared_meanwhile_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    def no_links(*_: object) -> None:
        raise OSError("no hard links here")

    if not links:
        monkeypatch.setattr(os, "link", no_links)
    target = tmp_path / "file.txt"
    with atomic_write(target, overwrite=False) as partial:
        partial.write_text("first")
    with pytest.raises(FileExistsError), atomic_write(target, overwrite=False) as partial:
        partial.write_text("second")
    assert target.read_text() == "first"
    assert list(tmp_path.iterdir()) == [target]
