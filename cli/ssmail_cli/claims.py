"""`ssmail claims`: what the stored runs say about each claim of the paper."""

import math
import shutil
import textwrap
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ssmail.errors import command_line
from ssmail.paper.results import CLAIMS, FIGURES
from ssmail_cli import completion, options
from ssmail_cli.output import WIDEST, Format, chosen_format, note, print_rows, print_table, say, short, write_json

if TYPE_CHECKING:
    from ssmail.paper.claims import Part, Sample
    from ssmail.paper.judgement import Judgement

SUMMARY = {
    "claim": "claim",
    "profile": "runs of",
    "verdict": "verdict",
    "p": "p",
    "corrected": "of all eight",
    "p_holm": "p (Holm)",
    "more_seeds": "more seeds",
}
SPARE = ("profile", "more_seeds", "p", "corrected", "p_holm")  # what a narrow terminal leaves out first
NAMES = f"C1 to C{len(CLAIMS)}, or {', '.join(FIGURES[figure].alias for figure in CLAIMS)}"
LEGEND = (
    "Verdicts are at 0.05 for each claim. p is one-sided and counts the parts, the next columns count all eight "
    "claims; docs/claims.md has the tests."
)


def claims(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="CLAIM",
            help=f"Only these claims, with their parts and the value of every seed: {NAMES}.",
            autocompletion=completion.claims,
        ),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="CLAIM[,CLAIM...]", help="The same, with commas between.", show_default="all"),
    ] = None,
    profile: options.FigureProfile = None,
    as_json: options.Json = False,
    form: options.Output = None,
    db: options.Database = options.DEFAULT_DATABASE,
) -> None:
    """Judge the paper's claims C1 to C8 by the stored runs: supported, contradicted or inconclusive.

    Prints a table of the verdicts, and of the claims that are named what each is decided by. Each part of a claim has a
    statistic and an exact rank test, both fixed beforehand (docs/claims.md), and the verdict is also corrected for all
    eight claims by Holm's method. Parts beside a claim compare with other methods and decide nothing. Every seed
    counts. CSV has a row for each part, JSON everything.
    """
    from ssmail.paper.judgement import judge

    store = options.open_store(db)
    wanted = options.named(names, only)
    judgements = judge(store, profile, wanted)
    kind = chosen_format(as_json, form)
    if kind is Format.JSON:
        write_json([_as_json(found) for found in judgements], None)
        return
    if kind is Format.CSV or wanted:
        for found in judgements:
            note(*(f"{found.claim.name}: {remark}" for remark in found.notes))
    if kind is Format.CSV:
        print_rows([row for found in judgements for row in _part_rows(found)], {}, kind)
        return
    if kind.of_document:
        print_rows([_summary(found) for found in judgements], SUMMARY, kind)
        return
    print_table([_summary(found) for found in judgements], SUMMARY, spare=SPARE)
    say(*_wrapped(LEGEND, 0))
    for found in judgements if wanted else ():
        say("", *_claim_lines(found))
    if not wanted:
        command = command_line("ssmail", "claims", "C4", *options.database_words(db))
        say(*_wrapped(f"`{command}` shows what C4 is decided by: its parts, their tests, every seed.", 0))


def _summary(found: "Judgement") -> dict[str, Any]:
    decision = found.decision
    unsettled = "runs missing" if any(part.reason for part in decision.parts) else "no number"
    return {
        "claim": f"{found.claim.name} {found.claim.alias}",
        "profile": found.profile,
        "verdict": found.verdict.value,
        "p": decision.p,
        "corrected": found.corrected.value,
        "p_holm": found.p_holm,
        "more_seeds": unsettled if decision.more_seeds is None else decision.more_seeds,
    }


def _as_json(found: "Judgement") -> dict[str, Any]:
    claim, decision = found.claim, found.decision
    return {
        "claim": claim.name,
        **{key: value for key, value in asdict(claim).items() if key != "name"},
        "verdict": found.verdict.value,
        "p": decision.p,
        "p_for": decision.p_for,
        "p_against": decision.p_against,
        "corrected_verdict": found.corrected.value,
        "p_holm": found.p_holm,
        "more_seeds": decision.more_seeds,
        "command": found.command,
        "profile": found.profile,
        "settings": found.settings,
        "runs": found.runs,
        "notes": found.notes,
        "parts": [_part_value(part) for part in decision.every_part],
    }


def _part_value(part: "Part") -> dict[str, Any]:
    return {
        "statement": part.statement,
        "verdict": part.verdict.value,
        "beside": part.beside,
        "effect": part.effect.value,
        "low": part.effect.low,
        "high": part.effect.high,
        "effect_is": part.effect_is,
        "p_for": part.p_for,
        "p_against": part.p_against,
        "more_seeds": part.more_seeds,
        "reason": part.reason,
        "statistic": part.statistic,
        "test": part.test,
        "samples": [asdict(sample) for sample in part.samples],
    }


def _part_rows(found: "Judgement") -> Iterator[dict[str, Any]]:
    """Yield the parts of a claim as rows of the CSV."""
    decision = found.decision
    verdict = {"claim_verdict": found.verdict.value, "claim_p": decision.p, "claim_p_holm": found.p_holm}
    claim = {"claim": found.claim.name, "alias": found.claim.alias, **verdict}
    yield from (claim | _part_value(part) for part in decision.every_part)


def _claim_lines(found: "Judgement") -> list[str]:
    claim = found.claim
    lines = _wrapped(f"{claim.name} {claim.alias} (section {claim.section}, {claim.figure}): {found.verdict}", 0)
    lines += _wrapped(claim.sentence, 2)
    for part in found.decision.parts:
        lines += _part_lines(part)
    if found.decision.beside:
        lines += _wrapped("beside the claim, without a part in its verdict:", 2)
    for part in found.decision.beside:
        lines += _part_lines(part)
    if found.runs:
        lines += _wrapped(f"runs of profile {found.settings}: {' '.join(run[:8] for run in found.runs)}", 2)
    if found.command:
        lines += _wrapped(f"next: {found.command}", 2)
    return lines


def _part_lines(part: "Part") -> list[str]:
    lines = _wrapped(f"- {part.statement}: {part.verdict}{_lack(part)}", 2)
    lines += _wrapped(part.statistic, 6) + _wrapped(part.test, 6)
    if not part.reason:
        value, low, high = (short(float(number), 3) for number in part.effect)
        chances = f"p\xa0=\xa0{short(part.p_for, 2)} in favour, {short(part.p_against, 2)} against"
        lines += _wrapped(f"{part.effect_is}: {value}, 90 % interval {low} to {high}; {chances}", 6)
    for sample in part.samples:
        lines += _wrapped(_seeds(sample), 6)
    return lines


def _lack(part: "Part") -> str:
    """Return what an inconclusive part lacks."""
    if part.reason:
        return f", {part.reason}"
    if part.more_seeds is None:
        return ", and no number of seeds is expected to settle it"
    return f", {part.more_seeds} more seed{'s' * (part.more_seeds > 1)} may settle it" if part.more_seeds else ""


def _seeds(sample: "Sample") -> str:
    pairs = zip(sample.seeds, sample.values, strict=True)
    values = ", ".join(f"{seed}:\xa0{'unknown' if math.isnan(value) else short(value, 3)}" for seed, value in pairs)
    return f"{sample.label}, seed by seed: {values or 'no runs'}"


def _wrapped(text: str, indent: int) -> list[str]:
    """Return the text as lines that the terminal can show, broken at spaces alone, but at no non-breaking one."""
    width = min(shutil.get_terminal_size().columns, WIDEST)
    margin = " " * indent
    lines = textwrap.wrap(
        text, width, initial_indent=margin, subsequent_indent=margin, break_on_hyphens=False, break_long_words=False
    )
    return [line.replace("\xa0", " ") for line in lines]
