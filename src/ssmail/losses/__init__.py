"""Loss functions: pure functions of tensors. Most return the scalar to minimize and its terms by name."""

from torch import Tensor

Terms = dict[str, Tensor]
PER_SEED = (-3, -2, -1)  # the axes B, T and N of a mean; an axis of S seeds in front of them remains
