"""What the report says, and that the page is one of its own."""

import base64
import re
from dataclasses import replace
from pathlib import Path

import pytest

from ssmail.config.experiments import build_spec
from ssmail.errors import InputError
from ssmail.paper.claims import Verdict
from ssmail.paper.judgement import judge
from ssmail.paper.report.contents import gather
from ssmail.paper.report.drawing import Drawn, draw
from ssmail.paper.report.pages import html, markdown, write
from ssmail.store import Store
from tests.paper.report.conftest import COMMAND, ERRORS, Written, add
from tests.paper.report.page_reader import Page


def test_the_page_is_valid_and_every_link_leads_somewhere(written: Written) -> None:
    page = Page(written.html)
    assert page.problems == []
    assert len(page.ids) == len(set(page.ids))
    inner = [value.removeprefix("#") for name, value in page.addresses if name == "href"]
    assert len(inner) > 50
    assert set(inner) <= set(page.ids)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("<ul><b>x</ul></b>", "</ul> does not close <b>"),
        ("<div><li>x</li></div>", "<li> stands in <div>, line 1"),
        ("<p><table></table></p>", "<table> stands in <p>, line 1"),
        ("<section>", "<section> is not closed"),
        ('<a id="x" id="y"></a>', "<a> has an attribute twice, line 1"),
    ],
)
def test_an_invalid_page_is_caught(text: str, problem: str) -> None:
    assert problem in Page(text).problems


def test_nothing_is_fetched(written: Written) -> None:
    page = Page(written.html)
    assert all(value.startswith(("#", "data:image/png;base64,")) for _, value in page.addresses)
    outside = re.sub(r'src="data:[^"]*"', "", written.html)
    assert not re.search(r"https?:|//\w|url\(|@import|fetch\(|XMLHttpRequest|<link|<iframe", outside)
    assert "default-src 'none'; img-src data:;" in outside


def test_the_figure_is_inside(written: Written) -> None:
    (image,) = (value for name, value in Page(written.html).addresses if name == "src")
    assert base64.b64decode(image.partition(",")[2]) == (written.folder / "figures" / "fig4_stability.png").read_bytes()


def test_verdicts_and_figures_come_first_and_figures_have_captions(written: Written) -> None:
    places = [
        written.html.index(f'<section id="{name}">') for name in ("verdicts", "figures", "claims", "runs", "about")
    ]
    assert places == sorted(places)
    caption = written.report.figures[0].caption
    assert caption.startswith("Training error on Y-Junction over epochs")
    assert caption in Page(written.html).words()
    assert caption in written.markdown
    navigation = written.html[written.html.index("<nav>") : written.html.index("</nav>")]
    assert re.findall(r'href="#(\w+)"', navigation) == [
        *("verdicts", "figures", "fig4", "fig7", "claims", "runs", "specs", "about")
    ]


def test_notes_advise_no_option_that_report_lacks(store: Store, add_other_specs: None, tmp_path: Path) -> None:
    drawn = draw("fig4", store, None, tmp_path, ["svg"])
    told = markdown(gather(store, [drawn], [], "ssmail report"), tmp_path)
    assert "1 other stored spec left out (\\`ssmail plot fig4 --runs\\` chooses)" in told


@pytest.fixture
def add_other_specs(store: Store) -> None:
    """Two specs of ssail."""
    for overrides in ([], ["sac.gamma=0.5"]):
        add(store, build_spec("ssail", "yjunction", "smoke", overrides), 0, 0.01)


def test_verdicts_effects_and_every_seed(written: Written) -> None:
    words = Page(written.html).words()
    assert "1 supported , 0 contradicted , 7 inconclusive ." in words
    (c3,) = (found for found in written.report.judgements if found.claim.name == "C3")
    assert c3.verdict is Verdict.SUPPORTED
    section = Page(written.html[written.html.index('<section id="C3">') : written.html.index('<section id="C4">')])
    for part in c3.decision.parts:
        value, low, high = (f"{number:.3g}".replace("inf", "∞") for number in part.effect)
        assert f"{part.statement} ✓ supported" in section.words()
        assert f"{value} [{low}, {high}]" in section.words()
    for part in c3.decision.beside:  # with the usual beta, which the runs of figure 4 have
        assert f"beside the claim: {part.statement}" in section.words()
        assert f"| beside the claim: {part.statement} | {part.verdict} |" in written.markdown
    assert len(c3.decision.beside) == 4
    for value in (0.0, 0.15, 1.0):
        for seed, error in enumerate(ERRORS[value]):
            assert f"seed {seed}: {error:.3g}" in section.words()
    runs = [link for _, link in section.addresses if link.startswith("#run-")]
    assert {link.removeprefix("#run-") for link in runs} == {run[:8] for run in c3.runs}


def test_a_diverged_run_and_one_that_failed_are_told(written: Written) -> None:
    words = Page(written.html).words()
    assert "1 diverged, 23 finished" in words
    assert "seed 1: diverged" in words
    assert "wail, seed 3 failed: <b>out of memory</b> | killed" in words  # as text
    assert "<b>out of memory" not in written.html
    assert r"- wail, seed 3 failed: \<b\>out of memory\</b\> \| killed" in written.markdown
    assert "Not drawn: there is no data/mocap.npz." in words


def test_every_run_has_its_spec_and_what_tells_it_from_others(written: Written) -> None:
    page = Page(written.html)
    for run in written.report.runs:
        assert f"run-{run.name}" in page.ids
        assert f"spec-{run.spec_hash}" in page.ids
    assert len([name for name in page.ids if name.startswith("spec-")]) == len(written.report.specs) == 6
    (chosen,) = (key for key, run in written.report.specs.items() if run.spec["curriculum"]["beta"] == 0.15)
    start = written.html.index(f'<details id="spec-{chosen}">')
    spec = Page(written.html[start : written.html.index("</details>", start) + len("</details>")])
    assert spec.problems == []
    assert "yjunction, ssail, smoke + curriculum.beta=0.15: beta 0.15" in spec.words()
    assert "edge_types: 2" in spec.words()
    assert "name: trajectory-forcing" in spec.words()


def test_markdown_has_the_same_with_figures_beside_it(written: Written) -> None:
    text = written.markdown
    assert "](figures/fig4_stability.png)" in text
    assert (written.folder / "figures" / "fig4_stability.png").exists()
    (row,) = (line for line in text.splitlines() if line.startswith("| C3 beta |"))
    assert "| **supported** |" in row
    for line in text.splitlines():
        if line.startswith("|") and "---" not in line:
            assert len(re.findall(r"(?<!\\)\|", line)) in (5, 7, 9), line
    assert "squared scaled units): 0: 0.002, 1: 0.0021, 2: 0.0022, 3: 0.0023, 4: 0.0024\n" in text
    assert "### fig7 noise\n\nNot drawn: there is no data/mocap.npz." in text
    assert f"- To reproduce: `{COMMAND}`" in text


def test_figures_that_are_no_pictures_are_linked_all_the_same(written: Written, tmp_path: Path) -> None:
    fig4 = written.report.figures[0]
    files = (tmp_path / "a b" / "fig4.pdf", tmp_path / "a b" / "fig4.csv")
    report = replace(written.report, figures=(replace(fig4, files=files),))
    assert "](../a%20b/fig4.pdf)" in markdown(report, tmp_path / "deep")


def test_an_empty_store_has_a_report(store: Store) -> None:
    report = gather(store, [Drawn("fig4", lacks="nothing to draw.")], judge(store), "ssmail report")
    page = Page(html(report))
    assert page.problems == []
    assert "0 supported , 0 contradicted , 8 inconclusive ." in page.words()


def test_a_folder_that_cannot_be_written(written: Written) -> None:
    with pytest.raises(InputError, match="/proc/none cannot be written"):
        write(written.report, Path("/proc/none"))


def test_the_database_is_named_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store.open(tmp_path / "results" / "ssmail.db")
    monkeypatch.chdir(tmp_path)
    assert gather(store, [], [], COMMAND).database == "results/ssmail.db"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert gather(store, [], [], COMMAND).database == str(tmp_path / "results" / "ssmail.db")
