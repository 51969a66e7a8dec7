"""Texts from a database are read as neither Markdown nor HTML, whatever they say."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from markdown_it.token import Token

from ssmail.errors import printable
from ssmail.paper.report.contents import Report
from ssmail.paper.report.pages import html, markdown, write
from tests.paper.report.conftest import Written
from tests.paper.report.page_reader import Page

HOSTILE = (
    "<script>alert(1)</script>",
    "<!-- gone",
    "[here](https://example.org)",
    "![x](https://example.org/x.png)",
    "a | b | c",
    "`code` and ``more``",
    "**bold** __strong__ ~~gone~~ $x$",
    "&lt;b&gt; &#60;",
    "# heading",
    "- item",
    "1. item",
    "---",
    "> quote",
    "\\",
    "\\[x](y)\\",
    '" onmouseover="alert(1)',
    "two\n\n# lines",
    "\x1b[31m\u202e\u2066\x00",
    "\ud800",
)
FOUND = {"text", "code_inline", "strong_open", "strong_close"}
PLAIN = "Plain"
RUN = "`|<b>*``"  # of which pages show eight characters


def spoilt(report: Report, text: str) -> Report:
    """The report with the text wherever a database or an error may have put one."""
    runs = tuple(
        replace(
            run,
            method=text,
            environment=text,
            profile=text,
            host=text,
            device=text,
            package_version=text,
            git_commit=None,
            git_dirty=None,
            torch_version=text,
            dataset_hash=text,
        )
        for run in report.runs
    )
    figures = []
    for drawn in report.figures:
        source = drawn.provenance
        if source is None:
            figures.append(replace(drawn, lacks=text))
            continue
        sources = tuple(replace(run, curve=text, state=text, id=RUN) for run in source.runs)
        differs = {run.spec_hash: {"key": text} for run in source.runs}
        figures.append(replace(drawn, notes=(text, text), provenance=replace(source, runs=sources, differs=differs)))
    judgements = [replace(found, notes=(text,), command=text, runs=(RUN,)) for found in report.judgements]
    return replace(
        report,
        database=text,
        command=text,
        runs=runs,
        figures=tuple(figures),
        judgements=tuple(judgements),
        differs={key: {"key": text} for key in report.differs},
        unfinished=(text,),
    )


def blocks(text: str) -> list[tuple[str, str]]:
    """What a reader of Markdown with tables sees: the kind of each block, and what it says."""
    found = MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(text)
    return [(token.type, " ".join(said(token).split())) for token in found]


def said(token: Token) -> str:
    """The text of a block, in which all but bold text, code and the pictures of the figures is marked."""
    words = []
    for child in token.children or ():
        fine = child.type in FOUND or (child.type == "image" and str(child.attrs["src"]).startswith("figures/"))
        words.append(child.content if fine else f"({child.type}!) {child.content}")
    return "".join(words)


def check_markdown(written: Written, text: str) -> None:
    expected, found = (blocks(markdown(spoilt(written.report, value), written.folder)) for value in (PLAIN, text))
    shown = printable(text)
    assert sum(RUN in words for _, words in found) > 3
    assert found == [(kind, " ".join(words.replace(PLAIN, shown).split())) for kind, words in expected]


def check_html(written: Written, text: str) -> None:
    page = html(spoilt(written.report, text))
    assert Page(page).problems == []
    assert " ".join(printable(text).split()) in Page(page).words()
    assert all(character.isprintable() or character == "\n" for character in page)
    elements, of_plain = (re.findall(r"<[a-z]+", whole) for whole in (page, html(spoilt(written.report, PLAIN))))
    assert elements == of_plain


@pytest.mark.parametrize("text", HOSTILE)
def test_a_hostile_text_is_only_text(written: Written, text: str) -> None:
    check_markdown(written, text)
    check_html(written, text)


@settings(max_examples=20, derandomize=True, suppress_health_check=list(HealthCheck), deadline=None)
@given(text=st.text(st.sampled_from("\\`*_[]<>|~&#$-+=.)(!1a \n\x1b\"'"), min_size=1, max_size=12))
def test_any_text_is_only_text(written: Written, text: str) -> None:
    check_markdown(written, text)


@pytest.mark.parametrize("text", HOSTILE[:14])
def test_without_escaping_the_test_would_fail(written: Written, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ssmail.paper.report.pages._for_markdown", lambda value: value)
    with pytest.raises(AssertionError):
        check_markdown(written, text)


def test_an_ordinary_text_stays_readable(written: Written) -> None:
    text = markdown(written.report, written.folder)
    assert "mode_mse" in text
    assert "\\_" not in text
    assert "`ssmail reproduce --profile smoke --seeds 0-4`" in text


def test_both_pages_can_be_written_with_a_lone_surrogate(written: Written, tmp_path: Path) -> None:
    for path in write(spoilt(written.report, "\ud800"), tmp_path):
        assert "\\ud800" in path.read_text(encoding="utf-8")
