"""Discriminator output -> reward, one pure function per method. 0 = generated, 1 = expert; higher is always better.

Each reward rises with the discriminator's output, so climbing it moves the policy towards what is called expert.
"""

from torch import Tensor, nn


def ssail_reward(output: Tensor) -> Tensor:
    """D itself (Alg. 1: SAC increases the expectation of D)."""
    return output


def gail_reward(logit: Tensor) -> Tensor:
    """-log(1 - sigmoid(logit)), where sigmoid(logit) is the probability of "expert".

    Ho and Ermon (2016) minimise E_pi[log D] with D = 1 on the policy. With the labels of ssmail their D is 1 -
    sigmoid(logit), so the reward to maximise is -log(1 - sigmoid(logit)) = softplus(logit), which is never negative;
    softplus does not overflow.
    """
    return nn.functional.softplus(logit)


def wail_reward(output: Tensor) -> Tensor:
    """The Wasserstein critic's value: it is trained to be high on the expert (Xiao et al. 2019)."""
    return output
