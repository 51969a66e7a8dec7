"""Files of runs: their checksums, and that they are found beside the database wherever it is."""

from pathlib import Path

from ssmail.store import RunWriter, Store


def test_artifacts(store: Store, writer: RunWriter) -> None:
    inside = store.checkpoint_root / writer.run_id / "best.pt"
    inside.parent.mkdir(parents=True)
    inside.write_bytes(b"abc")
    writer.artifact("best.pt")
    (best,) = store.artifacts(writer.run_id)
    assert (best.name, best.path, best.size_bytes) == ("best.pt", inside, 3)
    assert best.sha256 == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # NIST's example


def test_artifacts_move_with_the_database(store: Store, writer: RunWriter, tmp_path: Path) -> None:
    file = store.checkpoint_root / writer.run_id / "best.pt"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"abc")
    writer.artifact("best.pt")
    store.close()
    moved = (tmp_path / "results").rename(tmp_path / "moved")
    again = Store.open(moved / "ssmail.db")
    (found,) = again.artifacts(writer.run_id)
    assert found.path == moved / "checkpoints" / writer.run_id / "best.pt"
    assert found.path.exists()
    again.close()
