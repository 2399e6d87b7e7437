"""What every training module shares: the network, validation crops, whole test frames, checkpoints."""

from __future__ import annotations

import inspect
import warnings
from typing import Any

from lightning.pytorch import LightningModule
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from models.denoiser import Denoised, Denoiser, select
from trainer.metrics.collection import METRICS, SceneMetrics

Batch = dict[str, Any]


class EpochMean:
    """Mean of the losses of an epoch that outlives an interruption; Lightning's own forgets what was before.

    Args:
        epoch: Epoch of the sums.
        total: Sum of the losses so far.
        count: Number of them.
    """

    def __init__(self, epoch: int = -1, total: float = 0.0, count: int = 0) -> None:
        self.epoch, self.count = epoch, count
        self._total: Tensor | float = total

    def add(self, epoch: int, loss: Tensor) -> None:
        """Add a loss; the first one of another epoch begins anew. Nothing waits for the device."""
        if epoch != self.epoch:
            self.epoch, self.count, self._total = epoch, 0, 0.0
        self.count += 1
        self._total = self._total + loss.detach().float()

    @property
    def mean(self) -> float:
        """Mean of what was added."""
        return float(self._total) / self.count

    def state(self) -> dict[str, Any]:
        """Return the constructor's arguments."""
        return {"epoch": self.epoch, "total": float(self._total), "count": self.count}


class Evaluated(LightningModule):
    """A denoiser that is validated on crops and tested on whole frames.

    Metrics see exposed radiance: radiance times the frame's `exposure`, so that scenes in different units
    weigh alike. The network's output stays in the units of its input.

    A subclass calls `keep_arguments` in its constructor, and defines the training step, the optimisers and
    `validation_loss`.

    Args:
        net: The denoiser to train.

    Attributes:
        clips: Training and validation samples are clips, (B, T, C, H, W), instead of images.
    """

    clips = False

    def __init__(self, net: Denoiser) -> None:
        super().__init__()
        self.net = net
        self.scores: SceneMetrics | None = None
        self.input_scores: SceneMetrics | None = None
        self._epoch_loss = EpochMean()

    def keep_arguments(self) -> None:
        """Save the constructor's arguments as hyper-parameters.

        Lightning would rather not save modules; in a configuration they are class paths, which rebuild the
        network from the checkpoint alone.
        """
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Attribute '.*' is an instance of `nn.Module`")
            frame = inspect.currentframe()
            assert frame is not None
            self.save_hyperparameters(frame=frame.f_back)

    def forward(self, batch: Batch) -> Denoised:
        """Denoise a batch of the data module."""
        result = self.net(select(self.net, batch))
        assert isinstance(result, Denoised)
        return result

    def pictured(self, batch: Batch) -> tuple[Batch, Denoised]:
        """Return the images of a validation batch that pictures are made of, and their results."""
        return batch, self(batch)

    def exposed(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Return exposed output and exposed reference, float32 (B, 3, H, W)."""
        exposure = batch["exposure"].float().reshape(-1, 1, 1, 1)
        return self(batch).color.float() * exposure, batch["reference"].float() * exposure

    def validation_loss(self, batch: Batch, output: Tensor, target: Tensor) -> Tensor:
        """Return the loss of a validation batch.

        Args:
            batch: The batch.
            output: Exposed radiance that the network made of it, (B, 3, H, W).
            target: Exposed reference.
        """
        raise TypeError(f"{type(self).__name__} does not define validation_loss")

    def count_loss(self, loss: Tensor) -> None:
        """Add the loss of a step to the mean of the epoch, `train/loss_epoch`."""
        self._epoch_loss.add(self.current_epoch, loss)

    def on_train_epoch_end(self) -> None:
        """Log the mean loss of the epoch."""
        if self._epoch_loss.count:
            self.log("train/loss_epoch", self._epoch_loss.mean, rank_zero_only=True)

    def on_validation_start(self) -> None:
        """Do not send buffers of the network with each batch: ranks may have one batch more or less."""
        self._send_buffers(False)

    def on_validation_end(self) -> None:
        """Send buffers again where training goes on."""
        self._send_buffers(True)

    def _send_buffers(self, send: bool) -> None:
        model = self.trainer.strategy.model
        if isinstance(model, DistributedDataParallel):
            model.require_forward_param_sync = send

    def on_validation_epoch_start(self) -> None:
        """Start new sums."""
        self.scores = self._new_scores("validation")

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Score one batch of fixed crops."""
        output, target = self.exposed(batch)
        loss = self.validation_loss(batch, output, target)
        self.log("val/loss", loss, batch_size=len(batch["scene"]), sync_dist=True)
        assert self.scores is not None
        self.scores.update(output, target, batch["scene"])

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of every scene and their average."""
        assert self.scores is not None
        self._log_table("val", self.scores.compute())

    def on_test_epoch_start(self) -> None:
        """Start new sums, for the output and for the noisy input beside it."""
        self.scores = self._new_scores("test")
        self.input_scores = self._new_scores("test")

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Score whole frames, denoised and as they came."""
        output, target = self.exposed(batch)
        assert self.scores is not None
        assert self.input_scores is not None
        self.scores.update(output, target, batch["scene"])
        exposure = batch["exposure"].float().reshape(-1, 1, 1, 1)
        self.input_scores.update(noisy_input(self.net, batch) * exposure, target, batch["scene"])

    def on_test_epoch_end(self) -> None:
        """Log both tables."""
        assert self.scores is not None
        assert self.input_scores is not None
        self._log_table("test", self.scores.compute())
        self._log_table("input", self.input_scores.compute())

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep objects out of the checkpoint, so that it is read without pickle.

        From a configuration the hyper-parameters are class paths, and the checkpoint alone rebuilds the
        network; a module that was made in Python is loaded with `load_from_checkpoint(path, net=…)`.
        """
        checkpoint["epoch_loss"] = self._epoch_loss.state()
        saved = checkpoint.get("hyper_parameters", {})
        checkpoint["hyper_parameters"] = {key: value for key, value in saved.items() if _is_plain(value)}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on with the sums of an epoch that was interrupted."""
        self._epoch_loss = EpochMean(**checkpoint.get("epoch_loss", {}))

    def _new_scores(self, split: str) -> SceneMetrics:
        scenes = self.trainer.datamodule.scenes(split)  # type: ignore[attr-defined]
        return SceneMetrics(scenes).to(self.device)

    def _log_table(self, prefix: str, table: dict[str, dict[str, float]]) -> None:
        # The sums were reduced over the ranks already; every rank logs the same numbers.
        for scene, row in table.items():
            for name in METRICS:
                key = f"{prefix}/{name}" if scene == "average" else f"{prefix}/{name}/{scene}"
                self.log(key, row[name], sync_dist=False, batch_size=1)


def _is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_is_plain(item) for item in value.values())
    if isinstance(value, list | tuple):
        return all(_is_plain(item) for item in value)
    return value is None or isinstance(value, str | int | float | bool)


def noisy_input(net: Denoiser, batch: Batch) -> Tensor:
    """Return the radiance (B, 3, H, W) that a denoiser starts from: accumulated where it uses that."""
    if "irradiance" in net.inputs:
        return batch["irradiance"].float() * batch["albedo"].float()
    return batch["color"].float()
