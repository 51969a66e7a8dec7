"""YAML without surprises, from a text that may come from anyone.

1e-3 is a number (text in PyYAML), a date is text, a repeated key an error (PyYAML takes the last one). Values are those
of JSON, so a key is text, and there are no tags. Anchors, aliases and merge keys work; what they expand to is bounded,
like the size and the depth of every text.
"""

import re
from pathlib import Path
from typing import Any, cast

import yaml
from yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode

from ssmail.config.foreign_files import IrregularFileError, open_regular, read_whole
from ssmail.errors import InputError

MOST_BYTES = 200_000  # of a text; experiments.yaml has 8,000
MOST_VALUES = 10_000  # in a text, once aliases are expanded
DEEPEST = 30  # collections inside each other
MOST_DIGITS = 400  # of a number, which is more than a float has
_INTEGERS = range(-(2**63), 2**63)
_SHOWN = 80  # characters of a value or of PyYAML's reason in a message


def read(path: Path) -> Any:
    """Return the value in a file. Raises InputError with file and line if it cannot be read or is not valid YAML."""
    return parse_bytes(read_bytes(path, MOST_BYTES), path)


def parse_bytes(content: bytes, path: Path) -> Any:
    """Return the value in the content of a file. Raises InputError with `path` and line if it is not valid YAML."""
    try:
        return parse(content.decode())
    except UnicodeDecodeError:
        raise InputError(f"{path} is not UTF-8 text.") from None
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(f"{path}{line} is not valid YAML: {error.problem!s:.{_SHOWN}}.") from None
    except yaml.YAMLError:
        raise InputError(f"{path} is not valid YAML: it contains a character that is not allowed.") from None


def read_bytes(path: Path, most: int) -> bytes:
    """Return the content of a file. Raises InputError if it cannot be read, is no regular file, or has > `most` bytes.

    A named pipe or a device is not waited for.
    """
    try:
        with open_regular(path) as file:
            content = read_whole(file, most)
    except IrregularFileError:
        what = "cannot be read: Is a directory" if path.is_dir() else "is not a file; give the path of one"
        raise InputError(f"{path} {what}.") from None
    except OSError as error:
        if error.strerror is None:  # a null byte in the path
            raise InputError(f"{str(path)!r} is not a path; give that of a file.") from None
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None
    if content is None:
        raise InputError(f"{path} has more than {most:,} bytes; give a smaller file.")
    return bytes(content)


def parse(text: str) -> Any:
    """Return the value of a YAML text. Raises yaml.YAMLError."""
    if len(text) > MOST_BYTES:
        raise yaml.YAMLError(f"it has more than {MOST_BYTES:,} characters")
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    except (ValueError, OverflowError) as error:  # an escape or a version number that PyYAML cannot convert
        raise yaml.MarkedYAMLError(
            problem="it contains an impossible number", problem_mark=loader.get_mark()
        ) from error
    finally:
        loader.dispose()


def inline(value: Any) -> str:
    """Return a value as YAML on one line, the beginning of it if it is long."""
    text = str(yaml.safe_dump(value, default_flow_style=True, width=10**6)).removesuffix("\n").removesuffix("\n...")
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


class _Loader(yaml.SafeLoader):
    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._measures: dict[Node, tuple[int, int]] = {}  # of complete nodes: values with aliases expanded, height

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Compose a node, and measure it before anything is constructed."""
        event = cast("Any", self).peek_event()
        mark = event.start_mark
        if getattr(event, "tag", None) is not None:
            raise _refusal("a tag is not allowed; leave it out", mark)
        self._depth += 1
        _check_depth(self._depth, mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        assert node is not None
        if not isinstance(event, yaml.AliasEvent):
            _check_keys(node)
            inside = [self._measures[part] for part in _parts(node)]
            size, height = 1 + sum(size for size, _ in inside), 1 + max((height for _, height in inside), default=0)
            self._measures[node] = size, height
        elif node not in self._measures:
            raise _refusal("an alias refers to what contains it", mark)
        size, height = self._measures[node]
        if size > MOST_VALUES:
            raise _refusal(f"it has more than {MOST_VALUES:,} values", mark)
        _check_depth(height, mark)
        return node

    def construct_text(self, node: ScalarNode) -> str:
        """Construct text. Raises ConstructorError for characters that neither paths nor names have."""
        text = str(self.construct_scalar(node))
        if _CONTROLS.search(text):
            raise _refusal("text contains a control character", node.start_mark)
        return text

    def construct_integer(self, node: ScalarNode) -> int:
        """Construct an integer. Raises ConstructorError for one that has no place in 64 bits."""
        if len(node.value) <= MOST_DIGITS and (number := int(self.construct_yaml_int(node))) in _INTEGERS:
            return number
        raise _refusal("a whole number is too large", node.start_mark)

    def construct_number(self, node: ScalarNode) -> float:
        """Construct a float. Raises ConstructorError for one of too many digits."""
        if len(node.value) > MOST_DIGITS:
            raise _refusal("a number has too many digits", node.start_mark)
        return float(self.construct_yaml_float(node))


def _parts(node: Node) -> list[Node]:
    """Return the nodes directly inside a node."""
    if isinstance(node, MappingNode):
        return [part for pair in node.value for part in pair]
    return node.value if isinstance(node, CollectionNode) else []


def _check_keys(node: Node) -> None:
    """Raise ConstructorError for a key of a mapping that is not text, or is given twice."""
    seen: set[str] = set()
    for key, _ in node.value if isinstance(node, MappingNode) else ():
        if key.tag not in (_STRING, _MERGE):
            raise _refusal("a key is not text; put quotes around it", key.start_mark)
        if key.value in seen:
            raise _refusal(f"{key.value!r:.{_SHOWN}} is given twice", key.start_mark)
        seen.add(key.value)


def _check_depth(depth: int, mark: Any) -> None:
    if depth > DEEPEST:
        raise _refusal(f"values are nested more than {DEEPEST} deep", mark)


def _refusal(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, mark)


_STRING, _MERGE, _FLOAT = (f"tag:yaml.org,2002:{name}" for name in ("str", "merge", "float"))
_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
# dates and "=" are text
_Loader.yaml_implicit_resolvers = {
    first: [(tag, form) for tag, form in found if not tag.endswith((":timestamp", ":value"))]
    for first, found in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(_FLOAT, re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789"))
_Loader.add_constructor(_STRING, _Loader.construct_text)
_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_integer)
_Loader.add_constructor(_FLOAT, _Loader.construct_number)
