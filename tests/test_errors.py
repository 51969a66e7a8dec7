"""Text from elsewhere in what ssmail says: visible, short, quoted, and without passwords."""

import shlex
import subprocess
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmail.errors import command_line, masked, printable, sentence, shortened, suggestion, unknown_name

SECRETS = [
    "postgresql://u:SECRET@h/d",
    "postgresql+psycopg://:SECRET@h:5432/d",
    "postgresql://u:SEC@RET@h/d",
    "postgresql://u:SECRET/@h/d",
    "postgresql://u:SE CRET@h/d",
    "postgresql://h/d?user=u&password=SECRET",
    "postgresql://h/d?p%61ssword=SECRET&sslmode=require",
    "postgresql://u:SECRET@h/d?password=SECRET",
    "nonsense://u:SECRET@",
    "postgresql://u:SEC@RET/%40h/d",
    "postgresql://h/d?PassWord=SECRET",
    "postgresql://h/d?sslkey=SECRET&sslpassword=SECRET&host=x",
    "postgresql://h/d?host=x&api_token=SECRET&client+secret=SECRET",
]
KEYS = ["password", "PASSWORD", "sslpassword", "sslkey", "p%61ssword", "Secret", "access_token", "pwd", "passphrase"]
SHOWN_KEYS = ["host", "user", "sslmode", "passfile", "application_name", "options", "keepalives_idle"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("fine: ä, 日本, 1/β ± ∞ 😀", "fine: ä, 日本, 1/β ± ∞ 😀"),
        ("\x1b[31m", r"\x1b[31m"),
        ("a\nb\tc\r\x00\x7f", r"a\nb\tc\r\x00\x7f"),
        ("\x9b31m\x85", r"\x9b31m\x85"),
        ("\u061c\u200e\u200f\u202a\u202e\u2066\u2069", r"\u061c\u200e\u200f\u202a\u202e\u2066\u2069"),
        ("\u2028\u2029", r"\u2028\u2029"),
        ("\u200b\u200d\u2060\ufeff\u00ad\U000e0041", r"\u200b\u200d\u2060\ufeff\xad\U000e0041"),
        ("\u3164\u115f\u2800\ufe0f\U000e0100\u034f", r"\u3164\u115f\u2800\ufe0f\U000e0100\u034f"),
        ("\xa0\u2003\u3000", r"\xa0\u2003\u3000"),
        ("\ud800 \udc80", r"\ud800 \udc80"),
        ("\ue000", r"\ue000"),
    ],
)
def test_what_a_terminal_does_not_just_show_becomes_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


@given(st.text(st.characters()))
def test_a_printable_text_is_printable_and_stays_as_it_is(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert printable(shown) == shown
    shown.encode("utf-8")


@pytest.mark.parametrize("url", SECRETS)
def test_no_password_of_a_url_is_shown(url: str) -> None:
    for text in (url, f"cannot open {url}; give another", f"'{url}'"):
        assert "SEC" not in masked(text)
        assert "RET" not in masked(text)
    assert masked(masked(url)) == masked(url)


@given(
    st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\n"), min_size=1),
    st.sampled_from(KEYS),
    st.sampled_from(SHOWN_KEYS),
    st.text("abcXYZ0123_-/+", max_size=8),
    st.sampled_from(["", "; check it", " computes them", "'", "`", ")."]),
)
def test_passwords_are_masked_and_nothing_else(secret: str, key: str, other: str, value: str, rest: str) -> None:
    """Before the host and in the query, as a URL is written: whatever the password, and with it whatever follows."""
    quoted = quote(f"<{secret}>")  # which is nowhere else
    before, after = (
        f"postgresql://u:{quoted}@h:1/d?{other}={value}",
        f"postgresql://u@h/d?{key}={quoted}&{other}={value}",
    )
    for url in (before, after, f"postgresql://u@h/d?{other}={value}&{key}={quoted}"):
        for text in (url, f"see {url}{rest}", f"see `x --db '{url}'{rest}"):
            shown = masked(text)
            assert shown == text.replace(quoted, "***")
            assert masked(shown) == shown


@given(
    st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\n&"), min_size=1), st.sampled_from(KEYS)
)
def test_a_password_that_is_not_encoded_is_masked_too(secret: str, key: str) -> None:
    for url in (f"postgresql://u:<{secret}>@h/d", f"postgresql://h/d?{key}=<{secret}>"):
        assert "<" not in masked(url)
        assert ">" not in masked(url)


@given(st.text(st.characters(blacklist_categories=["Cs"])))
def test_masking_twice_is_masking_once(text: str) -> None:
    for given_text in (text, f"a://{text}", f"a://b:{text}@c?password={text}"):
        assert masked(masked(given_text)) == masked(given_text)


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://u@h:5432/d?host=/tmp&passfile=/home/u/.pgpass",
        "postgresql://u@h:5432/d",
        "sqlite:////tmp/a.db",
        "results/a:b@c.db",
        "C:/a b.db",
    ],
)
def test_a_name_without_a_password_stays(url: str) -> None:
    assert masked(url) == url


def test_a_long_text_keeps_its_beginning_and_its_end() -> None:
    assert shortened("a" * 300 + "; use b.", 100).endswith("aaa; use b.")
    assert len(shortened("a" * 301, 300)) == 300
    assert shortened("a" * 300, 300) == "a" * 300


@given(st.text(st.characters(), max_size=2000))
def test_a_sentence_is_one_printable_line_of_bearable_length(text: str) -> None:
    shown = sentence(text)
    assert shown.isprintable()
    assert len(shown) <= 300


def test_a_command_is_not_cut() -> None:
    command = command_line("ssmail", "train", "--method", "a" * 100 + "; touch gone")
    assert "touch" not in sentence(f"{'x' * 200}; run `{command}`.")
    assert sentence(f"x; run `{command}`.") == f"x; run `{command}`."


@given(st.lists(st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0")), max_size=3))
def test_a_suggested_command_is_the_words_or_shows_less(words: list[str]) -> None:
    line = command_line("rm", "-r", *words)
    assert "`" not in line
    assert printable(line) == line
    for was, now in zip(words, shlex.split(line)[2:], strict=True):
        assert now in (was, "...") or "://" in was


@pytest.mark.parametrize("name", ["; touch gone", "$(touch gone)", "a; touch gone #'", "a\n touch gone"])
def test_a_shell_runs_nothing_that_a_name_says(name: str, tmp_path: Path) -> None:
    subprocess.run(["sh", "-c", command_line("true", name)], cwd=tmp_path, check=True)
    assert not (tmp_path / "gone").exists()
    subprocess.run(["sh", "-c", f"true {name}"], cwd=tmp_path, check=True)  # the control
    assert (tmp_path / "gone").exists()


def test_a_password_is_no_part_of_a_suggested_command() -> None:
    assert (
        command_line("ssmail", "report", "--db", "postgresql://u:pw@h/d")
        == "ssmail report --db 'postgresql://u:***@h/d'"
    )


def test_a_suggestion_is_short_whatever_was_asked_for() -> None:
    assert len(str(unknown_name("method", "x" * 10_000, [f"method{number}" for number in range(1000)]))) <= 300
    assert len(str(unknown_name("method", "x" * 10_000, ["x" * 9_999]))) <= 300
    assert suggestion("ssial", ["ssail", "gail"]) == "did you mean ssail?"
    assert suggestion("zzz", ["ssail", "gail"]) == "choose from ssail, gail."
