"""Exports the best weights of a run and registers them as a model version."""

from __future__ import annotations

import sys
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from trainer.tracking import MLflowTracking


class ExportBest(Callback):
    """At the end of `fit`: best checkpoint → ONNX and TorchScript, with parity, into the run.

    The model is registered as soon as the tracking store takes it. An export that fails says why and leaves
    the run as it is; `trainer export` repeats it. A denoiser that is never exported stays a checkpoint.

    Args:
        formats: What to write; any of `onnx`, `torchscript`.
        register: Register the ONNX model as a version of the logger's `registered_model`.
    """

    def __init__(self, formats: tuple[str, ...] = ("onnx", "torchscript"), register: bool = True) -> None:
        self.formats = formats
        self.register = register

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Export on the first rank."""
        logger = trainer.logger
        if not trainer.is_global_zero or not isinstance(logger, MLflowTracking):
            return
        checkpoints = logger.folder / "checkpoints"
        chosen = next(
            (p for p in (checkpoints / "best.ckpt", checkpoints / "last.ckpt") if p.is_file()), None
        )
        if chosen is None:
            return
        logger.log_file(chosen, "checkpoints")
        if reason := getattr(getattr(pl_module, "net", None), "no_export", ""):
            print(f"{chosen} is not exported: {reason}", file=sys.stderr)
            return
        for format in self.formats:
            self._try(logger, chosen, format)

    def _try(self, logger: MLflowTracking, checkpoint: Path, format: str) -> None:
        """Export in one format; one that fails does not keep the others from being written."""
        try:
            self._export(logger, checkpoint, format)
        except (ValueError, OSError) as error:
            logger.set_tags({"export.error": str(error)[:500]})
            print(
                f"The export failed: {error}\nThe checkpoint is {checkpoint}; repeat with "
                f"`trainer export --model {checkpoint} --format {format} --output DIR`.",
                file=sys.stderr,
            )

    def _export(self, logger: MLflowTracking, checkpoint: Path, format: str) -> None:
        from trainer.export import SUFFIXES, export
        from trainer.loading import resolve

        loaded = resolve(str(checkpoint))
        path = logger.folder / "export" / f"{logger.registered_model or 'model'}{SUFFIXES[format]}"
        parity = export(loaded.model, path, format, source=loaded.source, force=True)  # type: ignore[arg-type]
        print(f"exported {path} (differs from eager by {parity.error:.1e})", file=sys.stderr)
        logger.log_file(path, "export")
        logger.set_tags({f"export.{format}.parity": f"{parity.error:.3e}"})
        if format == "onnx" and self.register and logger.registered_model:
            from trainer.export.register import weights_of

            logger.log_model(path, logger.registered_model, weights_of(loaded.model))  # type: ignore[arg-type]
