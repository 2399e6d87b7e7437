"""Layer embeddings: samples sorted into a few layers, which are filtered and composited.

Jacob Munkberg, Jon Hasselgren: "Neural Denoising with Layer Embeddings", Computer Graphics Forum 39(4), 2020,
doi:10.1111/cgf.14049.

A small network makes an embedding of every sample (20 numbers), a U-Net makes context of their mean in each
pixel. From there the paper compares:

    Layer        a share w_sl of every sample s goes to layer l (a softmax over layers, divided by the number
                 of samples); kernels from [sum_s w_sl E_s, context] splat each layer
    SampleSplat  kernels from [E_s, context] splat every sample
    PixelGather  the embedding is that of mean and variance of the samples, one kernel gathers mean radiance
    Optimized    Layer with 5x5 kernels on three levels in place of 17x17 ones

A layer holds radiance L, weight w, embedding and occupancy n_l = sum of w_k for k >= l: a sample in a layer
punches a hole into those in front of it. Radiance, weight and occupancy are splatted with the same kernel K:

    rad_l = (L_l K_l) / (n_l K_l + 1e-6),   alpha_l = (w_l K_l) / (n_l K_l + 1e-6),
    color = sum_l rad_l prod_{k < l} (1 - alpha_k)

Weights are exp(logit - largest logit of the pixel that splats, over layers or samples and taps); what leaves
the image is dropped. Where paper and the authors' code disagree:
- upsampling in the U-Net is nearest, as in the code; `upsampling="bilinear"` is the paper's;
- occupancy counts the layer itself and those behind it, as in code and pseudocode; equation 2 has those in
  front;
- `compositing="weighted"` (section 3.1) is not in the code. Read as sum_l L_l K_l / (sum_l w_l K_l + 1e-6);
  equation 6 as printed weighs radiance, which holds its weights already, a second time: `"printed"`, which
  does not keep a constant image constant;
- Optimized is not in the code either. Chosen here: the three shares of the levels are a softmax at every
  pixel, levels are enlarged bilinearly and halved by averaging 2x2, each has a kernel generator of its own.

Ours: radiance is multiplied by `exposure` first and the result divided; depth is divided by the largest of
the frame, motion by 128 pixels and the circle of confusion by 2, which gives the authors' numbers on their
frames; what the networks see is clipped to +-1000; samples that are not finite are dropped; and images are
padded with pixels without samples where the grid of the U-Net asks for it. Normals are taken as they come: in
world space here, in the space of the view in the authors' data, which need networks of their own.

Published, 8 spp, 36 test images (Tables 1 and 4; relMSE, SMAPE, SSIM, PSNR): PixelGather 0.0352, 0.0353,
0.938, 33.706; SampleSplat 0.0298, 0.0344, 0.941, 33.878; Layer alpha 0.0288, 0.0350, 0.941, 33.838; weighted
0.0295, 0.0350, 0.940, 33.812; Optimized 0.0351, 0.0361, 0.935, 33.435. What small forms reach here is in
configs/layers_sample.yaml.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor, nn

from models.blocks.layered import Composite, Layered, Sorted, occupancy, smaller
from models.blocks.per_sample import FEATURES, Frame, PerSample
from models.blocks.pointwise import Pointwise
from models.blocks.unet import UNet, Upsampling, enlarged
from models.denoiser import Buffers, Denoised
from models.ops.boxes import exporting
from models.ops.gather_inside import gather_inside
from models.ops.outgoing import send
from models.ops.padding import padded
from models.ops.per_sample import Seen
from models.ops.precision import wide
from models.ops.splat import splat_apart, splat_exp
from models.ops.streaming import scattered, streamed, strip_rows

EPSILON = 1e-6
"""Added to sums of weights before something is divided by them."""

_LAYER_ORDER = (
    "radiance",
    "normal",
    "depth",
    "motion",
    "coc",
    "diffuse_albedo",
    "specular_albedo",
    "roughness",
    "lens",
    "time",
)
_PIXEL_ORDER = (
    "radiance",
    "normal",
    "depth",
    "diffuse_albedo",
    "specular_albedo",
    "roughness",
    "lens",
    "time",
    "motion",
    "coc",
)

SCALES = 3
"""Levels on which Optimized filters."""

_TOGETHER = 4
"""Samples per pixel of which kernels exist at once in SampleSplat's inference, where all are too many."""

_NEVER = 1e30
"""Taken from logits of samples that do not count, so that they are no maximum."""

Compositing = Literal["alpha", "weighted", "printed"]


class _Sampled(PerSample):
    """What Layer and SampleSplat share: embeddings of samples, and context of their mean."""

    def _embedded(self, seen: Seen) -> Tensor:
        """Return embeddings (B, S, E, H, W)."""
        made = self.reducer(seen.features.flatten(0, 1))
        return wide(made).reshape(*seen.features.shape[:2], *made.shape[1:])

    def _contexts(self, frame: Frame) -> list[Tensor]:
        """Return the stages of the U-Net, from fine to coarse, for the mean embedding of each pixel."""

        def mean(samples: Tensor, *of_frame: Tensor) -> Tensor:
            seen = self._seen(samples, Frame(samples, *of_frame))
            total = (self._embedded(seen) * seen.counts).sum(1)
            return total / seen.counts.sum(1).clamp_min(1.0)

        numbers = self._images(frame) * (FEATURES + 3 * self.embedding)
        image = streamed(mean, [frame.samples], numbers, self.recompute, frame.numbers)
        return list(self.unet(padded(image, self.multiple, repeat=False)))


class Layer(_Sampled):
    """Samples sorted into layers, which are splatted and composited: Munkberg and Hasselgren 2020.

    Args:
        layers: Layers, from 2 to 5 in the paper; 1 is a splat of pixels.
        compositing: `alpha` front to back; `weighted` sum of layers; `printed`: that as equation 6 stands.
        kernel_size, width, levels, embedding, upsampling, recompute, fill: As for `PerSample`.

    Attributes:
        aux: Return each layer as `Denoised.aux` (`Layered.named`).

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    order = _LAYER_ORDER
    aux = False

    def __init__(
        self,
        layers: int = 2,
        compositing: Compositing = "alpha",
        kernel_size: int = 17,
        width: int = 64,
        levels: int = 5,
        embedding: int = 32,
        upsampling: Upsampling = "nearest",
        recompute: bool = True,
        fill: Mapping[str, float] | None = None,
    ) -> None:
        if compositing not in ("alpha", "weighted", "printed"):
            raise ValueError(f"compositing {compositing!r}; expected alpha, weighted or printed")
        if not 1 <= layers <= 5:
            raise ValueError(f"layers is {layers}; expected 1 to 5")
        self.layers, self.compositing = layers, compositing
        super().__init__(kernel_size, width, levels, embedding, upsampling, recompute, fill)

    def _add_heads(self) -> None:
        self.partitioner = Pointwise(self.embedding + self.context, 32, 16, self.layers, linear=True)
        super()._add_heads()

    def _numbers(self) -> int:
        """Return the larger of the U-Net's and those of layers: held, joined and splatted."""
        return max(super()._numbers(), self.context + self.layers * (2 * self.embedding + 10))

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `samples` (B, S, 20, H, W), the quantities of `samples` in their order, raw; optionally
                `exposure` (B,) and `depth_range` (B, 2).

        Raises:
            ValueError: Samples are missing or have another shape.
        """
        made = self.layered(buffers)
        return Denoised(made.color, None, made.named() if self.aux else None)

    def layered(self, buffers: Buffers) -> Layered:
        """Return what becomes of each layer, from the same buffers as `forward`; linear radiance."""
        frame = self._frame(buffers)
        contexts = self._contexts(frame)
        layers = self._sorted(frame, contexts[0])
        made = self._composited(layers, contexts)
        radiance, filtered, color = (
            self._cropped(part, buffers) for part in (layers.radiance, made.filtered, made.color)
        )
        height, width = color.shape[-2:]
        return Layered(radiance, filtered, made.alpha[..., :height, :width], color)

    def _sorted(self, frame: Frame, context: Tensor) -> Sorted:
        """Sort the samples into layers, which are padded to the grid of the U-Net."""
        height, width = frame.samples.shape[-2:]

        def shares(samples: Tensor, context: Tensor, *of_frame: Tensor) -> Tensor:
            seen = self._seen(samples, Frame(samples, *of_frame))
            embedding = self._embedded(seen)
            share = torch.softmax(wide(self.partitioner.joint(embedding, context)), 2)
            share = share * (seen.counts / seen.counts.sum(1, keepdim=True).clamp_min(1.0))
            layers = []
            for weight in share.split(1, 2):
                layers += [(weight * seen.radiance).sum(1), weight.sum(1), (weight * embedding).sum(1)]
            made = torch.cat(layers, 1)
            return made.reshape(made.shape[0], self.layers, -1, *made.shape[2:])

        numbers = self._images(frame) * (FEATURES + 3 * self.embedding + 48)
        context = context[..., :height, :width]
        tensors = [frame.samples, context]
        made = padded(
            streamed(shares, tensors, numbers, self.recompute, frame.numbers), self.multiple, repeat=False
        )
        return Sorted(*made.split([3, 1, self.embedding], 2))

    def _composited(self, layers: Sorted, contexts: list[Tensor]) -> Composite:
        assert isinstance(self.generator, Pointwise)
        return self._filtered(layers, contexts[0], self.generator)

    def _filtered(self, layers: Sorted, context: Tensor, generator: Pointwise) -> Composite:
        """Splat layers with the kernels of their embeddings and the context, and composite them."""
        taps, radius = self.kernel_size**2, self.kernel_size // 2
        values = torch.cat([layers.radiance, layers.weight, occupancy(layers.weight)], 2)

        def spread(embedding: Tensor, context: Tensor, values: Tensor) -> Tensor:
            logits = wide(generator.joint(embedding, context)[:, :, :taps])
            return splat_apart(values, logits, self.kernel_size, beyond=True)

        numbers = values.shape[0] * values.shape[1] * (taps + self.context)
        tensors = [layers.embedding, context, values]
        return self._finish(scattered(spread, tensors, radius, numbers, self.recompute))

    def _finish(self, sums: Tensor) -> Composite:
        """Composite layers of which radiance, weight and occupancy (B, L, 5, H, W) arrived at each pixel."""
        radiance, weight, occupied = sums.split([3, 1, 1], 2)
        if self.compositing == "alpha":
            filtered, alpha = radiance / (occupied + EPSILON), weight / (occupied + EPSILON)
            color, seen = torch.zeros_like(filtered[:, 0]), torch.ones_like(alpha[:, 0])
            for layer in range(self.layers):
                color = color + seen * filtered[:, layer]
                seen = seen * (1 - alpha[:, layer])
            return Composite(filtered, alpha, color)
        if self.compositing == "printed":
            radiance = radiance * weight
        total = weight.sum(1, keepdim=True) + EPSILON
        filtered = radiance / total
        return Composite(filtered, weight / total, filtered.sum(1))


class Optimized(Layer):
    """Layer (alpha) with 5x5 kernels on three levels and narrower networks: section 6 of the paper.

    Args:
        layers: Layers.
        kernel_size: Rows and columns of the kernels of every level, odd.
        width: Half the channels of the context; other widths follow from it.
        levels: How often the U-Net halves the resolution, at least 3.
        narrow_context: Half as many channels of the context at full resolution.
        embedding, upsampling, recompute, fill: As for `PerSample`.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    _widths = 4

    def __init__(
        self,
        layers: int = 2,
        kernel_size: int = 5,
        width: int = 64,
        levels: int = 5,
        embedding: int = 32,
        narrow_context: bool = False,
        upsampling: Upsampling = "nearest",
        recompute: bool = True,
        fill: Mapping[str, float] | None = None,
    ) -> None:
        if levels < SCALES:
            raise ValueError(f"levels is {levels}; Optimized filters on {SCALES} and needs as many")
        self.narrow_context = narrow_context
        super().__init__(layers, "alpha", kernel_size, width, levels, embedding, upsampling, recompute, fill)

    def _halo(self) -> int:
        # An enlarged pixel depends on its neighbour on that level, that on all which reach it, and what these
        # hold on the context of their pixels at full resolution.
        reach = self.kernel_size // 2 + 1
        return self.unet.halo([reach * 2 ** (SCALES - 1), *[reach] * (SCALES - 1)])

    def _unet(self, levels: int, upsampling: Upsampling) -> UNet:
        w = self.width
        if self.narrow_context:
            self.context = w
        encoder, decoder = (2 * w, 4 * w, 8 * w, 8 * w), (8 * w, 4 * w, 2 * w, w, w)
        return UNet(
            self.embedding, w // 2, encoder[: levels - 1], decoder[-levels:], self.context, upsampling
        )

    def _generator(self) -> nn.Module:
        hidden, taps = self.width // 2, self.kernel_size**2
        contexts = (self.context, self.width, 2 * self.width)
        return nn.ModuleList(
            Pointwise(self.embedding + context, hidden, hidden, taps + (0 if level else SCALES), linear=True)
            for level, context in enumerate(contexts)
        )

    def _composited(self, layers: Sorted, contexts: list[Tensor]) -> Composite:
        assert isinstance(self.generator, nn.ModuleList)
        shares = self._shares(layers.embedding[:, :1], contexts[0])
        color, finest = torch.zeros_like(layers.radiance[:, 0]), None
        for level, generator in enumerate(self.generator):
            assert isinstance(generator, Pointwise)
            made = self._filtered(smaller(layers, 2**level), contexts[level], generator)
            finest = made if finest is None else finest
            image = enlarged(made.color, 2**level, "bilinear") if level else made.color
            color = color + image * shares[:, level : level + 1]
        assert finest is not None
        return Composite(finest.filtered, finest.alpha, color)

    def _shares(self, embedding: Tensor, context: Tensor) -> Tensor:
        """Return the share of each level in every pixel (B, 3, H, W), from the first layer's generator."""
        assert isinstance(self.generator, nn.ModuleList)
        generator, taps = self.generator[0], self.kernel_size**2
        assert isinstance(generator, Pointwise)

        def shares(embedding: Tensor, context: Tensor) -> Tensor:
            return torch.softmax(wide(generator.joint(embedding, context)[:, 0, taps:]), 1)

        return streamed(shares, [embedding, context], embedding.shape[0] * self.context, self.recompute)


class SampleSplat(_Sampled):
    """A kernel for every sample: the paper's form of Gharbi et al. 2019. Arguments as `PerSample`."""

    order = _PIXEL_ORDER

    generator: Pointwise

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Layer.forward`."""
        frame = self._frame(buffers)
        height, width = frame.samples.shape[-2:]
        sums = self._arrived(frame, self._contexts(frame)[0][..., :height, :width])
        return Denoised(self._cropped(sums[:, :3] / (sums[:, 3:] + EPSILON), buffers))

    def _arrived(self, frame: Frame, context: Tensor) -> Tensor:
        """Return radiance and number of samples, weighted, that arrive at each pixel, (B, 4, H, W)."""
        taps, size, batch = self.kernel_size**2, self.kernel_size, frame.samples.shape[0]

        def kernels(samples: Tensor, context: Tensor, *of_frame: Tensor) -> tuple[Tensor, Tensor]:
            seen = self._seen(samples, Frame(samples, *of_frame))
            logits = wide(self.generator.joint(self._embedded(seen), context))
            logits = logits + (seen.counts - 1) * _NEVER
            return torch.cat([seen.radiance, seen.counts], 2), logits

        def together(samples: Tensor, context: Tensor, *of_frame: Tensor) -> Tensor:
            values, logits = kernels(samples, context, *of_frame)
            return splat_exp(values, logits, size, beyond=True).total

        def apart(samples: Tensor, context: Tensor, *of_frame: Tensor) -> Tensor:
            sums = None
            for some in samples.split(_TOGETHER, 1):
                sums = send(sums, *kernels(some, context, *of_frame))
            assert sums is not None
            return sums.arrived(size, beyond=True)

        spread, numbers = together, self._images(frame) * (taps + self.context)
        if not (exporting() or torch.is_grad_enabled()) and strip_rows(context, numbers) < size:
            spread, numbers = apart, batch * (4 * taps + _TOGETHER * (taps + self.context))
        tensors = [frame.samples, context]
        return scattered(spread, tensors, size // 2, numbers, self.recompute, frame.numbers)


class PixelGather(PerSample):
    """A kernel for every pixel, from mean and variance of its samples; filters their mean.

    Arguments as `PerSample`.
    """

    order = _PIXEL_ORDER

    reads = 2 * FEATURES
    generator: Pointwise

    def _halo(self) -> int:
        return max(self.unet.halo([0]), self.kernel_size // 2)

    def _numbers(self) -> int:
        return max(super()._numbers(), self.kernel_size**2 + 3 * self.embedding + self.context)

    @property
    def exported_bytes_per_pixel(self) -> int:  # type: ignore[override]
        """All logits and what becomes of them at once: measured 8530 at 256x256 with 17x17 kernels."""
        return 32 * self.kernel_size**2

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Layer.forward`."""
        frame = self._frame(buffers)

        def moments(samples: Tensor, *of_frame: Tensor) -> Tensor:
            seen = self._seen(samples, Frame(samples, *of_frame))
            count = seen.counts.sum(1).clamp_min(1.0)
            mean = seen.features.sum(1) / count
            spread = ((seen.features - mean[:, None]).square() * seen.counts).sum(1) / count
            return torch.cat([seen.radiance.sum(1) / count, seen.counts.amax(1), mean, spread], 1)

        numbers = self._images(frame) * 3 * FEATURES
        made = padded(
            streamed(moments, [frame.samples], numbers, self.recompute, frame.numbers),
            self.multiple,
            repeat=False,
        )
        image, counts, features = made.split([3, 1, 2 * FEATURES], 1)
        embedding = wide(self.reducer(features))
        context = self.unet(embedding)[0]

        def kernels(embedding: Tensor, context: Tensor) -> Tensor:
            return wide(self.generator.joint(embedding[:, None], context))[:, 0]

        numbers = image.shape[0] * (self.kernel_size**2 + self.context)
        logits = streamed(kernels, [embedding, context], numbers, self.recompute)
        sums = gather_inside(torch.cat([image, counts], 1), logits, self.kernel_size)
        return Denoised(self._cropped(sums[:, :3] / sums[:, 3:].clamp_min(1e-20), buffers))
