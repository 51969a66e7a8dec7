"""Discriminator output -> reward, one pure function per method. 0 = generated, 1 = expert; higher is always better."""

from torch import Tensor


def ssail_reward(output: Tensor) -> Tensor:
    """D itself (Alg. 1: SAC increases the expectation of D)."""
    return output
