"""LightningModules."""

from trainer.modules.adversarial import Adversarial
from trainer.modules.branches import Branches
from trainer.modules.regression import Regression
from trainer.modules.sequence import Sequence

__all__ = ["Adversarial", "Branches", "Regression", "Sequence"]
