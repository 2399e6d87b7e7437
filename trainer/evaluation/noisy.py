"""The input itself as a method, so that tables show what denoising gains."""

from __future__ import annotations

from models.denoiser import Buffers, Denoised, Denoiser


class Noisy(Denoiser):
    """Returns the radiance of the frame alone."""

    inputs = ("color",)
    bytes_per_pixel = 12

    def forward(self, buffers: Buffers) -> Denoised:
        """Return `color`."""
        self.check(buffers)
        return Denoised(buffers["color"])
