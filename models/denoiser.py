"""The contract that every denoiser keeps, learned or not.

Shape letters: B batch, T frames, S samples per pixel, C channels, H rows, W columns.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from data.buffers import FRAME_NUMBERS, SAMPLES, buffer, sample_channels
from models.ops.per_sample import arranged, check_samples

Buffers = Mapping[str, Tensor]

State = dict[str, Tensor]
"""What a recurrent method carries from frame to frame: tensors (B, C, h, w) of any names. The sides of an
image, padded to the method's grid, are multiples of h and w."""


class Denoised(NamedTuple):
    """What a denoiser returns.

    Attributes:
        color: Linear radiance (B, 3, H, W) in the units of the input.
        state: What a recurrent method carries to the next frame, otherwise None.
        aux: What the method made on its way and was asked for, (B, C, H, W) with one or three channels: name
            of a layer, or of the buffer that it is a filtered form of. Otherwise None.
    """

    color: Tensor
    state: State | None = None
    aux: Mapping[str, Tensor] | None = None


class Pair(NamedTuple):
    """What a paper's loss compares, in the domain where it compares.

    Attributes:
        output: What the network made, (B, 3, H, W), with its gradient.
        target: What it should have made, of the same shape.
    """

    output: Tensor
    target: Tensor


class Denoiser(nn.Module):
    """Base class: raw buffers in, linear radiance out.

    Inputs are raw: linear radiance, world-space normals, depth in scene units. Every transform a network
    needs happens inside, so exported artifacts take what a renderer wrote. Beside images a mapping may hold
    frame numbers (`data.buffers.FRAME_NUMBERS`): `exposure` (B,) and whatever `measure` returns.

    Attributes:
        inputs: Names of the buffers that the method reads.
        frame_numbers: Names of the frame numbers that it reads when they are given.
        halo: Pixels on each side of a core that the core depends on; cores are rectangles whose sides lie at
            multiples of `multiple`, single pixels where that is 1.
        multiple: Side of the method's own grid. Tiles start at multiples of it; images of other sizes are
            padded by repeating their last row and column, `samples` by pixels without samples (NaN), in the
            module and in the tiler alike.
        temporal: `irradiance` (or `color`) is expected to be accumulated over the preceding frames.
        per_sample: It reads `samples` (B, S, C, H, W), of any number of samples per pixel. Samples with a
            channel that is not finite do not count, pixels without any are filled from around them.
        samples: Quantities in `samples`, in this order (`data.buffers.sample_channels` lists the channels);
            `select` brings a batch into it.
        fill: Quantity → the constant that stands for it where a batch's samples lack it.
        frames: Frames before and after a frame that one step of a space-time method looks at; 0: images.
            Otherwise buffers are sequences (B, T, C, H, W), and `forward` returns the middle frame.
        frame_halo: Frames on each side that the exact result of a frame depends on.
        recurrent: `forward(buffers, state)` continues a sequence of images with the `Denoised.state` of the
            frame before; None, the default, starts one.
        state_maps: Map of the state → its channels, and the side of its pixels in pixels of the image: what
            exported files are given. Zeros start a sequence.
        whole: It looks anywhere in the frames before, so images are not cut into tiles.
        bytes_per_pixel: Working memory of inference per pixel, measured; tiling derives tile sizes from it.
        bytes_once: Working memory that does not grow with the image, such as reordered weights, measured.
        exported_bytes_per_pixel: `bytes_per_pixel` of exported files, where it is more than half as much
            again; 0: it is not.
        rounding_reach: Pixels around one whose rounding it may have: where weights or images are subtracted,
            what is left beside a firefly is rounded as the firefly is. See `trainer.export.parity`.
        no_export: Why the method is not exported as ONNX or TorchScript; empty where it is.
        targets: Names of the buffers that training compares with.
        compared: Names of the pairs that `training_pairs` returns.
    """

    inputs: tuple[str, ...] = ()
    frame_numbers: tuple[str, ...] = ()
    halo: int = 0
    multiple: int = 1
    temporal: bool = False
    per_sample: bool = False
    samples: tuple[str, ...] = ()
    fill: Mapping[str, float] = {}
    frames: int = 0
    frame_halo: int = 0
    recurrent: bool = False
    state_maps: Mapping[str, tuple[int, int]] = {}
    whole: bool = False
    bytes_per_pixel: int = 500
    bytes_once: int = 0
    exported_bytes_per_pixel: int = 0
    rounding_reach: int = 4
    no_export: str = ""
    targets: tuple[str, ...] = ("reference",)
    compared: tuple[str, ...] = ("color",)

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise a batch of images.

        Args:
            buffers: Tensors (B, C, H, W) for each name of `inputs`, `samples` (B, S, C, H, W), and optionally
                frame numbers.

        Raises:
            ValueError: A buffer is missing or has another shape (see `check`).
        """
        raise TypeError(f"{type(self).__name__} does not define forward")

    def sequence(self, buffers: Buffers) -> Tensor:
        """Denoise all frames of a sequence, for space-time methods.

        Args:
            buffers: Tensors (B, T, C, H, W) for each name of `inputs`, and optionally frame numbers.

        Returns:
            Linear radiance (B, T, 3, H, W).

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        raise TypeError(f"{type(self).__name__} does not denoise sequences")

    def clip(self, buffers: Buffers) -> Denoised:
        """Denoise all frames of a sequence as `sequence` does, with `aux` (B, T, C, H, W) where asked for."""
        return Denoised(self.sequence(buffers))

    def instead(self, available: Collection[str]) -> tuple[Denoiser, tuple[str, ...]] | None:
        """Return the form of this method that does with the buffers that a frame has.

        It never assumes what only the user can know, such as that a feature has no noise: that is an option
        of the method, and `forward` says so where a buffer is missing.

        Args:
            available: Names of the buffers that there are or that can be derived.

        Returns:
            The other form and the reasons, one sentence each; None: there is none, or none is needed.
        """
        return None

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return the frame numbers that need the whole frame, from whole frames.

        A method that is called on crops or tiles must be given these numbers of the whole frame to give the
        same result. Methods that look only at neighbourhoods return nothing.
        """
        return {}

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return what the method's paper compares in training, one pair per name of `compared`.

        Here it is exposed radiance, float32. Methods whose loss lives elsewhere return what they are
        compared in, such as log(1 + radiance) or its diffuse and specular parts, before anything is clamped.

        Args:
            batch: Inputs, `targets` and frame numbers.
        """
        exposure = self.exposure(batch).float()
        output = self(select(self, batch)).color.float()
        return {"color": Pair(output * exposure, batch["reference"].float() * exposure)}

    def next_pair(self, batch: Mapping[str, Any], state: State | None) -> tuple[Pair, Denoised]:
        """Denoise the next frame for training: what a recurrent method's paper compares, and the result.

        Here exposed radiance is compared, float32.

        Args:
            batch: One frame of each sequence: inputs, `targets` and frame numbers.
            state: Of the frame before; None: it is the first.
        """
        exposure = self.exposure(batch).float()
        result = self(select(self, batch), state)
        return Pair(result.color.float() * exposure, batch["reference"].float() * exposure), result

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters in the groups that a paper trains differently; `all` where it does not."""
        return {"all": list(self.parameters())}

    def deploy(self) -> Denoiser:
        """Return the form used for inference, equal to 1e-5; by default the module itself."""
        return self

    def made_by(self, missing: Collection[str]) -> str:
        """Return what makes buffers that are missing, or does without them; empty: nothing to say.

        Args:
            missing: Names of them, at least one.
        """
        return ""

    def check(self, buffers: Buffers) -> tuple[int, int, int]:
        """Check names and shapes of the inputs and return (B, H, W).

        Raises:
            ValueError: Names the buffer, what was expected and what came.
        """
        missing = [name for name in self.inputs if name not in buffers]
        if missing:
            hint = self.made_by(missing)
            raise ValueError(
                f"{type(self).__name__} needs the buffers {', '.join(self.inputs)}; missing: "
                f"{', '.join(missing)}; given: {', '.join(buffers) or 'none'}{hint and f'. {hint}'}"
            )
        for name in self.inputs:
            if not isinstance(buffers[name], Tensor):
                raise ValueError(
                    f"{type(self).__name__}: buffer {name!r} is a {type(buffers[name]).__name__}, expected "
                    "one tensor; images of different size or number of samples need a call each"
                )
        sizes = buffers[self.inputs[0]].shape
        batch, height, width = sizes[0], sizes[-2], sizes[-1]
        if torch.jit.is_tracing() or torch.compiler.is_exporting():
            # Sizes are symbols there: comparing them would tie the graph to the example's.
            return batch, height, width
        for name in self.inputs:
            tensor, expected = buffers[name], (batch, *self._leading(buffers, name), height, width)
            if tuple(tensor.shape) != expected:
                raise ValueError(
                    f"{type(self).__name__}: buffer {name!r} has shape {tuple(tensor.shape)}, "
                    f"expected {expected} like {self.inputs[0]!r}"
                )
        return batch, height, width

    def _leading(self, buffers: Buffers, name: str) -> tuple[int, ...]:
        """Return the sizes expected between batch and rows: channels, of `samples` also their number."""
        if name != SAMPLES:
            return (buffer(name).channels,)
        return check_samples(buffers[name], sample_channels(*self.samples), type(self).__name__)

    def exposure(self, buffers: Buffers) -> Tensor:
        """Return the exposure as (B, 1, 1, 1), 1 where the mapping has none or one that is not positive."""
        like = buffers[self.inputs[0]]
        given = buffers.get("exposure")
        if given is None:
            return torch.ones((), dtype=like.dtype, device=like.device).reshape(1, 1, 1, 1)
        given = given.to(like.dtype).reshape(-1, 1, 1, 1)
        return torch.where(given > 0, given, 1.0)


def select(denoiser: Denoiser, buffers: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the part of a batch that a denoiser reads: its inputs and the known frame numbers.

    Where `sample_channels` says what the channels of `samples` are, they are brought into the denoiser's
    order, with constants for what is missing and in its `fill`.

    Raises:
        ValueError: The samples lack a quantity that has no constant; names it.
    """
    names = (*denoiser.inputs, *(n for n in FRAME_NUMBERS if n in denoiser.frame_numbers))
    chosen = {name: buffers[name] for name in names if name in buffers}
    channels = buffers.get("sample_channels")
    if SAMPLES in chosen and channels is not None:
        chosen[SAMPLES] = arranged(chosen[SAMPLES], channels, denoiser.samples, denoiser.fill)
    return chosen
