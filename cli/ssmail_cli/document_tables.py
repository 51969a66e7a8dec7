"""Tables for documents: LaTeX (with the package booktabs) and Markdown.

What stands in a cell may come from a file of someone else, so no text is read as a command, as markup or as HTML.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ssmail.errors import printable

_MARKUP = re.compile(r"([\\`*_{}\[\]<>|~#&$])")


def latex(cells: Sequence[Sequence[str]], headings: Sequence[str], numeric: Sequence[bool]) -> str:
    """Return a tabular; columns of numbers are aligned to the right."""
    import pandas as pd

    frame = pd.DataFrame([list(map(printable, row)) for row in cells], columns=list(map(printable, headings)))
    form = "".join("r" if right else "l" for right in numeric)
    return frame.to_latex(index=False, escape=True, column_format=form).replace("±", r"$\pm$").rstrip("\n")


def markdown(cells: Sequence[Sequence[str]], headings: Sequence[str], numeric: Sequence[bool]) -> str:
    """Return a pipe table; columns of numbers are aligned to the right."""
    rules = ["---:" if right else "---" for right in numeric]
    lines = (map(markdown_text, headings), rules, *(map(markdown_text, row) for row in cells))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def is_numeric(rows: Sequence[Mapping[str, Any]], key: str) -> bool:
    """Return whether any row has a number under the key."""
    return any(isinstance(row.get(key), int | float) for row in rows)


def markdown_text(text: str) -> str:
    """Return the text as Markdown that shows it as it is."""
    return _MARKUP.sub(r"\\\1", printable(text))
