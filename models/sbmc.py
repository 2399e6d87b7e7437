"""SBMC, or Multisteps: samples splatted with kernels of their own, after three rounds of context.

Michaël Gharbi, Tzu-Mao Li, Miika Aittala, Jaakko Lehtinen, Frédo Durand: "Sample-based Monte Carlo Denoising
using a Kernel-Splatting Network", ACM Transactions on Graphics 38(4), 2019, doi:10.1145/3306346.3322954.

In each of three rounds a fully connected network makes an embedding of every sample, from its features in the
first round and from [embedding, context] of the round before in the others; a U-Net makes context of the mean
embedding of each pixel. From the last embedding and context come 21x21 logits per sample, and a pixel is the
softmax mean of all samples that reach it (`models.ops.arrivals`). All convolutions are weight-normalised;
34.80 M parameters, and one gain for each of their output channels.

Follows the authors' code. Ours, and what an option restores:
- features: all 93 of the code (path depth 6; the layer embedding paper counts 74) and 3 of the camera are the
  default. `features` chooses groups (`GROUPS`) or single quantities, so that frames which hold less can be
  used; light that is not split is `radiance`, where diffuse and specular are `light`. The camera's numbers
  are the frame number `thin_lens`, and 0 without it. Frames of `trainer render samples` have radiance, lens,
  time, normal, depth, diffuse albedo (and specular albedo and roughness, which SBMC does not read) and the
  camera; what only the authors' renderer writes, and the layout `sbmc` reads, are both hits apart, light that
  is split, visibility, and the paths: probabilities, light directions and kinds of bounces;
- border: the code lets offsets from outside the image take weight, as black, and then cuts off the outer 10
  pixels. Here they are left out: the same pixels inside, and bright ones at the border. `outside="weigh"` is
  the code's. Training compares without these pixels (`crop`);
- depth, aperture and focus distance are divided by the largest depth of the frame (`depth="raw"`: as they
  are; the authors' data are divided by ten scene radii), radiance is multiplied by `exposure` and the result
  divided, features are clipped to +-1000, and samples that are not finite are dropped;
- `filter="gather"` and `average=True`, a network that sees pixels instead of samples, are the ablations.

Memory does not grow with the number of samples: whatever belongs to a sample is computed from its features
where it is needed, for some rows at a time, three times over (in training once more, in the backward pass).

Training: half of the squared error relative to reference^2 + 0.01, both after x / (1 + x) (`training_pairs`
gives these); Adam 1e-4, gradients clipped to norm 1000, batch 1, 2 to 8 samples, crops of 128 pixels.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from data.buffers import SAMPLES, THIN_LENS, sample_channels
from models.blocks.multisteps import Chain, Context, NormalisedConv
from models.blocks.sbmc_features import GROUPS, averaged, expanded, seen_samples
from models.denoiser import Buffers, Denoised, Denoiser, Pair, select
from models.ops.arrivals import Arrivals, Outside, gathered, merge, splatted, together, with_outside
from models.ops.boxes import exporting
from models.ops.gather import pad_border
from models.ops.guides import farthest, finite
from models.ops.loops import overlapped
from models.ops.padding import padded
from models.ops.per_sample import FEATURE_LIMIT, Seen, sample_depths
from models.ops.precision import wide
from models.ops.streaming import streamed
from models.ops.tonemap import exposed

_NEVER = 1e4
"""Taken from logits of samples that do not count."""

_ROWS = 1 << 22
"""Numbers of kernels and hidden layers that exist at once: 16 MB."""


class Frame(NamedTuple):
    """Samples (B, S, C, H, W); exposure, largest depth (B, 1, 1, 1), camera."""

    samples: Tensor
    exposure: Tensor
    farthest: Tensor
    camera: Tensor | None

    @property
    def numbers(self) -> tuple[Tensor, ...]:
        """What belongs to the frame and not to a pixel."""
        return (self.exposure, self.farthest, *([] if self.camera is None else [self.camera]))

    def rows(self, samples: Tensor, others: Sequence[Tensor]) -> tuple[Frame, Sequence[Tensor]]:
        """Return the frame of some rows, and their contexts: `others` without `numbers`, which come last."""
        split = len(others) - len(self.numbers)
        exposure, largest, *camera = others[split:]
        return Frame(samples, exposure, largest, camera[0] if camera else None), others[:split]


class SBMC(Denoiser):
    """Sample-based denoiser of Gharbi et al. 2019.

    Args:
        features: Groups (keys of `GROUPS`) and quantities (`data.buffers.SAMPLE_BUFFERS`) that are read;
            among them `light` or `radiance`.
        camera: Also read aperture radius, focus distance and field of view (`thin_lens`).
        rounds: Rounds of embedding and context.
        width: Channels of embeddings and contexts; the U-Nets double it on every level.
        levels: Resolutions of the U-Nets.
        kernel_size: Rows and columns of the kernels, odd.
        filter: Samples splat, or pixels gather samples.
        average: Average the samples of a pixel first.
        outside: In splats, offsets from outside the image are left out (`drop`) or take weight, as black
            (`weigh`); in gathers they always do.
        crop: Training leaves out the pixels that a kernel reaches from the border.
        depth: Distances are `relative` to the largest of the frame, or `raw`.
        recompute: In training, compute what belongs to single samples again in the backward pass.
        fill: Quantity → the constant that stands for it where samples lack it.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    inputs = (SAMPLES,)
    per_sample = True
    bytes_once = 1 << 26  # strips of kernels and hidden layers

    def __init__(
        self,
        features: Sequence[str] = tuple(GROUPS),
        camera: bool = True,
        rounds: int = 3,
        width: int = 128,
        levels: int = 3,
        kernel_size: int = 21,
        filter: Literal["splat", "gather"] = "splat",
        average: bool = False,
        outside: Outside = "drop",
        crop: bool = True,
        depth: Literal["relative", "raw"] = "relative",
        recompute: bool = True,
        fill: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__()
        _check_choice("filter", filter, ("splat", "gather"))
        _check_choice("outside", outside, ("drop", "weigh"))
        _check_choice("depth", depth, ("relative", "raw"))
        if kernel_size < 3 or kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd and at least 3, got {kernel_size}")
        if min(rounds, width, levels) < 1:
            raise ValueError(f"rounds, width and levels must be at least 1, got {rounds}, {width}, {levels}")
        self.samples, self.fill = expanded(features), dict(fill or {})
        self.kernel_size, self.filter, self.average = kernel_size, filter, average
        self.outside, self.crop, self.depth, self.recompute = outside, crop, depth, recompute
        self.camera, self.width, self.multiple = camera, width, 2 ** (levels - 1)
        self.frame_numbers = ("exposure", "depth_range", *([THIN_LENS] if camera else []))
        channels = len(sample_channels(*self.samples)) + (3 if camera else 0)
        self.embeddings = nn.ModuleList(
            Chain(before, width, width, width, slope=0.0)
            for before in (channels, *[2 * width] * (rounds - 1))
        )
        self.unets = nn.ModuleList(Context(width, levels) for _ in range(rounds))
        self.regressor = Chain(2 * width, width, width, kernel_size**2, slope=0.01)
        # Measured at 512x512: 6400. A gather has the kernels of a whole image.
        self.bytes_per_pixel = 4 * width * (rounds + 11)
        if filter == "gather":
            self.bytes_per_pixel += 5 * (kernel_size**2 + 3 * width)
        self.halo = kernel_size // 2
        for _ in range(rounds):
            self.halo = Context.reach(self.halo, levels)

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `samples` (B, S, C, H, W), the quantities of `samples` in their order, raw; optionally
                `exposure` (B,), `depth_range` (B, 2) and `thin_lens` (B, 3).

        Raises:
            ValueError: Samples are missing or have another shape.
        """
        return Denoised(self._filtered(self._frame(buffers), buffers) / self.exposure(buffers))

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return exposed output and reference after x / (1 + x), without the border if `crop` says so."""
        buffers = select(self, batch)
        output = self._filtered(self._frame(buffers), buffers)
        target = exposed(batch["reference"], self.exposure(buffers))
        if self.crop:
            cut = self.kernel_size // 2
            inner = (..., slice(cut, -cut), slice(cut, -cut))
            if min(output.shape[-2:]) <= 2 * cut:
                height, width = output.shape[-2:]
                raise ValueError(
                    f"SBMC: a crop of {width}x{height} pixels has nothing left without the {cut} pixels at "
                    f"its border; train on crops of more than {2 * cut}, or with crop=False"
                )
            output, target = output[inner], target[inner]
        return {"color": Pair(_compressed(output), _compressed(target))}

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2) of whole frames, where depth is read."""
        if "depth" not in self.samples:
            return {}
        return {"depth_range": sample_depths(buffers[SAMPLES], self.samples)}

    def deploy(self) -> Denoiser:
        """Return a copy with plain convolutions: weights are normalised once."""
        made = copy.deepcopy(self)
        for module in made.modules():
            if isinstance(module, NormalisedConv):
                module.fold()
        return made

    def _frame(self, buffers: Buffers) -> Frame:
        self.check(buffers)
        samples = buffers[SAMPLES]
        like = wide(samples[:, 0, :1])
        largest = torch.ones_like(like[:, :, :1, :1])
        if self.depth == "relative" and "depth" in self.samples:
            given = (
                buffers["depth_range"] if "depth_range" in buffers else self.measure(buffers)["depth_range"]
            )
            largest = farthest(like, given)
        camera = None
        if self.camera:
            camera = self._camera(like, largest, buffers.get(THIN_LENS))
        return Frame(samples, wide(self.exposure(buffers)), largest, camera)

    def _camera(self, like: Tensor, largest: Tensor, given: Tensor | None) -> Tensor:
        """Return aperture, focus distance and field of view as the network sees them, (B, 3, 1, 1)."""
        if given is None:
            return like.new_zeros(like.shape[0], 3, 1, 1)
        numbers = finite(given).to(like.dtype)[:, :, None, None].expand(like.shape[0], -1, -1, -1)
        distances = numbers[:, :2] / largest
        return torch.cat((distances, numbers[:, 2:]), 1).clamp(-FEATURE_LIMIT, FEATURE_LIMIT)

    def _seen(self, samples: Tensor, frame: Frame) -> Seen:
        """Return samples of some rows as the network sees them, one per pixel where they are averaged."""
        seen = seen_samples(samples, self.samples, frame.exposure, frame.farthest)
        return averaged(seen) if self.average else seen

    def _embedded(self, seen: Seen, frame: Frame, contexts: Sequence[Tensor]) -> Tensor:
        """Return embeddings (B, S, width, H, W) of the round after the contexts."""
        maps, shared = seen.features, frame.camera
        for chain, following in zip(self.embeddings, [*contexts, None], strict=False):
            maps = chain(maps, shared)
            shared = following
        return maps

    def _contexts(self, frame: Frame) -> list[Tensor]:
        contexts: list[Tensor] = []

        def mean(samples: Tensor, *others: Tensor) -> Tensor:
            rows, contexts = frame.rows(samples, others)
            seen = self._seen(samples, rows)
            total = (wide(self._embedded(seen, rows, contexts)) * seen.counts).sum(1)
            return total / seen.counts.sum(1).clamp_min(1.0)

        batch, count = frame.samples.shape[:2]
        height, width = frame.samples.shape[-2:]
        for step, unet in enumerate(self.unets):
            numbers = batch * count * (frame.samples.shape[2] + 2 * self.width * (step + 1))
            tensors = [frame.samples, *contexts]
            made = streamed(mean, tensors, numbers, self.recompute, frame.numbers)
            contexts.append(unet(padded(made, self.multiple, repeat=False))[..., :height, :width])
        return contexts

    def _filtered(self, frame: Frame, buffers: Buffers) -> Tensor:
        """Return exposed radiance (B, 3, H, W)."""
        contexts = self._contexts(frame)
        arrive = self._splatted if self.filter == "splat" else self._gathered
        sums = arrive(frame, contexts)
        height, width = buffers[SAMPLES].shape[-2:]
        return sums.mean()[..., :height, :width]

    def _splatted(self, frame: Frame, contexts: list[Tensor]) -> Arrivals:
        reach, height = self.kernel_size // 2, frame.samples.shape[-2]

        def spread(samples: Tensor, *others: Tensor) -> Tensor:
            rows, contexts = frame.rows(samples, others)
            seen, logits = self._kernels(samples, rows, contexts)
            return torch.cat(splatted(seen.radiance, logits, self.kernel_size, beyond=True), 1)

        sums: Arrivals | None = None
        if torch.jit.is_tracing():
            each = frame.samples.shape[1] if not self.average else 1
            numbers = frame.samples.shape[0] * each * (3 * self.width + self.kernel_size**2)
            tensors = [frame.samples, *contexts]
            sums = _arrivals(overlapped(spread, tensors, frame.numbers, numbers, reach, _merged))
        else:
            for first, part in self._parts(spread, frame, contexts):
                sums = _joined(sums, part, first, height + 2 * reach)
        assert sums is not None
        inside = Arrivals(*(image[..., reach : reach + height, :] for image in sums))
        if self.outside == "drop":
            return inside
        # The grid's pixels are not outside.
        inside = Arrivals(*(padded(image, self.multiple, repeat=False) for image in inside))
        return with_outside(inside, self.kernel_size, 1 if self.average else frame.samples.shape[1])

    def _gathered(self, frame: Frame, contexts: list[Tensor]) -> Arrivals:
        def choose(samples: Tensor, *others: Tensor) -> Tensor:
            rows, contexts = frame.rows(samples, others)
            seen, logits = self._kernels(samples, rows, contexts)
            padded = pad_border(seen.radiance.flatten(0, 1), self.kernel_size // 2, "zero")
            parts = gathered(padded, logits.flatten(0, 1), self.kernel_size)
            apart = Arrivals(*(image.unflatten(0, seen.radiance.shape[:2]) for image in parts))
            return torch.cat(together(apart), 1)

        sums: Arrivals | None = None
        for _, part in self._parts(choose, frame, contexts, whole_images=True):
            sums = _joined(sums, part, 0, frame.samples.shape[-2])
        assert sums is not None
        return sums

    def _kernels(self, samples: Tensor, frame: Frame, contexts: Sequence[Tensor]) -> tuple[Seen, Tensor]:
        """Return what is seen of samples, and their logits (B, S, K * K, H, W)."""
        seen = self._seen(samples, frame)
        maps = self._embedded(seen, frame, contexts[:-1])
        return seen, wide(self.regressor(maps, contexts[-1])) + (seen.counts - 1) * _NEVER

    def _parts(
        self,
        function: Callable[..., Tensor],
        frame: Frame,
        contexts: list[Tensor],
        whole_images: bool = False,
    ) -> Iterator[tuple[int, Tensor]]:
        """Call a function with some rows of single samples and contexts; return the first row and its result.

        In a recorded graph it is called once with all.
        """
        samples = frame.samples
        if exporting():
            yield 0, function(samples, *contexts, *frame.numbers)
            return
        batch, count, _, height, width = samples.shape
        each = count if self.average else 1
        numbers = batch * (each * samples.shape[2] + 3 * self.width + self.kernel_size**2)
        rows = height if whole_images else max(1, _ROWS // (numbers * width))
        for first in range(0, height, rows):
            strip = [image[..., first : first + rows, :] for image in contexts]
            for n in range(0, count, each):
                every = (samples[:, n : n + each, :, first : first + rows], *strip, *frame.numbers)
                if self.recompute and torch.is_grad_enabled():
                    made = checkpoint(function, *every, use_reentrant=False, preserve_rng_state=False)
                else:
                    made = function(*every)
                yield first, made


def _arrivals(maps: Tensor) -> Arrivals:
    return Arrivals(maps[:, :3], maps[:, 3:4], maps[:, 4:])


def _merged(one: Tensor, other: Tensor) -> Tensor:
    """Return the sums of both, (B, 5, h, W) each."""
    return torch.cat(merge(_arrivals(one), _arrivals(other)), 1)


def _joined(sums: Arrivals | None, part: Tensor, first: int, height: int) -> Arrivals:
    """Return sums over all rows to which those of a part (B, 5, h, W) are added, in place."""
    now = Arrivals(part[:, :3], part[:, 3:4], part[:, 4:].detach())
    if exporting():
        return now
    if sums is None:
        size = (height, part.shape[-1])
        zeros = part.new_zeros(len(part), 4, *size)
        sums = Arrivals(
            zeros[:, :3].clone(), zeros[:, 3:].clone(), part.new_full((len(part), 1, *size), -torch.inf)
        )
    rows = slice(first, first + part.shape[-2])
    both = merge(Arrivals(*(image[..., rows, :] for image in sums)), now)
    for image, new in zip(sums, both, strict=True):
        image[..., rows, :] = new
    return sums


def _compressed(radiance: Tensor) -> Tensor:
    """Return x / (1 + x) of radiance x, at least 0."""
    bounded = radiance.clamp_min(0.0)
    return bounded / (1 + bounded)


def _check_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name} {value!r}; expected one of {', '.join(known)}")
