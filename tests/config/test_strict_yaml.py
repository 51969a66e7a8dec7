"""YAML from anyone: values of JSON only, and bounds on whatever a text could unfold into."""

import os
from pathlib import Path

import pytest
import yaml

from ssmail.config import strict_yaml
from ssmail.errors import InputError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("1", 1),
        ("-9223372036854775808", -(2**63)),
        ("2024-05-17", "2024-05-17"),
        ("2024-13-45", "2024-13-45"),
        ("=", "="),
        ("'1'", "1"),
        ("\ufeffa: 1", {"a": 1}),
        ("{a: &x [1, 2], b: *x}", {"a": [1, 2], "b": [1, 2]}),
        ("a: &x {k: 1}\nb: {<<: *x, l: 2}", {"a": {"k": 1}, "b": {"k": 1, "l": 2}}),
        ("base: &b {k: 1}\nx: {y: &a {<<: *b, k: 2}}\nz: {<<: *a, k: 3}", {"k": 3}),
        ("[true, null, ~, .inf]", [True, None, None, float("inf")]),
        ('"a\\tb\\nc"', "a\tb\nc"),
        ("", None),
    ],
)
def test_what_texts_mean(text: str, value: object) -> None:
    found = strict_yaml.parse(text)
    assert (found["z"] if isinstance(found, dict) and "z" in found else found) == value


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 28))
MERGES = "a: &a {" + ", ".join(f"k{n}: 1" for n in range(100)) + "}\nb: &b {<<: [" + "*a, " * 200 + "]}\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (BOMB, "it has more than 10,000 values"),
        (MERGES, "it has more than 10,000 values"),
        ("[" + "0," * 10_000 + "]", "it has more than 10,000 values"),
        ("&a [*a]", "an alias refers to what contains it"),
        ("a: &a {<<: *a}", "an alias refers to what contains it"),
        ("[" * 40 + "]" * 40, "values are nested more than 30 deep"),
        ("[" * 100_000, "values are nested more than 30 deep"),
        ("- " * 5000, "values are nested more than 30 deep"),
        ("".join(" " * n + "a:\n" for n in range(200)), "values are nested more than 30 deep"),
        (
            "- &a0 [x]\n" + "".join(f"- &a{n} [*a{n - 1}]\n" for n in range(1, 60)),
            "values are nested more than 30 deep",
        ),
        ("!!python/object/apply:os.system ['true']", "a tag is not allowed; leave it out"),
        ("!!int ''", "a tag is not allowed; leave it out"),
        ("a: !!timestamp x", "a tag is not allowed; leave it out"),
        ("{!!bool maybe: 1}", "a tag is not allowed; leave it out"),
        ("!own {a: 1}", "a tag is not allowed; leave it out"),
        ("! x", "a tag is not allowed; leave it out"),
        ("1: x", "a key is not text; put quotes around it"),
        ("{null: x}", "a key is not text; put quotes around it"),
        ("? [a, b]\n: x", "a key is not text; put quotes around it"),
        ("? {a: b}\n: x", "a key is not text; put quotes around it"),
        ("{on: x}", "a key is not text; put quotes around it"),
        ("{a: 1, 'a': 2}", "'a' is given twice"),
        ("{<<: {a: 1}, <<: {b: 1}}", "'<<' is given twice"),
        ("9" * 5000, "a whole number is too large"),
        ("9223372036854775808", "a whole number is too large"),
        ("0x" + "f" * 5000, "a whole number is too large"),
        ("0b_", "it contains an impossible number"),
        ("1" + ":1" * 190 + ".0", "it contains an impossible number"),
        ("1." + "9" * 5000, "a number has too many digits"),
        ('"\\ud800"', "text contains a control character"),
        ('"\\x00"', "text contains a control character"),
        ('"\\x1b[31m"', "text contains a control character"),
        ('"\\UFFFFFFFF"', "it contains an impossible number"),
        ("%YAML " + "1" * 5000 + ".1\n---\na: 1", "it contains an impossible number"),
    ],
)
def test_what_is_refused(text: str, problem: str) -> None:
    with pytest.raises(yaml.MarkedYAMLError) as caught:
        strict_yaml.parse(text)
    assert caught.value.problem == problem


def test_a_long_text_is_not_parsed_at_all(tmp_path: Path) -> None:
    with pytest.raises(yaml.YAMLError, match="more than 200,000 characters"):
        strict_yaml.parse(" " * 200_001)
    file = tmp_path / "long.yaml"
    with file.open("w") as stream:
        stream.truncate(2**30)  # sparse
    with pytest.raises(InputError, match=r"long\.yaml has more than 200,000 bytes; give a smaller file\."):
        strict_yaml.read(file)


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero"), Path("/dev/null")):
        with pytest.raises(InputError, match=f"{path} (is not a file; give the path of one|cannot be read: Is a dir)"):
            strict_yaml.read(path)
    for path, reason in (
        (tmp_path / ("a" * 300), "File name too long"),
        (tmp_path / "missing", "No such file or directory"),
        (tmp_path / "a\0b", "is not a path"),
    ):
        with pytest.raises(InputError, match=reason):
            strict_yaml.read(path)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("a: 1\nb: 2".encode("utf-16"), "is not UTF-8 text"),
        (b"\xff\xfe\x00\x01", "is not UTF-8 text"),
        (b"a: \x00", "is not valid YAML: it contains a character that is not allowed"),
        (b"a: 1\nb: &b [*b]\n", r", line 2 is not valid YAML: an alias refers to what contains it\."),
        (b"a: 1\n'" + 400 * b"b" + b"': 1\n'" + 400 * b"b" + b"': 1\n", r", line 3 is not valid YAML: 'b+\."),
    ],
)
def test_a_file_that_is_no_text(tmp_path: Path, content: bytes, said: str) -> None:
    file = tmp_path / "odd.yaml"
    file.write_bytes(content)
    with pytest.raises(InputError, match=said) as caught:
        strict_yaml.read(file)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 200


def test_a_value_in_a_message_is_short() -> None:
    assert strict_yaml.inline([1.0, {"a": "x"}]) == "[1.0, {a: x}]"
    assert strict_yaml.inline("x" * 1000) == f"{'x' * 80}..."
