"""Files of runs: their checksums, and that they are found beside the database wherever it is."""

from pathlib import Path

from ssmail.store import RunWriter, Store


def test_artifacts(store: Store, writer: RunWriter, tmp_path: Path) -> None:
    inside = store.checkpoint_root / writer.run_id / "best.pt"
    inside.parent.mkdir(parents=True)
    inside.write_bytes(b"abc")
    outside = tmp_path / "elsewhere.bin"
    outside.write_bytes(b"")
    writer.artifact("outside", outside)
    writer.artifact("best.pt", inside)
    best, other = store.artifacts(writer.run_id)
    assert (best.name, best.path, best.size_bytes) == ("best.pt", inside, 3)
    assert best.sha256 == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # NIST's example
    assert (other.name, other.path, other.size_bytes) == ("outside", outside, 0)


def test_artifacts_move_with_the_database(store: Store, writer: RunWriter, tmp_path: Path) -> None:
    file = store.checkpoint_root / writer.run_id / "best.pt"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"abc")
    writer.artifact("best.pt", file)
    store.close()
    moved = (tmp_path / "results").rename(tmp_path / "moved")
    again = Store.open(moved / "ssmail.db")
    (found,) = again.artifacts(writer.run_id)
    assert found.path == moved / "checkpoints" / writer.run_id / "best.pt"
    assert found.path.exists()
    again.close()
