"""Critics: the bridge between tensordicts of experience and the Gaussian process."""

from torch_gprl.critics.action_value import GPActionValue
from torch_gprl.critics.returns import k_step_returns

__all__ = ["GPActionValue", "k_step_returns"]
