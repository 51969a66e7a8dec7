"""Loading the checkpoints that runs recorded, wherever they are: one answer for resuming and for using a model."""

import os
from typing import Any

from ssmail.errors import InputError
from ssmail.store.artifact_storage import AlteredObjectError
from ssmail.store.checkpoint_files import BEST, LASTS, run_folder
from ssmail.store.run_store import Store
from ssmail.training.checkpoint import AFRESH, load_checkpoint, parse_checkpoint


def load_recorded(store: Store, run_id: str, name: str) -> tuple[str, dict[str, Any] | None]:
    """Return where a checkpoint that a run recorded under a name is, for messages, and its state; None: it is missing.

    It is looked for in the store's storage, then beside the database, where older versions left the file of a run in
    progress without a record. Raises InputError when it is not as recorded.
    """
    recorded = next((row for row in store.artifacts(run_id) if row.name == name), None)
    if recorded is not None and store.storage is not None:
        where = store.storage.name_of(recorded)
        try:
            content = store.storage.read(recorded)
        except AlteredObjectError as error:
            raise InputError(f"{error}; {AFRESH}") from error
        if content is not None:
            return where, parse_checkpoint(content, where)
    path = recorded.path if recorded else run_folder(store.checkpoint_root, run_id) / name
    if path is None or not (path.name in (BEST, *LASTS) or (recorded and recorded.by_content)):
        raise InputError(f"run {run_id[:8]} has its checkpoint recorded in another folder; {AFRESH}")
    if not os.path.lexists(path):
        return str(path), None
    return str(path), load_checkpoint(path, recorded.sha256 if recorded else None)
