"""Non-local means of two half buffers whose weights also look at feature buffers.

Weights are the smallest of those of the colour and of every feature: Fabrice Rousselle, Marco Manzi, Matthias
Zwicker: "Robust Denoising using Feature and Color Information", Computer Graphics Forum 32(7), 2013,
doi:10.1111/cgf.12219 (RDFC), with one of its candidates: patch radius 3, k = 0.45 for the colour and 0.6 for
features, tau = 1e-3. Or they are the product of all, equations 8 to 10 of NFOR (`models.classical.nfor`).

Unlike RDFC, each half is filtered with weights of the other (there: both with those of the mean), features
are filtered as NFOR filters them, opposite neighbours are not compared together, and the pixel's own weight
is 1 (there: the largest of the others).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Literal

from torch import Tensor

from data.buffers import buffer
from models.classical.nlm import NLM, Sampling
from models.denoiser import Buffers
from models.ops import halves
from models.ops.features import Prefilter
from models.ops.fireflies import Fireflies
from models.ops.halves import ColorNoise, Halves, Noise
from models.ops.joint import Feature, JointKernel, joint_filter
from models.ops.nlm import Guide


class JointNLM(NLM):
    """Non-local means whose weights also look at filtered features; see `models.ops.joint`.

    Features are filtered as NFOR filters them: the halves with weights from each other, their squared
    difference being the variance that is left.

    Args:
        features: Names of buffers with halves and variance.
        combine: `least`: the smallest of the colour's and the features' weights (RDFC); `product`: their
            product (equation 8 of NFOR).
        window: Radius of the window.
        patch: Radius of the colour's patches; features are compared pixel by pixel.
        bandwidth: k of the colour.
        feature_bandwidth: k of the features.
        tau: Squared difference of a feature that always counts as small; of distances, relative to the
            pixel's own value.
        prefilter_window: Radius of the window that filters the features.
        color_noise: As in `NLM`.
        feature_noise: The same for features, one word for all or one for each; `none`: not filtered.
        sampling: As in `NLM`.
        fireflies: As in `NLM`.
        aux: As in `NLM`; also each filtered feature by its name.
        memory: Working memory in bytes beside the buffers; none: 64 MB on a CPU, 4 GB on other devices.
        fused: As in `NLM`.
    """

    def __init__(
        self,
        features: Sequence[str] = ("normal", "albedo", "depth"),
        combine: Literal["least", "product"] = "least",
        *,
        window: int = 10,
        patch: int = 3,
        bandwidth: float = 0.45,
        feature_bandwidth: float = 0.6,
        tau: float = 1e-3,
        prefilter_window: int = 5,
        color_noise: ColorNoise = "measured",
        feature_noise: Noise | Sequence[Noise] = "measured",
        sampling: Sampling = "random",
        fireflies: Fireflies = "keep",
        aux: bool = False,
        memory: int | None = None,
        fused: bool | None = None,
    ) -> None:
        arguments = {n: v for n, v in locals().items() if n not in ("self", "__class__")}
        super().__init__(
            window,
            patch,
            bandwidth,
            color_noise=color_noise,
            sampling=sampling,
            fireflies=fireflies,
            aux=aux,
            memory=memory,
            fused=fused,
        )
        self._arguments = arguments
        if combine not in ("least", "product"):
            raise ValueError(f"JointNLM: combine must be least or product, got {combine!r}")
        self.features, self.tau = tuple(features), tau
        self.noises = halves.of_features("JointNLM", self.features, feature_noise)
        self.inputs += tuple(n for name, noise in self.noises.items() for n in halves.inputs(name, noise))
        self.joint = JointKernel(self.kernel, feature_bandwidth, combine)
        self.prefilter = Prefilter(prefilter_window, memory=memory, fused=fused)
        looked = [halves.reach(n) + self.prefilter.reach for n in self.noises.values() if n != "none"]
        # Features have gradients, which look one pixel further.
        self.halo = window + max(
            patch + self._color_reach(), 1 + max(looked, default=0) if self.noises else 0
        )

    def _possible(self, available: Collection[str]) -> tuple[dict[str, Any], tuple[str, ...]]:
        changed, reasons = super()._possible(available)
        noises = dict(self.noises)
        for name, noise in self.noises.items():
            found = halves.possible(name, noise, available)
            if found is not None:
                noises[name], reason = found
                reasons = (*reasons, reason)
        if noises != self.noises:
            changed["feature_noise"] = tuple(noises.values())
        return changed, reasons

    def _without(self) -> str:
        return f"{super()._without()}; feature_noise=none takes features as they are"

    def _halves(self, color: Halves, buffers: Buffers) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        features = self._filtered(buffers)
        guides = [Guide(color.b, color.variance), Guide(color.a, color.variance)]
        images = [color.a, color.b]
        if not halves.independent(self.color_noise):
            guides, images = guides[:1], images[:1]
        found = joint_filter(
            images, guides, list(features.values()), self.joint, self.memory, fused=self.fused
        )
        return found[0], found[-1], {name: feature.image for name, feature in features.items()}

    def _filtered(self, buffers: Buffers) -> dict[str, Feature]:
        """Filter the features and return each with the variance that is left."""
        result = {}
        for name, noise in self.noises.items():
            parts = Halves(*(x[:, None] for x in halves.halves(buffers, name, noise)))
            a, b = (x[:, 0] for x in self.prefilter.halves(parts, noise))
            mean, residual = 0.5 * (a + b), 0.25 * (b - a).square()
            tau = self.tau * mean.square() if buffer(name).kind == "distance" else self.tau
            result[name] = Feature.of(mean, residual, tau)
        return result
