"""LightningModules."""

from trainer.modules.adversarial import Adversarial
from trainer.modules.branches import Branches
from trainer.modules.regression import Regression

__all__ = ["Adversarial", "Branches", "Regression"]
