"""A small network with buffers, the running means of a batch normalisation."""

from torch import nn

from models.denoiser import Denoised, Denoiser


class Normalised(Denoiser):
    """Adds a normalised correction to radiance."""

    inputs = ("color",)
    halo = 1

    def __init__(self):
        super().__init__()
        self.correct = nn.Sequential(nn.Conv2d(3, 3, 3, padding=1), nn.BatchNorm2d(3))

    def forward(self, buffers):
        color = buffers["color"]
        return Denoised(color + 0.01 * self.correct(color.clamp(0, 10)))
