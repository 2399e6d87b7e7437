"""What a person sees while training: rate, waiting, loss, validation and time left."""

from __future__ import annotations

import sys
import time
from typing import Any, NamedTuple

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text


class _Left(ProgressColumn):
    """Time left of the whole training."""

    def render(self, task: Task) -> Text:
        left = task.fields.get("left")
        return Text("" if left is None else f"{duration(left)} left", style="cyan")


class _Mark(NamedTuple):
    """Where training stood at the last report."""

    time: float
    patches: int
    waited_s: float
    read: int
    downloaded: int


def duration(seconds: float) -> str:
    """Return a duration as a person says it: `48 s`, `7:05`, `2:10:00`."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    minutes, hours = whole // 60 % 60, whole // 3600
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"


class TrainingProgress(ProgressBar):
    """Progress of fit, validate and test: a live bar on a terminal, plain lines elsewhere.

    Logs `throughput/patches_per_s` and `throughput/waiting` (share of the time since the last report that
    was spent waiting for data) every `log_every_n_steps` steps. Where the shards lie at a URL also
    `throughput/read_mb_per_s`, the samples of batches as they are stored, and
    `throughput/downloaded_mb_per_s`, what came over the network, both of this rank times the number of ranks.

    Args:
        plain_interval_s: Seconds between two plain lines.
    """

    def __init__(self, plain_interval_s: float = 15.0) -> None:
        super().__init__()
        self.plain_interval_s = plain_interval_s
        self._enabled = True
        self._bar: Progress | None = None
        self._task: Any = None
        self._printed = 0.0
        self._started = 0.0
        self._first_step = 0
        self._mark = _Mark(0.0, 0, 0.0, 0, 0)
        self._patches = 0
        self._rate = 0.0
        self._waiting = 0.0
        self._traffic: tuple[float, float] | None = None  # MB/s read and downloaded, of shards at a URL
        self._loss: float | None = None
        self._gap: float | None = None

    def disable(self) -> None:
        """Show nothing (Lightning calls this on all ranks but the first)."""
        self._enabled = False

    def enable(self) -> None:
        """Show progress."""
        self._enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self._started = self._printed = time.monotonic()
        self._first_step = trainer.global_step
        self._mark = _Mark(self._started, 0, waited(trainer), *traffic(trainer))
        self._patches = 0
        if self._enabled and sys.stderr.isatty():
            self._bar = Progress(
                TextColumn("[bold]{task.description}"), BarColumn(bar_width=24),
                TextColumn("{task.completed:.0f}/{task.total:.0f} steps"), TimeElapsedColumn(), _Left(),
                TextColumn("{task.fields[numbers]}"),
                console=Console(stderr=True), refresh_per_second=4,
            )  # fmt: skip
            self._task = self._bar.add_task(
                "training", total=total_steps(trainer), completed=trainer.global_step, numbers="", left=None
            )
            self._bar.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Count patches, and report at intervals."""
        self._patches += len(batch["scene"]) * trainer.world_size
        step, every = trainer.global_step, trainer.log_every_n_steps  # type: ignore[attr-defined]
        due = step % every == 0
        if due or batch_idx + 1 == trainer.num_training_batches:
            self._measure(trainer)
            pl_module.log_dict(self._throughput(), rank_zero_only=True)
        if self._enabled and (self._bar is not None or due):
            self._read(outputs)
        self._show(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop the training clock: validation is no waiting."""
        self._validation_began = time.monotonic()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the validation score of the epoch."""
        pause = time.monotonic() - self._validation_began
        self._mark = self._mark._replace(time=self._mark.time + pause)
        if self._enabled and not trainer.sanity_checking and trainer.state.fn == "fit":
            self._line(f"epoch {trainer.current_epoch}: {self._scores(trainer)}")

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Close the bar."""
        self._close()
        if self._enabled:
            self._line(f"trained {trainer.global_step} steps in {duration(time.monotonic() - self._started)}")

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Close the bar, so that the message stands below it; say how an interrupted run continues."""
        self._close()
        if self._enabled and isinstance(exception, KeyboardInterrupt) and trainer.state.fn == "fit":
            self._line(f"interrupted at step {trainer.global_step}; continue with --ckpt_path last")

    def print(self, *args: Any, **kwargs: Any) -> None:
        """Print above the bar."""
        if self._bar is not None:
            self._bar.console.print(*args)
        elif self._enabled:
            print(*args, file=sys.stderr)

    def _read(self, outputs: Any) -> None:
        """Keep what a training step returned: its loss, and the critics' gap where there are some."""
        numbers = outputs if isinstance(outputs, dict) else {} if outputs is None else {"loss": outputs}
        if numbers.get("loss") is not None:
            self._loss = float(numbers["loss"])
        if numbers.get("gap") is not None:
            self._gap = float(numbers["gap"])

    def _measure(self, trainer: Trainer) -> None:
        last = self._mark
        now = _Mark(time.monotonic(), self._patches, waited(trainer), *traffic(trainer))
        elapsed = max(now.time - last.time, 1e-9)
        self._rate = (now.patches - last.patches) / elapsed
        self._waiting = min(max((now.waited_s - last.waited_s) / elapsed, 0.0), 1.0)
        if getattr(trainer.train_dataloader, "remote", False):
            ranks = trainer.world_size / elapsed / 1e6
            self._traffic = (
                (now.read - last.read) * ranks,
                (now.downloaded - last.downloaded) * ranks,
            )
        self._mark = now

    def _throughput(self) -> dict[str, float]:
        found = {"throughput/patches_per_s": self._rate, "throughput/waiting": self._waiting}
        if self._traffic is not None:
            read, downloaded = self._traffic
            found |= {"throughput/read_mb_per_s": read, "throughput/downloaded_mb_per_s": downloaded}
        return found

    def _numbers(self, trainer: Trainer) -> list[str]:
        parts = []
        if self._rate:  # nothing is measured before the first report
            parts = [f"{self._rate:.1f} patches/s", f"waiting {self._waiting:.1%}"]
            if self._traffic is not None:
                read, downloaded = self._traffic
                parts.append(f"shards {read:.1f} MB/s, {downloaded:.1f} MB/s downloaded")
        if self._loss is not None:
            parts.append(f"loss {self._loss:.4f}")
        if self._gap is not None:
            parts.append(f"gap {self._gap:.3g}")
        if "val/psnr_wskp" in trainer.callback_metrics:
            parts.append(f"val {float(trainer.callback_metrics['val/psnr_wskp']):.2f} dB")
        return parts

    def _scores(self, trainer: Trainer) -> str:
        names = {"val/psnr_wskp": "PSNR {:.2f} dB", "val/ssim_wskp": "SSIM {:.4f}", "val/loss": "loss {:.4f}"}
        have = trainer.callback_metrics
        return "validation " + ", ".join(t.format(float(have[n])) for n, t in names.items() if n in have)

    def _show(self, trainer: Trainer) -> None:
        if not self._enabled:
            return
        now, step, total = time.monotonic(), trainer.global_step, total_steps(trainer)
        done = max(step - self._first_step, 1)
        left = (now - self._started) / done * max(total - step, 0)
        if self._bar is not None:
            self._bar.update(
                self._task, completed=step, left=left, numbers=" | ".join(self._numbers(trainer)),
                description=f"epoch {trainer.current_epoch}",
            )  # fmt: skip
        elif now - self._printed > self.plain_interval_s:
            self._printed = now
            self._line(
                " | ".join(
                    [
                        f"epoch {trainer.current_epoch} step {step}/{total:.0f}",
                        *self._numbers(trainer),
                        f"{duration(left)} left",
                    ]
                )
            )

    def _line(self, text: str) -> None:
        self.print(text)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def total_steps(trainer: Trainer) -> float:
    """Return the number of optimiser steps of the whole training."""
    return float(trainer.estimated_stepping_batches)


def waited(trainer: Trainer) -> float:
    """Return the seconds that the training loader has made its caller wait, 0 where it does not count."""
    return float(getattr(trainer.train_dataloader, "waited_s", 0.0))


def traffic(trainer: Trainer) -> tuple[int, int]:
    """Return the bytes of shards that batches took so far, and those that were downloaded; 0 where the loader
    does not count."""
    loader = trainer.train_dataloader
    return int(getattr(loader, "read_bytes", 0)), int(getattr(loader, "downloaded_bytes", 0))
