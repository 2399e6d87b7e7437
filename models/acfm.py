"""ACFM: conditioned feature modulation, one network for the diffuse and one for the specular radiance.

Bing Xu, Junfei Zhang, Rui Wang, Kun Xu, Yong-Liang Yang, Chuan Li, Rui Tang: "Adversarial Monte Carlo
Denoising with Conditioned Auxiliary Feature Modulation", ACM Transactions on Graphics 38(6), 2019,
doi:10.1145/3355089.3356547.

The noisy component, in log space, runs through a residual network; before every convolution of it, normal,
depth and albedo say how each feature is scaled and shifted. The diffuse component is divided by the albedo
before and multiplied after. The two networks share nothing, so training them together with the sum of their
losses is training each alone, as the authors do; with Adam, which is blind to the scale of a loss, exactly.

The authors' code is followed, the paper names few sizes. Where the code contradicts itself or fails:
- normals: its two training configurations feed [-1, 1] (diffuse) and [0, 1] (specular) and its test [-1, 1]
  to both; here [0, 1] always (`normal_range="published"` gives the training's ranges);
- depth is divided by the largest of the crop in training and of the image in testing; here always of the
  frame (`depth_scale="crop"` gives the training's);
- its test leaves the components apart; here they are put together as the paper says;
- parameter groups: the paper's modulations and condition network learn at five times the rate. The code picks
  them by the letters CFM in their names, which all layers between head and tail have, so its fast group has
  those convolutions, too (`groups="published"`), and the frozen one only head and tail;
- the last layer ends in a ReLU. With random weights every other of its three channels is negative for most
  pixels, which then give it no gradient. The weights start as the authors' (Kaiming normal, times 0.1, no
  biases), but the sign of each channel's last ones is chosen such that a grey image gives a positive value;
- the diffuse reference is divided by the reference's own albedo; here by the noisy frame's, the one that
  multiplies the result. They agree but for noise at edges and behind lens blur: there the network learns the
  reference's colour over the noisy albedo, which makes the product, not the quotient, right.
`exposure` is ours: 1 for the authors' data, other data is brought to a displayable level first.

Published, 32 spp, Tungsten scenes, by AFGSA's authors (Yu et al. 2021, Table 1): 37.4461 dB PSNR, 2.383e-3
"RMSE" (half the relative squared error), 0.0446 1 - SSIM; retrained by them 37.5137 dB, 2.369e-3 and 0.0443.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from models.denoiser import Buffers, Denoised, Denoiser, Pair
from models.ops.boxes import exporting
from models.ops.guides import depth_range, divisor, finite, relative_depth, unit_normal
from models.ops.memory_format import innermost
from models.ops.modulation import SLOPE, Weights, modulated_convolution, plain_modulated_convolution
from models.ops.precision import wide
from models.ops.tonemap import exposed, radiance_of

GUIDES = 7
"""Channels of the condition: normal 3, depth 1, albedo 3."""


class Logs(NamedTuple):
    """Components in the space where the networks work, (B, 3, H, W) each, float32 and at least 0.

    Attributes:
        diffuse: log(1 + radiance / (albedo + 0.00316)).
        specular: log(1 + radiance).
    """

    diffuse: Tensor
    specular: Tensor


class Modulated(nn.Module):
    """A conditioned feature modulation, x * (1 + scale(condition)) + shift(condition), and a 3x3 convolution.

    Args:
        condition: Channels of the condition, and of the layers inside scale and shift.
        width: Channels of x and of the result.
    """

    def __init__(self, condition: int, width: int) -> None:
        super().__init__()
        self.modulation = nn.ModuleDict(
            {
                name: nn.Sequential(
                    nn.Conv2d(condition, condition, 1), nn.LeakyReLU(SLOPE), nn.Conv2d(condition, width, 1)
                )
                for name in ("scale", "shift")
            }
        )
        self.convolution = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, maps: Tensor, condition: Tensor) -> Tensor:
        """Return (B, width, H, W) from x of that shape and the condition (B, condition, H, W)."""
        weights = Weights(*self.parameters())  # modulation first, scale before shift
        if exporting():
            return plain_modulated_convolution(maps, condition, weights)
        return modulated_convolution(maps, condition, weights)


class Block(nn.Module):
    """A residual block: modulated convolution, ReLU, modulated convolution, plus what came in."""

    def __init__(self, condition: int, width: int) -> None:
        super().__init__()
        self.first = Modulated(condition, width)
        self.second = Modulated(condition, width)

    def forward(self, maps: Tensor, condition: Tensor) -> Tensor:
        """Return (B, width, H, W)."""
        inner = functional.relu(self.first(maps, condition), inplace=True)
        result: Tensor = self.second(inner, condition).add_(maps)
        return result


class Generator(nn.Module):
    """The network of one component; 1,530,019 parameters in the published size.

    Args:
        blocks: Residual blocks.
        width: Channels of the image's features.
        condition_width: Channels inside the condition network.
        condition: Channels that it hands to the modulations.
    """

    def __init__(self, blocks: int, width: int, condition_width: int, condition: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(GUIDES, condition_width, 3, padding=1)]
        for _ in range(3):
            layers += [nn.LeakyReLU(SLOPE, inplace=True), nn.Conv2d(condition_width, condition_width, 1)]
        layers += [nn.LeakyReLU(SLOPE, inplace=True), nn.Conv2d(condition_width, condition, 1)]
        self.condition = nn.Sequential(*layers)
        self.head = nn.Conv2d(3, width, 3, padding=1)
        self.blocks = nn.ModuleList(Block(condition, width) for _ in range(blocks))
        self.body = Modulated(condition, width)
        self.tail = nn.Conv2d(width, width, 3, padding=1)
        self.last = nn.Conv2d(width, 3, 3, padding=1)
        self.checkpointed = 0

    def forward(self, component: Tensor, guides: Tensor) -> Tensor:
        """Return the clean component (B, 3, H, W), float32 (or float64) and at least 0.

        Args:
            component: Noisy component (B, 3, H, W), in log space.
            guides: Normal, depth and albedo (B, 7, H, W).
        """
        condition = self.condition(guides)
        head = maps = self.head(component)
        repeat = torch.is_grad_enabled() and not exporting()
        for index, block in enumerate(self.blocks):
            if repeat and index < self.checkpointed:
                maps = checkpoint(block, maps, condition, use_reentrant=False, preserve_rng_state=False)
            else:
                maps = block(maps, condition)
        maps = functional.relu(self.tail(self.body(maps, condition).add_(head)), inplace=True)
        with torch.autocast(maps.device.type, enabled=False):
            # A logarithm with the 8 bits of bfloat16 would be radiance in steps of a per cent.
            return functional.relu(self.last(wide(maps)))

    def start(self, factor: float) -> None:
        """Draw the weights: Kaiming normal times `factor`, no biases, no output that is dead for grey."""
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight)
                with torch.no_grad():
                    module.weight.mul_(factor)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        weight = self.last.weight
        if weight.is_meta:
            return
        with torch.no_grad():
            grey, guides = weight.new_full((1, 3, 8, 8), 0.5), weight.new_full((1, GUIDES, 8, 8), 0.5)
            alive = self(grey, guides)[0, :, 4, 4] > 0
            weight.mul_(torch.where(alive, 1.0, -1.0)[:, None, None, None])


class ACFM(Denoiser):
    """The denoiser of Xu et al. 2019: a network for each component, 3,060,038 parameters together.

    It needs frames with `diffuse` and `specular` parts, noisy and reference.

    Args:
        blocks: Residual blocks of each network.
        width: Channels of the image's features.
        condition_width: Channels inside the condition network.
        condition: Channels that it hands to the modulations.
        normal_range: `unit`: normals as [0, 1] for both networks; `published`: the diffuse one sees [-1, 1].
        depth_scale: Depth is divided by the largest of the `frame`, or, in training, of the `crop`.
        groups: Which parameters are in the fast group: `modulation` as the paper says, or `published`.
        start: Factor on the random weights at the start.
        checkpointed: Blocks of each network whose inside is computed again in the backward pass instead
            of being kept.
    """

    inputs = ("diffuse", "specular", "normal", "depth", "albedo")
    frame_numbers = ("exposure", "depth_range")
    targets = ("reference", "reference_diffuse")
    compared = ("diffuse", "specular")
    # PyTorch's allocator peaks at 1,530; the rest is room for oneDNN and for exported forms, which modulate
    # whole images.
    bytes_per_pixel = 2600

    def __init__(
        self,
        blocks: int = 16,
        width: int = 64,
        condition_width: int = 128,
        condition: int = 32,
        normal_range: Literal["unit", "published"] = "unit",
        depth_scale: Literal["frame", "crop"] = "frame",
        groups: Literal["modulation", "published"] = "modulation",
        start: float = 0.1,
        checkpointed: int = 0,
    ) -> None:
        super().__init__()
        sizes = {"width": width, "condition_width": condition_width, "condition": condition}
        for name, value in {"blocks": blocks + 1, **sizes}.items():
            if value < 1:
                raise ValueError(f"ACFM: {name} is too small, got {value - (name == 'blocks')}")
        _check_choice("normal_range", normal_range, ("unit", "published"))
        _check_choice("depth_scale", depth_scale, ("frame", "crop"))
        _check_choice("groups", groups, ("modulation", "published"))
        self.normal_range, self.depth_scale, self.groups = normal_range, depth_scale, groups
        self.halo = 2 * blocks + 4
        self.diffuse, self.specular = (Generator(blocks, width, condition_width, condition) for _ in range(2))
        for network in (self.diffuse, self.specular):
            network.start(start)
            network.checkpointed = checkpointed

    def forward(self, buffers: Buffers) -> Denoised:
        """Denoise; see `Denoiser.forward`.

        Args:
            buffers: `diffuse` and `specular` (B, 3, H, W) linear radiance, `normal` (B, 3, H, W) in world
                space, `depth` (B, 1, H, W) in scene units, `albedo` (B, 3, H, W); optionally `exposure` (B,)
                and `depth_range` (B, 2).
        """
        logs = self.predict(buffers)
        exposure = self.exposure(buffers).to(logs.diffuse.dtype)
        with torch.autocast(logs.diffuse.device.type, enabled=False):
            diffuse, specular = (radiance_of(log) for log in logs)
            return Denoised((divisor(buffers["albedo"]) * diffuse + specular) / exposure)

    def predict(self, buffers: Buffers) -> Logs:
        """Return the clean components as the networks make them, from the same buffers as `forward`.

        Raises:
            ValueError: A buffer is missing or has another shape.
        """
        self.check(buffers)
        with torch.autocast(buffers["diffuse"].device.type, enabled=False):
            noisy = self._logs(buffers, buffers["diffuse"], buffers["specular"])
            guides = self._guides(buffers)
        raw_normals = guides
        if self.normal_range == "published":
            raw_normals = torch.cat([guides[:, :3] * 2.0 - 1.0, guides[:, 3:]], 1)
        return Logs(
            self.diffuse(innermost(noisy.diffuse), innermost(raw_normals)),
            self.specular(innermost(noisy.specular), innermost(guides)),
        )

    def training_pairs(self, batch: Mapping[str, Any]) -> dict[str, Pair]:
        """Return what each network makes and should make, as `Logs`.

        Args:
            batch: Inputs, `reference` and `reference_diffuse`, frame numbers. What the reference has beyond
                its diffuse part, at least 0, is its specular part.
        """
        made = self.predict(batch)
        with torch.no_grad():
            diffuse = wide(batch["reference_diffuse"])
            target = self._logs(batch, diffuse, wide(batch["reference"]) - diffuse)
        return {name: Pair(getattr(made, name), getattr(target, name)) for name in self.compared}

    def measure(self, buffers: Buffers) -> dict[str, Tensor]:
        """Return `depth_range` (B, 2): smallest and largest depth of whole frames."""
        return {"depth_range": depth_range(buffers["depth"])}

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return `modulation` (modulations and condition networks) and `base` (all other parameters).

        The authors train the first at five times the rate and leave the second as it started for the first
        20,000 steps. With `groups="published"` the residual blocks are in the first, too.
        """
        fast = ("condition", "blocks", "body") if self.groups == "published" else ("condition",)
        groups: dict[str, list[nn.Parameter]] = {"modulation": [], "base": []}
        for name, parameter in self.named_parameters():
            modulates = ".modulation." in name or name.split(".")[1] in fast
            groups["modulation" if modulates else "base"].append(parameter)
        return groups

    def _logs(self, buffers: Buffers, diffuse: Tensor, specular: Tensor) -> Logs:
        exposure = self.exposure(buffers)
        return Logs(
            torch.log1p(exposed(diffuse, exposure) / divisor(buffers["albedo"])),
            torch.log1p(exposed(specular, exposure)),
        )

    def _guides(self, buffers: Buffers) -> Tensor:
        given = buffers.get("depth_range")
        if self.training and self.depth_scale == "crop":
            given = None
        depth = relative_depth(buffers["depth"], given)
        return torch.cat([unit_normal(buffers["normal"]), depth, finite(buffers["albedo"])], 1)


def _check_choice(name: str, value: str, known: tuple[str, str]) -> None:
    if value not in known:
        raise ValueError(f"{name} must be {known[0]!r} or {known[1]!r}, got {value!r}")
