"""Values, names and numbers that strangers write: for YAML, for --set and for arguments."""

from typing import Any

import yaml
from hypothesis import strategies as st

WORDS = (
    *(
        "",
        " ",
        "~",
        "null",
        "no",
        "=",
        "<<",
        "*a",
        "&a",
        "!",
        "!!str",
        "-",
        "?",
        ":",
        "[",
        "{",
        "}",
        "'",
        '"',
        "%",
        "@",
        "`",
    ),
    *("!!python/object/apply:os.system [true]", "!!python/name:os.system", "!!python/module:this x", "!!set {a, b}"),
    *("!!int ''", "!!bool maybe", "!!float x", "!!timestamp x", "!!binary =", "!!omap [a]", "!own x", "!<tag:x> y"),
    *(
        "2024-01-01",
        "2024-13-45",
        "0001-01-01 00:00:00+99:99",
        "1:2:3",
        "1:1:1:1.5",
        "0x_",
        "0b_",
        "0o8",
        "1_0",
        "._",
        "1e999",
    ),
    *(
        ".nan",
        ".inf",
        "-.inf",
        "-0",
        "1e-400",
        "9" * 400,
        "9" * 5000,
        "0x" + "f" * 4000,
        "1" + ":1" * 199 + ".0",
        "-" * 3000,
    ),
    *(
        "&a [*a]",
        "&a {a: *a}",
        "{<<: &a {<<: *a}}",
        "[*nothing]",
        "{a: 1, a: 2}",
        "{[a]: 1}",
        "{{a: b}: c}",
        "{1: 2}",
        "{null: 1}",
    ),
    *("[" * 3000, "{a: " * 500, "- " * 500, "[" * 20 + "]" * 20, "[" + "[]," * 3000 + "]", "{a: {a: {a: {a: 1}}}}"),
    *(
        '"\\ud800"',
        '"\\0"',
        '"\\x1b[31m"',
        '"\\UFFFFFFFF"',
        '"\\U00110000"',
        "\udcff",
        "\x1b]0;x\x07",
        "\u202eabc",
        "\x85",
        "\ufeff",
    ),
    *(
        "ssmail_trap:f",
        "ssmail_trap.inside:f",
        "this:s",
        "antigravity:fly@0123456789ab",
        "os:system",
        "a" * 5000 + ":f",
    ),
    *(
        "../../../etc/passwd",
        "/dev/zero",
        "~nobody/x",
        "$(touch x)",
        "; rm -r ~",
        "a" * 300,
        "a/" * 3000,
        "%s%n{0}{x!r}",
    ),
    *(
        "[0,1]",
        "[[0,1,1]]",
        "[[0,0],[1,1]]",
        "[1,0]",
        "[[0,.nan],[1,1]]",
        "[0,[1]]",
        "identity",
        "true",
        "0.5",
        "1",
        "2",
    ),
)

LEAVES = (
    st.none() | st.booleans() | st.integers() | st.integers(-(2**70), 2**70) | st.floats() | st.sampled_from(WORDS)
    | st.text(max_size=12)
)  # fmt: skip
VALUES: st.SearchStrategy[Any] = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=8,
)


def as_yaml(value: Any) -> str:
    """Return a value as YAML on one line, tags and all."""
    return str(yaml.dump(value, default_flow_style=True, width=10**6, allow_unicode=True)).strip()


TEXTS = (
    st.sampled_from(WORDS)
    | st.text(max_size=30)
    | VALUES.map(as_yaml)
    | st.tuples(st.sampled_from(WORDS), st.sampled_from(WORDS)).map("".join)
)
"""YAML texts, and other texts."""
