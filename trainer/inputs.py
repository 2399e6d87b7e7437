"""What a method reads from a frame, and what it does where the frame lacks some of it."""

from __future__ import annotations

from collections.abc import Collection
from typing import Protocol

from data.buffers import SAMPLES, buffer
from data.camera import Camera, DepthKind
from data.derive import obtainable
from data.frame import Frame
from models.denoiser import Denoiser
from models.ops.halves import WRITTEN
from trainer.loading import Model
from trainer.options import options_of, spelled

_PARTS = ("_a", "_b", "_variance")


class Say(Protocol):
    """Shows a remark for the user."""

    def __call__(self, text: str, kind: str = "note", /) -> None:
        """Show it, as a `note` or a `warning`."""


def base(name: str) -> str:
    """Return the buffer that a name is a half or the variance of, otherwise the name."""
    for part in _PARTS:
        name = name.removesuffix(part)
    return name


class Fitting:
    """Finds the form of a model that does with the buffers of a frame.

    Args:
        model: The model, ready to be called.
        device: Where it runs.
        say: Called with the reason where another form is taken.
    """

    def __init__(self, model: Model, device: str, say: Say) -> None:
        self.model, self.device, self.say = model, device, say
        self._found: dict[frozenset[str], tuple[Model, tuple[str, ...]]] = {}
        bases = dict.fromkeys(base(name) for name in model.inputs)
        self._names = tuple(dict.fromkeys([*model.inputs, *(b + p for b in bases for p in ("", *_PARTS))]))

    def fit(
        self, frame: Frame, depth_kind: DepthKind, previous: Camera | None
    ) -> tuple[Model, tuple[str, ...]]:
        """Return the model for a frame, and why it is not the one that was asked for.

        Where there is no such form it is the model itself: deriving its inputs will fail and say what is
        missing.
        """
        if set(self.model.inputs) <= frame.buffers.keys():
            return self.model, ()
        has = self.has(frame, depth_kind, previous)
        if has not in self._found:
            self._found[has] = self._other(has)
        model, reasons = self._found[has]
        for reason in reasons:
            self.say(reason, "warning")
        return model, reasons

    def has(self, frame: Frame, depth_kind: DepthKind, previous: Camera | None) -> frozenset[str]:
        """Return which buffers there are, or can be derived, of those that forms of the model may read."""
        return frozenset(obtainable(frame, self._names, depth_kind=depth_kind, previous=previous))

    def _other(self, has: frozenset[str]) -> tuple[Model, tuple[str, ...]]:
        other = None if set(self.model.inputs) <= has else self.model.instead(has)
        if other is None:
            return self.model, ()
        model, reasons = other
        return model.eval().requires_grad_(False).to(self.device), reasons


def advice(model: Model, has: Collection[str]) -> str:
    """Return what makes the buffers that are missing, and which options of a method would do without.

    Args:
        model: Whose inputs are missing.
        has: Names of the buffers that there are or that can be derived.
    """
    options = options_of(type(model))
    missing = dict.fromkeys(base(name) for name in model.inputs if name not in has)
    # What has a variance or halves as well needs no option: `instead` takes it once the rest is settled.
    told = [n for n in missing if f"{n}_variance" in has or {f"{n}_a", f"{n}_b"} <= set(has)]
    alone = [name for name in missing if name in has and name not in told]
    found = [WRITTEN] if "color_noise" in options and missing else []
    if "color" in alone and "color_noise" in options:
        found.append("--option color_noise=estimated estimates the noise of color from the image itself")
    features = [name for name in alone if name != "color"]
    if features and "feature_noise" in options:
        found.append(
            f"--option feature_noise=none takes {', '.join(features)} as free of noise, "
            "feature_noise=estimated estimates it from the image"
        )
    absent = [name for name in missing if name not in has and name != "color"]
    used = getattr(model, "features", None)
    if absent and "features" in options and isinstance(used, (tuple, list)) and set(absent) <= set(used):
        rest = spelled([name for name in used if name not in absent])
        found.append(f"--option features={rest} does without {', '.join(absent)}")
    if not found and missing and isinstance(model, Denoiser):
        return model.made_by([name for name in model.inputs if name not in has])
    return "; ".join(found)


def replaced_pixels(frame: Frame) -> str | None:
    """Return which pixels of a frame are not what its file holds, in one sentence; None where all are.

    From `notes["repaired"]`, pixels that were NaN or Inf, and `notes["outside_data_window"]`. Samples that do
    not count are not among them: see `data.dropped`.
    """
    parts = []
    for name, number in frame.notes.get("repaired", {}).items():
        if name == SAMPLES:
            far = "infinite distances of samples" if number > 1 else "infinite distance of a sample"
            parts.append(f"{number} {far}, replaced by 0, that of a ray that left the scene")
            continue
        neighbours = buffer(name).repair == "neighbours"
        by = "the mean of their finite neighbours, 0 where there are none" if neighbours else _no_hit(name)
        parts.append(f"{_pixels(number, name)} NaN or Inf, replaced by {by}")
    for name, number in frame.notes.get("outside_data_window", {}).items():
        parts.append(f"{_pixels(number, name)} outside of the data window, replaced by {_no_hit(name)}")
    return "; ".join(parts) or None


def _pixels(number: int, name: str) -> str:
    return f"{number} pixel{'s' * (number != 1)} of {name} {'was' if number == 1 else 'were'}"


def _no_hit(name: str) -> str:
    return f"{buffer(name).no_hit:g}, the value of a pixel that hit nothing"
