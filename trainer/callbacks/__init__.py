"""Lightning callbacks."""

from trainer.callbacks.checkpoints import AtomicCheckpointIO, BestCheckpoint, LastCheckpoint
from trainer.callbacks.exporting import ExportBest
from trainer.callbacks.finite import FiniteGuard
from trainer.callbacks.mirror import MirrorRun
from trainer.callbacks.pictures import ValidationPictures
from trainer.callbacks.progress import TrainingProgress
from trainer.callbacks.tags import RunTags

__all__ = [
    "AtomicCheckpointIO",
    "BestCheckpoint",
    "ExportBest",
    "FiniteGuard",
    "LastCheckpoint",
    "MirrorRun",
    "RunTags",
    "TrainingProgress",
    "ValidationPictures",
]
