"""Intel Open Image Denoise as an outside reference under the contract of a denoiser.

Attila Áfra, *Intel Open Image Denoise*, https://www.openimagedenoise.org. The library and its weights come
with `pyoidn` (the extra `[oidn]`); nothing of it is trained or exported here. It chooses its own exposure and
cuts large images itself.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import torch
from torch import Tensor

from models.denoiser import Buffers, Denoised, Denoiser

Auxiliary = Literal["noisy", "clean", "prefiltered", "none"]
Quality = Literal["high", "balanced", "fast"]


class OIDN(Denoiser):
    """Open Image Denoise, filter `RT`, HDR.

    Args:
        auxiliary: What albedo and normal are: `noisy`, as rendered; `clean`, known to be free of noise;
            `prefiltered`, as rendered, denoised first by the library and then taken as clean, which is what
            its manual advises for final frames; `none`, they are not read.
        quality: `high`, `balanced` or `fast`.

    Raises:
        ValueError: `pyoidn` is not installed, or an argument is none of these.
    """

    bytes_per_pixel = 300  # one call on the whole image; the library bounds its own memory by tiles
    no_export = "it is a library of its own"

    def __init__(self, auxiliary: Auxiliary = "noisy", quality: Quality = "high") -> None:
        super().__init__()
        for name, value, known in (
            ("auxiliary", auxiliary, get_args(Auxiliary)),
            ("quality", quality, get_args(Quality)),
        ):
            if value not in known:
                raise ValueError(f"OIDN: {name} is {value!r}, expected one of {', '.join(known)}")
        self.auxiliary, self.quality = auxiliary, quality
        self.inputs = ("color",) if auxiliary == "none" else ("color", "albedo", "normal")
        self._library = _library()

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `color` (B, 3, H, W) linear radiance, `albedo` (B, 3, H, W) and `normal` (B, 3, H, W) in
                world or camera space unless `auxiliary` is `none`. On the CPU.
        """
        self.check(buffers)
        return Denoised(
            torch.stack(
                [self._image({n: t[i] for n, t in buffers.items()}) for i in range(len(buffers["color"]))]
            )
        )

    def _image(self, buffers: dict[str, Tensor]) -> Tensor:
        images = {name: buffers[name].float().movedim(0, 2).contiguous() for name in self.inputs}
        images["color"] = images["color"].clamp_min(0)
        if "albedo" in images:
            images["albedo"] = images["albedo"].clamp(0, 1)
            images["normal"] = images["normal"].clamp(-1, 1)
        if self.auxiliary == "prefiltered":
            for name in ("albedo", "normal"):
                images[name] = self._prefiltered(name, images[name])
        out: Tensor = self._library.denoise(
            **images, hdr=True, clean_aux=self.auxiliary in ("clean", "prefiltered"), quality=self.quality
        )
        return out.movedim(2, 0)

    def _prefiltered(self, name: str, image: Tensor) -> Tensor:
        library, result = self._library, torch.empty_like(image)
        with library.Device() as device:
            device.commit()
            with library.Filter(device, library.OIDN_FILTER_TYPE_RT) as only:
                only.set_image(name, image, library.OIDN_FORMAT_FLOAT3)
                only.set_image(library.OIDN_IMAGE_OUTPUT, result, library.OIDN_FORMAT_FLOAT3)
                only.commit()
                only.execute()
            if (error := device.get_error()) is not None:
                raise ValueError(f"OIDN: {name} could not be filtered: {error}")
        return result


def _library() -> Any:
    try:
        import pyoidn
    except ImportError as error:
        raise ValueError('OIDN needs Open Image Denoise: pip install "penumbra-denoise[oidn]"') from error
    return pyoidn
