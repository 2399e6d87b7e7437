"""How a network fuses its filter kernels, for `trainer denoise --weights`: asked for, and as pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from models import WSKP, MultiResolutionWSKP
from trainer.configs import UsageError
from trainer.export.artifact import Artifact
from trainer.loading import Loaded

if TYPE_CHECKING:
    from PIL.Image import Image

    from trainer.denoising import Result

SHEET, FUSED = "kernels", "fused"
"""Names of the sheet of all pictures, and of that of the result."""


def return_weights(loaded: Loaded) -> None:
    """Let a model return what each of its kernels makes as `Denoised.aux`.

    Raises:
        UsageError: It fuses no kernels, or is an exported file.
    """
    model, name = loaded.model, loaded.source.reference
    needed = "--weights needs a checkpoint of WSKP or MultiResolutionWSKP"
    if isinstance(model, Artifact):
        raise UsageError(
            f"{needed}; {name} is an exported file, which holds the image only: give the checkpoint it was "
            "made from"
        )
    if not isinstance(model, WSKP | MultiResolutionWSKP):
        raise UsageError(f"{needed}; {name} holds {type(model).__name__}, which fuses no kernels")
    model.aux = True


def weight_pictures(result: Result) -> dict[str, Image]:
    """Return name → picture: three for every kernel, the result as `fused`, and all on one sheet, `kernels`.

    Args:
        result: With what kernels make as `aux` (`models.ops.kernel_views`).
    """
    from trainer.reports.fusion import fusion_sheet, kernel_pictures
    from trainer.reports.pictures import tone_map

    color, exposure = result.frame.buffers["color"], result.exposure
    images = {"noisy": result.noisy}
    if result.accumulated is not None:
        images["accumulated"] = result.accumulated
    images[FUSED] = color
    if result.reference is not None:
        images["reference"] = result.reference
    sheet = fusion_sheet(images, result.aux, exposure, result.frame.label)
    return {**kernel_pictures(result.aux, exposure), FUSED: tone_map(color, exposure), SHEET: sheet}
