"""Fixed validation crops as pictures in the run: noisy, accumulated, denoised, reference, error."""

from __future__ import annotations

from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from trainer.modules.evaluation import Evaluated, noisy_input
from trainer.reports.pictures import comparison
from trainer.tracking import MLflowTracking


class ValidationPictures(Callback):
    """Log the first crops of every validation scene at chosen epochs.

    Every crop is one strip at equal exposure, with the metrics below it and a false-colour error map.

    Args:
        every_n_epochs: Least distance between two epochs that are pictured; of the epochs that are validated
            the first and the last always are.
        crops_per_scene: Number of crops of each scene.
    """

    def __init__(self, every_n_epochs: int = 5, crops_per_scene: int = 1) -> None:
        self.every_n_epochs = every_n_epochs
        self.crops_per_scene = crops_per_scene
        self._seen: dict[str, int] = {}
        self._pictured: int | None = None  # the last epoch that was
        self.due = False

    def state_dict(self) -> dict[str, Any]:
        """Return the epoch that was pictured last."""
        return {"pictured": self._pictured}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Keep the distance from the pictures of the run that is continued."""
        self._pictured = state_dict.get("pictured")

    def on_validation_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start with no crop pictured."""
        self._seen = {}
        self.due = self._is_due(trainer)
        if self.due:
            self._pictured = trainer.current_epoch

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Picture the crops of this batch that are still wanted."""
        logger = trainer.logger
        if not trainer.is_global_zero or not isinstance(logger, MLflowTracking) or not self.due:
            return
        wanted = [
            row for row, scene in enumerate(batch["scene"]) if self._seen.get(scene, 0) < self.crops_per_scene
        ]
        for row in wanted:
            scene = batch["scene"][row]
            number = self._seen.get(scene, 0)
            if number >= self.crops_per_scene:
                continue
            self._seen[scene] = number + 1
            picture = self._strip(pl_module, batch, row)
            logger.log_picture(picture, key=f"validation/{scene}-{number}", step=trainer.global_step)
            folder = logger.folder / "pictures"
            folder.mkdir(exist_ok=True)
            picture.save(folder / f"step{trainer.global_step:06}-{scene}-{number}.png")

    def _is_due(self, trainer: Trainer) -> bool:
        if trainer.sanity_checking or trainer.state.fn != "fit":
            return False
        epoch, last = trainer.current_epoch, self._pictured
        if last is None or last == epoch:  # an epoch may be validated more than once
            return True
        return epoch - last >= self.every_n_epochs or _final(trainer)

    @torch.no_grad()
    def _strip(self, module: LightningModule, batch: dict[str, Any], row: int) -> Any:
        one = {k: v[row : row + 1] for k, v in batch.items() if isinstance(v, torch.Tensor)}
        if "sample_channels" in batch:
            one["sample_channels"] = batch["sample_channels"]
        assert isinstance(module, Evaluated)
        net = module.net
        one, denoised = module.pictured(one)
        images = {
            "noisy": one.get("color"),
            "accumulated": noisy_input(net, one) if net.temporal else None,
            "denoised": denoised.color,
            "reference": one["reference"],
        }
        arrays = {
            name: None if image is None else image[0].float().permute(1, 2, 0).cpu().numpy()
            for name, image in images.items()
        }
        place = f"{batch['scene'][row]}, frame {int(batch['frame'][row])}"
        return comparison(**arrays, exposure=float(one["exposure"][0]), title=place)  # type: ignore[arg-type]


def _final(trainer: Trainer) -> bool:
    """Return whether no later epoch is validated."""
    if trainer.max_steps != -1 and trainer.global_step >= trainer.max_steps:
        return True
    last = -1 if trainer.max_epochs is None else trainer.max_epochs - 1
    following = trainer.current_epoch + (trainer.check_val_every_n_epoch or 1)
    return last >= 0 and following > last
