"""The discriminator of ACFM and AFGSA: a VGG-style critic of log-space images.

Bing Xu, Junfei Zhang, Rui Wang, Kun Xu, Yong-Liang Yang, Chuan Li, Rui Tang: "Adversarial Monte Carlo
Denoising with Conditioned Auxiliary Feature Modulation", ACM Transactions on Graphics 38(6), 2019,
doi:10.1145/3355089.3356547. Jiaqi Yu, Yongwei Nie, Chengjiang Long, Wenju Xu, Qing Zhang, Guiqing Li: "Monte
Carlo Denoising via Auxiliary Feature Guided Self-Attention", ACM Transactions on Graphics 40(6), 2021,
doi:10.1145/3478513.3480565.

Ten convolutions, alternating 3x3 with stride 1 and 4x4 with stride 2, each but the first batch-normalised,
then two linear layers: one number per image, unbounded, higher for what looks like a reference. The two
papers only name it; layers, widths and entry names follow the authors' code, 14,502,281 parameters at
128x128. The codes differ in the start: PyTorch's default in AFGSA's, Kaiming normal without biases in ACFM's.

Batch normalisation makes the score of an image depend on the other images of its batch. The gradient penalty
asks for the slope of each image's own score, so with it the penalty mixes samples, and each process of a
distributed run normalises by its own batch. The published networks do so; `norm="instance"` (each channel of
each image by its own mean and variance) and `norm="none"` score every image alone, as WGAN-GP advises.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

SLOPE = 0.2
"""Of the leaky ReLU after every layer but the last."""
HIDDEN = 100
"""Width of the linear layer between the features and the score."""
STEPS = 5
"""How often the image is halved."""

Norm = Literal["batch", "instance", "none"]


class Critic(nn.Module):
    """Scores images; trained to score references higher than what a denoiser makes.

    It computes in float32 also under mixed precision, since the gradient penalty differentiates its gradient.

    Args:
        size: Height and width of the images in pixels, a multiple of 32 (the authors: 96, 128, 192).
        norm: `batch` as published; `instance` and `none` keep the images of a batch apart. Only `batch`
            keeps running statistics; both others are the same in training and evaluation.
        width: Channels of the first convolutions; they grow to eight times as many.
        init: `default`: PyTorch's (AFGSA's code); `kaiming`: normal with fan-in, zero biases (ACFM's).

    Raises:
        ValueError: `size` is no positive multiple of 32, too small for its norm (the last maps of 32 pixels
            are single pixels, which instance normalisation makes 0), or an option is unknown.
    """

    def __init__(
        self,
        size: int = 128,
        norm: Norm = "batch",
        width: int = 64,
        init: Literal["default", "kaiming"] = "default",
    ) -> None:
        super().__init__()
        if size < 2**STEPS or size % 2**STEPS:
            raise ValueError(f"size must be a positive multiple of {2**STEPS}, got {size}")
        if width < 1:
            raise ValueError(f"width must be at least 1, got {width}")
        if norm == "instance" and size == 2**STEPS:
            raise ValueError(f"norm='instance' needs a size of at least {2 ** (STEPS + 1)}, got {size}")
        if init not in ("default", "kaiming"):
            raise ValueError(f"init must be 'default' or 'kaiming', got {init!r}")
        self.size = size
        self.norm = norm
        widths = [3]
        for step in range(STEPS):
            widths += [width * min(2**step, 8)] * 2
        self.features = nn.ModuleList(
            _layer(widths[i], widths[i + 1], halves=i % 2 == 1, norm=norm if i else "none")
            for i in range(2 * STEPS)
        )
        flat = widths[-1] * (size // 2**STEPS) ** 2
        self.classifier = nn.Sequential(nn.Linear(flat, HIDDEN), nn.LeakyReLU(SLOPE), nn.Linear(HIDDEN, 1))
        if init == "kaiming":
            self._start_kaiming()

    def forward(self, image: Tensor) -> Tensor:
        """Return one score per image.

        Args:
            image: (B, 3, size, size), log(1 + radiance) or what else the denoiser is compared in.

        Returns:
            (B,) scores without bounds, float32 (float64 where image and parameters are).

        Raises:
            ValueError: The image has another size.
        """
        expected = (3, self.size, self.size)
        if image.ndim != 4 or tuple(image.shape[1:]) != expected:
            raise ValueError(
                f"the critic was built for images (B, {', '.join(map(str, expected))}), got "
                f"{tuple(image.shape)}; set its size to the crop size of the training data"
            )
        with torch.autocast(image.device.type, enabled=False):
            maps = image if image.dtype == torch.float64 else image.float()
            for layer in self.features:
                maps = functional.leaky_relu(layer(maps), SLOPE)
            scores: Tensor = self.classifier(maps.flatten(1))
        return scores.squeeze(1)

    def _start_kaiming(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(module.weight)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)


def _layer(inputs: int, outputs: int, halves: bool, norm: Norm) -> nn.Sequential:
    """Return a convolution and its normalisation; the activation has no entry in the authors' names."""
    kernel, stride = (4, 2) if halves else (3, 1)
    layers: list[nn.Module] = [nn.Conv2d(inputs, outputs, kernel, stride, 1)]
    if norm == "batch":
        layers.append(nn.BatchNorm2d(outputs))
    elif norm == "instance":
        layers.append(nn.InstanceNorm2d(outputs, affine=True))
    elif norm != "none":
        raise ValueError(f"norm must be 'batch', 'instance' or 'none', got {norm!r}")
    return nn.Sequential(*layers)
