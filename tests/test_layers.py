"""The house is read from below: an import may go down or stay on its floor, never up."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = (
    ("errors",),
    ("config",),
    ("data", "envs", "models"),
    ("losses", "evaluation", "adapters"),
    ("training",),
    ("store",),
    ("execution", "inference"),
    ("plots",),
    ("paper",),
    ("ssmail_cli", "__main__"),  # python -m ssmail, which nothing imports
)
FLOOR = {room: height for height, rooms in enumerate(FLOORS) for room in rooms}


def room_of(module: str) -> str | None:
    """The room of a dotted module: "ssmail.store.schema" -> "store"; None for other packages and for ssmail itself."""
    parts = module.split(".")
    if parts[0] == "ssmail_cli":
        return "ssmail_cli"
    return parts[1] if parts[0] == "ssmail" and len(parts) > 1 else None


def imported_modules(tree: ast.AST, package: str) -> Iterator[tuple[int, str]]:
    """(line, dotted module) of every import, also within functions; relative ones are resolved against `package`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*above, node.module] if node.module else above)
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)


def is_for_types(node: ast.stmt) -> bool:
    """Whether this is `if TYPE_CHECKING: ...`, which nothing executes."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def violations(source_root: Path) -> list[str]:
    """One line for each import under `source_root` that goes upward or touches a room that FLOORS does not know."""
    found = []
    for path in sorted(source_root.rglob("*.py")):
        relative = path.relative_to(source_root)
        package = ".".join(relative.parent.parts)
        here = room_of(".".join(relative.with_suffix("").parts))
        tree = ast.parse(path.read_text())
        if relative == Path("ssmail/__init__.py"):
            here = "errors"  # the package itself must stay importable from everywhere: the lowest floor
            tree.body = [node for node in tree.body if not is_for_types(node)]  # what it names, it imports late
        assert here in FLOOR, f"{relative} is in no room of FLOORS; give it a floor"
        for line, module in imported_modules(tree, package):
            there = room_of(module)
            if there in FLOOR and FLOOR[there] > FLOOR[here]:
                found.append(f"{relative}:{line} imports {module}, which is above it")
    return found


def circles(source_root: Path) -> list[list[str]]:
    """The groups of modules under `source_root` that import each other in a circle; packages' own files left out."""
    files = {
        ".".join(path.relative_to(source_root).with_suffix("").parts): path
        for path in source_root.rglob("*.py")
        if path.name != "__init__.py"
    }
    imports = {
        name: {
            found
            for _, module in imported_modules(ast.parse(path.read_text()), name.rpartition(".")[0])
            for found in (module, module.rpartition(".")[0])
            if found in files and found != name
        }
        for name, path in files.items()
    }
    return [sorted(group) for group in _strongly_connected(imports) if len(group) > 1]


def _strongly_connected(graph: dict[str, set[str]]) -> list[set[str]]:
    """The strongly connected components: what reaches a node and is reached from it."""

    def reached(start: str) -> set[str]:
        found, waiting = {start}, [start]
        while waiting:
            for other in graph[waiting.pop()] - found:
                found.add(other)
                waiting.append(other)
        return found

    reach = {name: reached(name) for name in graph}
    groups = {frozenset(other for other in reach[name] if name in reach[other]) for name in graph}
    return [set(group) for group in groups]


@pytest.mark.parametrize("source_root", [ROOT / "src", ROOT / "cli"], ids=lambda path: path.name)
def test_no_modules_import_each_other_in_a_circle(source_root: Path) -> None:
    assert circles(source_root) == []


def test_a_planted_circle_is_caught(tmp_path: Path) -> None:
    room = tmp_path / "ssmail" / "training"
    room.mkdir(parents=True)
    (room / "first.py").write_text("from ssmail.training.second import a\n")
    (room / "second.py").write_text("from ssmail.training import third\n")
    (room / "third.py").write_text("def late():\n    from ssmail.training.first import b\n")
    (room / "fourth.py").write_text("from ssmail.training.third import late\n")
    assert circles(tmp_path) == [["ssmail.training.first", "ssmail.training.second", "ssmail.training.third"]]


@pytest.mark.parametrize("source_root", [ROOT / "src", ROOT / "cli"], ids=lambda path: path.name)
def test_no_import_goes_upward(source_root: Path) -> None:
    assert list(source_root.rglob("*.py"))
    assert violations(source_root) == []


@pytest.mark.parametrize(
    "statement",
    [
        "from ssmail.store import Store",
        "import ssmail.store.queries",
        "from ssmail import store",
        "from ..store import Store",
        "from .. import store",
        "def late():\n    from ssmail.store.writer import RunWriter",
        "import ssmail_cli.main",
        "from ssmail_cli import main",
    ],
)
def test_a_planted_upward_import_is_caught(tmp_path: Path, statement: str) -> None:
    planted = tmp_path / "ssmail" / "training" / "loop.py"
    planted.parent.mkdir(parents=True)
    planted.write_text(f"import torch\nfrom ssmail.models import policy\n{statement}\n")
    (found,) = violations(tmp_path)
    assert found.startswith("ssmail/training/loop.py:")
    planted.write_text("import torch\nfrom ssmail.models import policy\nfrom ..evaluation import metrics\n")
    assert violations(tmp_path) == []


def test_a_module_in_no_room_is_caught(tmp_path: Path) -> None:
    stray = tmp_path / "ssmail" / "attic.py"
    stray.parent.mkdir()
    stray.write_text("")
    with pytest.raises(AssertionError, match="no room"):
        violations(tmp_path)
