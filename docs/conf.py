"""Sphinx configuration of the documentation site: `make docs` builds it from the repository's root into build/docs."""

import sys
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent))

project = "ssmail"
author = "the authors of ssmail"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton", "reference"]

# The source folder is the repository's root, so that links between README.md and docs/ hold on GitHub and on the site.
root_doc = "README"
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "docs/**", "results/reference/*.md"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

myst_heading_anchors = 3

# A unit in a type, Unit("steps"), is no reference, but is looked up as one.
suppress_warnings = ["ref.python"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {
    "members": True,
    "ignore-module-all": True,  # what a package exports is documented where it is defined
    "exclude-members": "cache_ok, impl, inherit_cache, model_config",  # of SQLAlchemy and pydantic
}
python_maximum_signature_line_length = 100

smartquotes = False  # it would turn --env into a dash

html_theme = "furo"
html_title = "ssmail"
html_copy_source = False
copybutton_exclude = ".linenos, .gp, .go, .c1"  # comments are not part of a command

CONTENTS = """
```{toctree}
:hidden:
:caption: Use

docs/usage
docs/tutorial
docs/data-format
docs/python
docs/reference/commands
docs/reference/keys
docs/adapters
docs/extending
docs/database
docs/cluster
```

```{toctree}
:hidden:
:caption: The paper

docs/results
docs/paper
docs/claims
docs/experiments
results/reference/README
results/reference/report
```

```{toctree}
:hidden:
:caption: Develop

docs/architecture
docs/reference/api/index
CONTRIBUTING
CHANGELOG
SECURITY
```
"""


def _append_contents(app: Sphinx, name: str, source: list[str]) -> None:
    """Append the tables of contents to README.md, which GitHub shows without them."""
    if name == root_doc:
        source[0] += CONTENTS


def setup(app: Sphinx) -> None:
    """Register the hook with Sphinx."""
    app.connect("source-read", _append_contents)
