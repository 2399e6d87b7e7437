"""A callback that notes which process is which rank, and gives a test time between two steps."""

import os
import time
from pathlib import Path

from lightning.pytorch import Callback


class SlowSteps(Callback):
    def on_train_start(self, trainer, pl_module):
        Path(f"rank-{trainer.global_rank}.pid").write_text(str(os.getpid()))

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        time.sleep(0.3)
