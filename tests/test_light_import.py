"""`import ssmail` is light: what is heavy is imported when it is used."""

import subprocess
import sys

HEAVY = ("torch", "pandas", "sqlalchemy", "matplotlib", "numpy", "pydantic", "scipy")
FOUND = f"print(*[name for name in {HEAVY} if name in sys.modules])"


def loaded(statement: str) -> set[str]:
    """The heavy packages that are loaded after a statement, in a new process."""
    code = f"import sys; {statement}; {FOUND}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_ssmail_imports_nothing_heavy_until_it_is_used() -> None:
    assert loaded("import ssmail; dir(ssmail); ssmail.InputError") == set()
    assert loaded("import ssmail; ssmail.load_run") >= {"torch", "sqlalchemy"}
