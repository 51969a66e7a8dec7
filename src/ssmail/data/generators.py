"""The environments that make their own expert sets."""

from ssmail.config.sections import DataSpec
from ssmail.data import letters, yjunction
from ssmail.data.trajectories import ExpertSet


def generate(data: DataSpec) -> ExpertSet:
    """The expert set of the environment whose parameters `data` has: one of ssmail.config.spec.GENERATED_ENVIRONMENTS.

    Raises InputError for parameters that no set can have.
    """
    if data.letters is not None:
        return letters.generate(data.letters)
    assert data.yjunction is not None
    return yjunction.generate(data.yjunction)
