"""Method name -> learner: the table of methods."""

from collections.abc import Callable

from ssmail.training.adversarial import AdversarialLearner
from ssmail.training.cloning import CloningLearner
from ssmail.training.learning import Learner, Setting
from ssmail.training.references import ConstantVelocity, CopyLast, NothingToLearn
from ssmail.training.variational import VariationalLearner

LEARNERS: dict[str, Callable[[Setting], Learner]] = {
    "ssail": AdversarialLearner,
    "gail": AdversarialLearner,
    "wail": AdversarialLearner,
    "bc": CloningLearner,
    "nri": VariationalLearner,
    "dnri": VariationalLearner,
    "constant-velocity": lambda setting: NothingToLearn(ConstantVelocity(setting.integrator)),
    "copy-last": lambda setting: NothingToLearn(CopyLast()),
}


def make_learner(setting: Setting) -> Learner:
    """The learner of the spec's method, ready for its first epoch."""
    return LEARNERS[setting.spec.method](setting)
