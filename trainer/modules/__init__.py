"""LightningModules."""

from trainer.modules.regression import Regression

__all__ = ["Regression"]
