"""Reading an HTML page strictly: what is not nested as HTML asks for is found."""

from html.parser import HTMLParser

VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}
PARENTS = {  # where an element must stand directly, as far as the report has such
    "li": {"ul", "ol"},
    "td": {"tr"},
    "th": {"tr"},
    "tr": {"thead", "tbody"},
    "thead": {"table"},
    "tbody": {"table"},
    "dt": {"div", "dl"},
    "dd": {"div", "dl"},
    "summary": {"details"},
    "figcaption": {"figure"},
}
NOT_IN_P = {
    "p",
    "ul",
    "ol",
    "dl",
    "div",
    "table",
    "section",
    "figure",
    "details",
    "pre",
    "blockquote",
    "h1",
    "h2",
    "h3",
}


class Page(HTMLParser):
    """What is in a page, and what is wrong with it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.problems: list[str] = []
        self.ids: list[str] = []
        self.addresses: list[tuple[str, str]] = []  # (attribute, value)
        self.text: list[tuple[str, str]] = []  # (element, its own text)
        self._open: list[str] = []
        self.feed(text)
        self.close()
        self.problems += [f"<{name}> is not closed" for name in self._open]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        parent = self._open[-1] if self._open else ""
        if tag in PARENTS and parent not in PARENTS[tag]:
            self.problems.append(f"<{tag}> stands in <{parent}>, line {self.getpos()[0]}")
        if tag in NOT_IN_P and "p" in self._open:
            self.problems.append(f"<{tag}> stands in <p>, line {self.getpos()[0]}")
        if len({name for name, _ in attrs}) < len(attrs):
            self.problems.append(f"<{tag}> has an attribute twice, line {self.getpos()[0]}")
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("href", "src", "action", "data", "poster", "srcset"):
                self.addresses.append((name, value or ""))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open[-1] != tag:
            self.problems.append(f"</{tag}> does not close <{self._open[-1] if self._open else ''}>")
        if tag in self._open:
            while self._open.pop() != tag:
                pass

    def handle_data(self, data: str) -> None:
        self.text.append((self._open[-1] if self._open else "", data))

    def words(self) -> str:
        """All that people read, on one line."""
        shown = (data for name, data in self.text if name not in ("style", "script"))
        return " ".join(" ".join(shown).split())
