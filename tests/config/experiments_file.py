"""The shipped experiments.yaml, and variations of it."""

from pathlib import Path

import yaml

from ssmail.config.experiments_file import load_experiments

SHIPPED = load_experiments()


def write(path: Path, **changes: object) -> Path:
    """The shipped file with some sections replaced."""
    sections = ("defaults", "environments", "methods", "profiles", "ablations", "figures", "controls")
    content = {name: getattr(SHIPPED, name) for name in sections} | changes
    path.write_text(yaml.safe_dump({name: value for name, value in content.items() if value is not None}))
    return path
