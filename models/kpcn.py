"""KPCN: kernel-predicting convolutional networks for diffuse and specular light.

Steve Bako, Thijs Vogels, Brian McWilliams, Mark Meyer, Jan Novák, Alex Harvill, Pradeep Sen, Tony DeRose,
Fabrice Rousselle: "Kernel-Predicting Convolutional Networks for Denoising Monte Carlo Renderings", ACM
Transactions on Graphics 36(4), 2017, doi:10.1145/3072959.3073708.

Two networks of nine 5x5 convolutions (eight of 100 channels with ReLU, the last one linear) predict a kernel
of 21x21 weights for every pixel, by a softmax. One filters diffuse light divided by the albedo, the other
log(1 + specular light); the sum of both, brought back, is the image:

    color = (albedo + 0.00316) gather(diffuse / (albedo + 0.00316)) + exp(gather(log(1 + specular))) - 1

The authors' code is not public. Two others are, by the authors of SBMC (Gharbi et al. 2019) and by Q. Han,
and they differ; here:
- features: SBMC's 27 channels (`features="sbmc"`): the filtered buffer, its gradients and variance, and
  gradients and variances of normal, depth and albedo, but not these themselves, which is what the paper's
  text suggests. Han's 28 (`features="qbhan"`) keep the variance of the buffer per channel and have none of
  the albedo;
- variance of log(1 + s): SBMC's code divides by (1 + s)^2 after s was replaced by its logarithm, a slip.
  Here s is the linear value, as the delta method says; `sbmc_compat=True` repeats the slip;
- size: all published forms convolve without padding and lose 18 pixels on each side. Here the features are
  padded by 18 zeros once, so pixels at least 18 from the border get exactly the published result and the
  others get one at all. `padding="layers"` pads before every layer: the same pixels inside, and less
  arithmetic on small crops;
- border of the gather: mirrored (Han), so that a constant image stays constant; `border="zero"` is SBMC's,
  where the outside is black and takes weight;
- what the network sees is clipped to +-1000 (`feature_limit`), what is filtered is not. Published features
  have no bound: a firefly on a dark surface makes logits so large that float32 rounds them by more than the
  kernels bear, and an exported file differs from the module by 2e-4 where the bound leaves 2e-5;
- `exposure` is ours: radiance is multiplied by it first (variance by its square) and the result divided, so
  that scenes in other units look alike;
- `branches="single"`: one network for data whose light is not split, in either of the two transforms.
Not taken over: Han's loader overwrites the specular reference with the noisy specular image.

The paper trains each branch with L1 in its transformed space, then both with L1 on the image
(`trainer.modules.Branches`); its tables are on a private data set. Published, 32 spp, Tungsten scenes, by
AFGSA's authors, who trained it again (Yu et al. 2021, Table 1): 36.6687 dB PSNR, 2.840e-3 "RMSE" (half the
relative squared error), 0.0509 1 - SSIM.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from models.denoiser import Buffers, Denoised, Denoiser, Pair, select
from models.ops.boxes import exporting
from models.ops.gather import Border, gather_padded, pad_border, strips
from models.ops.gradients import backward_differences
from models.ops.guides import depth_range, divisor, farthest, finite, relative_depth
from models.ops.memory_format import innermost
from models.ops.precision import wide
from models.ops.tonemap import LARGEST, exposed, radiance_of

SIZE = 5
"""Rows and columns of a convolution."""

Transform = Literal["log", "demodulated"]
CHANNELS = {"sbmc": 27, "qbhan": 28}


class Branch(nn.Module):
    """One network: features in, a filtered image out.

    Args:
        channels: Channels of the features.
        width: Channels between convolutions.
        layers: Convolutions.
        kernel_size: K, odd.
        border: Outside of the image that is filtered.
        padding: `features` pads the features once, `layers` before every convolution.
    """

    def __init__(
        self, channels: int, width: int, layers: int, kernel_size: int, border: Border, padding: str
    ) -> None:
        super().__init__()
        self.kernel_size, self.border = kernel_size, border
        self.once = padding == "features"
        self.reach = layers * (SIZE // 2)
        widths = [channels, *[width] * (layers - 1), kernel_size**2]
        self.convolutions = nn.ModuleList(
            nn.Conv2d(
                widths[layer],
                widths[layer + 1],
                SIZE,
                padding=0 if self.once or layer == layers - 1 else SIZE // 2,
            )
            for layer in range(layers)
        )
        for convolution in self.convolutions:
            assert isinstance(convolution, nn.Conv2d)
            nn.init.xavier_uniform_(convolution.weight)
            assert convolution.bias is not None
            nn.init.zeros_(convolution.bias)

    def forward(self, features: Tensor, image: Tensor) -> Tensor:
        """Return the image (B, 3, H, W) filtered with kernels from features (B, channels, H, W)."""
        last = self.convolutions[-1]
        hidden = self._hidden(features)
        padded = pad_border(image, self.kernel_size // 2, self.border)
        if exporting() or torch.is_grad_enabled():
            return gather_padded(padded, last(hidden), self.kernel_size)
        # The K^2 logits of a pixel weigh more than all else, so only some rows of them exist at a time.
        height, width = image.shape[-2:]
        result = torch.empty_like(image)
        for rows in strips(height, image.shape[0] * width, image):
            logits = last(hidden[:, :, rows.start : rows.stop + SIZE - 1])
            seen = padded[:, :, rows.start : rows.stop + self.kernel_size - 1]
            result[:, :, rows] = gather_padded(seen, logits, self.kernel_size)
        return result

    def _hidden(self, features: Tensor) -> Tensor:
        """Return what the last convolution reads, with the 2 pixels that it needs on each side."""
        hidden = innermost(F.pad(features, [self.reach] * 4) if self.once else features)
        for convolution in self.convolutions[:-1]:
            hidden = F.relu_(convolution(hidden))
        return hidden if self.once else F.pad(hidden, [SIZE // 2] * 4)


class KPCN(Denoiser):
    """Kernel-predicting network of Bako et al. 2017.

    Args:
        branches: `split`: a network each for diffuse and specular light; `single`: one for `color`.
        features: `sbmc` (27 channels) or `qbhan` (28).
        kernel_size: Rows and columns of the predicted kernels, odd.
        width: Channels between convolutions.
        layers: Convolutions of a branch.
        border: Outside of the filtered image: mirrored, or `zero`, which takes weight.
        transform: Of the single branch: log(1 + color), or `demodulated`, divided by the albedo.
        sbmc_compat: Variance of logarithms as in SBMC's code, with its slip.
        padding: Zeros around the features once, or before every one of the `layers`.
        feature_limit: Features are clipped to +-this.

    Raises:
        ValueError: An argument is out of range; the message names it.
    """

    frame_numbers = ("exposure", "depth_range")
    bytes_per_pixel = 2000  # resident memory grows by 700 per pixel, beside some 80 MB for strips of logits

    def __init__(
        self,
        branches: Literal["split", "single"] = "split",
        features: Literal["sbmc", "qbhan"] = "sbmc",
        kernel_size: int = 21,
        width: int = 100,
        layers: int = 9,
        border: Border = "reflect",
        transform: Transform = "log",
        sbmc_compat: bool = False,
        padding: Literal["features", "layers"] = "features",
        feature_limit: float = 1000.0,
    ) -> None:
        super().__init__()
        _check_choice("branches", branches, ("split", "single"))
        _check_choice("features", features, tuple(CHANNELS))
        _check_choice("border", border, ("reflect", "zero"))
        _check_choice("transform", transform, ("log", "demodulated"))
        _check_choice("padding", padding, ("features", "layers"))
        if kernel_size < 3 or kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd and at least 3, got {kernel_size}")
        if layers < 2 or width < 1:
            raise ValueError(f"KPCN needs at least 2 layers and width 1, got {layers} and {width}")
        if not 0 < feature_limit <= LARGEST:
            raise ValueError(f"feature_limit must lie between 0 and {LARGEST:g}, got {feature_limit}")
        self.features, self.sbmc_compat, self.feature_limit = features, sbmc_compat, feature_limit
        self.transforms: dict[str, Transform] = {"color": transform}
        if branches == "split":
            self.transforms = {"diffuse": "demodulated", "specular": "log"}
            self.targets = ("reference", "reference_diffuse")
        guides = ("albedo", "normal", "depth")
        noisy = ("normal", "depth") if features == "qbhan" else guides
        self.inputs = (*self.transforms, *guides, *(f"{n}_variance" for n in (*self.transforms, *noisy)))
        names = ("diffuse", "specular") if branches == "split" else ("branch",)
        self.compared = (*names, "color")
        # Backward differences look one pixel further to the left and up than the convolutions.
        self.halo = max(layers * (SIZE // 2) + 1, kernel_size // 2)
        channels = CHANNELS[features]
        self.branches = nn.ModuleDict(
            {name: Branch(channels, width, layers, kernel_size, border, padding) for name in names}
        )

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `diffuse` and `specular` (or `color`) (B, 3, H, W), linear; `albedo` (B, 3, H, W),
                `normal` (B, 3, H, W) in world space, `depth` (B, 1, H, W) in scene units, and the variance of
                the mean of each, per channel; optionally `exposure` (B,) and `depth_range` (B, 2).

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        clean = self._clean(buffers)
        return Denoised(self._combine(self._filtered(clean), clean) / self.exposure(buffers))

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return the filtered image of every branch in its transformed space, and the exposed color.

        Args:
            batch: Inputs, `targets` and frame numbers. The specular reference is what the diffuse one leaves
                of the reference, at least 0.
        """
        clean = self._clean(select(self, batch))
        filtered = self._filtered(clean)
        exposure, demodulator = self.exposure(batch), divisor(clean["albedo"])
        reference = exposed(batch["reference"], exposure)
        lights = {"color": reference}
        if "diffuse" in self.transforms:
            lights = {"diffuse": exposed(batch["reference_diffuse"], exposure)}
            lights["specular"] = (reference - lights["diffuse"]).clamp_min(0.0)
        pairs = {}
        for name, (light, transform) in zip(self.compared, self.transforms.items(), strict=False):
            target = lights[light]
            target = torch.log1p(target) if transform == "log" else target / demodulator
            pairs[name] = Pair(filtered[name], target)
        return {**pairs, "color": Pair(self._combine(filtered, clean), reference)}

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters of `diffuse` and `specular`, or of the one `branch`."""
        return {name: list(branch.parameters()) for name, branch in self.branches.items()}

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of whole frames."""
        return {"depth_range": depth_range(buffers["depth"])}

    def network_input(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return the features (B, 27 or 28, H, W) of every branch, from the same buffers as `forward`."""
        clean = self._clean(buffers)
        return {
            name: self._features(clean, light, transform)
            for name, (light, transform) in zip(self.branches, self.transforms.items(), strict=True)
        }

    def _clean(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return finite buffers of legal range, radiance exposed, depth divided by the frame's largest."""
        self.check(buffers)
        exposure = wide(self.exposure(buffers))
        clean = {}
        for light in self.transforms:
            clean[light] = exposed(buffers[light], exposure)
            clean[f"{light}_variance"] = exposed(buffers[f"{light}_variance"], exposure.square())
        clean["albedo"] = finite(buffers["albedo"], 1.0).clamp_min(0.0)
        clean["normal"] = finite(buffers["normal"])
        given = buffers.get("depth_range")
        clean["depth"] = relative_depth(buffers["depth"], given)
        for name in ("albedo", "normal", "depth"):
            if f"{name}_variance" in self.inputs:
                clean[f"{name}_variance"] = exposed(buffers[f"{name}_variance"], torch.ones_like(exposure))
        clean["depth_variance"] = clean["depth_variance"] / farthest(buffers["depth"], given).square()
        return clean

    def _filtered(self, clean: Buffers) -> dict[str, Tensor]:
        """Return what every branch makes of its buffer, in transformed space."""
        return {
            name: branch(self._features(clean, light, transform), _transformed(clean, light, transform))
            for (name, branch), (light, transform) in zip(
                self.branches.items(), self.transforms.items(), strict=True
            )
        }

    def _combine(self, filtered: Mapping[str, Tensor], clean: Buffers) -> Tensor:
        """Return exposed radiance."""
        color: Tensor | None = None
        for image, transform in zip(filtered.values(), self.transforms.values(), strict=True):
            light = radiance_of(image) if transform == "log" else image * divisor(clean["albedo"])
            color = light if color is None else color + light
        assert color is not None
        return color

    def _features(self, clean: Buffers, light: str, transform: Transform) -> Tensor:
        image = _transformed(clean, light, transform)
        variance = clean[f"{light}_variance"]
        if transform == "demodulated":
            slope, least = divisor(clean["albedo"]), 0.0
        else:
            # d log(1 + s) / ds = 1 / (1 + s); the addend is SBMC's.
            slope, least = 1 + (image if self.sbmc_compat else clean[light]), 1e-5
        normal, depth, albedo = (backward_differences(clean[name]) for name in ("normal", "depth", "albedo"))
        means = {name: clean[f"{name}_variance"].mean(1, keepdim=True) for name in ("normal", "depth")}
        if self.features == "qbhan":
            spread = variance / (slope.square() + least)
            parts = [image, spread, backward_differences(image), means["normal"], normal]
            parts += [means["depth"], depth, albedo]
        else:
            spread = variance.mean(1, keepdim=True) / (slope.square().mean(1, keepdim=True) + least)
            parts = [image, normal, means["normal"], depth, means["depth"], albedo]
            parts += [clean["albedo_variance"].mean(1, keepdim=True), backward_differences(image), spread]
        return torch.cat(parts, 1).clamp(-self.feature_limit, self.feature_limit)


def _transformed(clean: Buffers, light: str, transform: Transform) -> Tensor:
    return torch.log1p(clean[light]) if transform == "log" else clean[light] / divisor(clean["albedo"])


def _check_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name} {value!r}; expected one of {', '.join(known)}")
