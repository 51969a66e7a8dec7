"""--artifacts: where checkpoints are kept instead of beside the database."""

from typing import Annotated, Any

import typer


def _known_artifacts(place: str | None) -> str | None:
    """Return the place as given. Raises InputError for one that cannot be one, or whose driver is not installed."""
    from ssmail.store.artifact_storage import ArtifactStorage

    if place:
        ArtifactStorage(place)
    return place


def _artifacts_option(text: str) -> Any:
    return typer.Option(
        "--artifacts", envvar="SSMAIL_ARTIFACTS", metavar="DIR|URL", callback=_known_artifacts, help=text
    )


Artifacts = Annotated[
    str | None,
    _artifacts_option("Keep checkpoints in a folder or URL (s3://..., as fsspec has them) that all machines reach."),
]
ArtifactsGiven = Annotated[str | None, _artifacts_option("The folder or URL where training kept its checkpoints.")]
