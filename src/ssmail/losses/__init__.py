"""Loss functions: pure functions of tensors. Most return the scalar to minimize and its terms by name."""

from torch import Tensor

Terms = dict[str, Tensor]
