"""What is measured: a case is one method in one setting; what came of it. Nothing heavy is imported here."""

from __future__ import annotations

import re
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

KINDS = ("inference", "training")
PRECISIONS = ("float32", "bfloat16", "float16")
MODES = ("eager", "compiled", "onnx", "torchscript")
EXPORTED = {".onnx": "onnx", ".ts": "torchscript"}
"""Suffix of exported files → the only mode that they run in."""

SIZES = {"inference": (1280, 720), "training": (128, 128)}
BATCHES = {"inference": 1, "training": 8}
MEMORY = 2 * 1024**3


@dataclass(frozen=True)
class Method:
    """A model as `--model` names it, with its options.

    Attributes:
        model: Checkpoint, registered model, exported file or class name; of a class with weights, random ones
            are measured, since no time depends on them.
        options: `KEY=VALUE`, constructor arguments where a class is named.
    """

    model: str
    options: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """How tables call it."""
        return " ".join((self.model.rstrip("/"), *self.options))

    @property
    def format(self) -> str | None:
        """The format of an exported file, None for every other model."""
        return next((mode for suffix, mode in EXPORTED.items() if self.model.endswith(suffix)), None)

    @property
    def is_class(self) -> bool:
        """Whether a class is named, not a file, a folder or a registered model."""
        file = self.model.endswith((".ckpt", ".pt", ".pth", *EXPORTED))
        named = re.fullmatch(r"[A-Za-z_][\w.]*", self.model) is not None
        return named and not file and not Path(self.model).exists()


@dataclass(frozen=True)
class Case:
    """One method in one setting.

    Attributes:
        method: The method.
        kind: `inference` or `training`.
        width: Columns of an image.
        height: Rows.
        batch: Images at once.
        precision: Of the arithmetic; less than float32 by `torch.autocast`, as in training.
        device: `cpu`, `cuda`, `cuda:1` …
        mode: `eager`, `compiled`, `onnx` or `torchscript`.
        spp: Samples per pixel of methods that read them.
        memory: Bytes that one call may take before the image is cut into tiles, as in `trainer denoise`.
        revision: Of the packages; empty: these here.
    """

    method: Method
    kind: str = "inference"
    width: int = 1280
    height: int = 720
    batch: int = 1
    precision: str = "float32"
    device: str = "cpu"
    mode: str = "eager"
    spp: int = 8
    memory: int = MEMORY
    revision: str = ""

    @property
    def settings(self) -> dict[str, str]:
        """What the case is, in words; tables show what differs between cases."""
        return {
            "model": self.method.label,
            "kind": self.kind,
            "size": f"{self.width}x{self.height}",
            "batch": str(self.batch),
            "precision": self.precision,
            "device": self.device,
            "mode": self.mode,
            **({"revision": self.revision} if self.revision else {}),
        }

    @property
    def label(self) -> str:
        """All of it in one line."""
        said = self.settings | {"batch": f"batch {self.batch}"}
        return " ".join(said.values())


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    Attributes:
        repeat: Calls that are measured.
        warmup: Calls before them, at least one; it also takes the memory.
        seconds: Measuring of a case stops after so many, yet not before three calls.
    """

    repeat: int = 15
    warmup: int = 2
    seconds: float = 20.0


@dataclass(frozen=True)
class Outcome:
    """What came of a case.

    Attributes:
        case: The case.
        reason: Why there are no figures; None where there are.
        seconds: Of every measured call.
        first_seconds: Of the first call, which compiles and allocates.
        megapixels: That one call computes, of all images of the batch and frames of a sequence.
        peak_bytes: Memory that the calls took beside the loaded model and the images.
        threads: Of PyTorch.
        device_name: Name of the GPU, None on the CPU.
        others: Share of all cores that other programs took meanwhile, 0 to 1.
    """

    case: Case
    reason: str | None = None
    seconds: tuple[float, ...] = ()
    first_seconds: float = 0.0
    megapixels: float = 0.0
    peak_bytes: int = 0
    threads: int = 0
    device_name: str | None = None
    others: float = 0.0

    @property
    def done(self) -> bool:
        """Whether there are figures."""
        return self.reason is None

    @property
    def median(self) -> float:
        """Median seconds of a call."""
        return statistics.median(self.seconds)

    @property
    def quartiles(self) -> tuple[float, float]:
        """Seconds that a quarter and three quarters of the calls stayed below."""
        return spread(self.seconds)

    def row(self) -> dict[str, Any]:
        """Return all of it for a file."""
        case = asdict(self.case)
        row: dict[str, Any] = {**case.pop("method"), **case, "status": "done" if self.done else "failed"}
        row["reason"] = self.reason
        if not self.done:
            return row
        return row | {
            "median_seconds": self.median,
            "quartiles_seconds": list(self.quartiles),
            "seconds_per_megapixel": self.median / self.megapixels,
            "peak_bytes": self.peak_bytes,
            "peak_bytes_per_megapixel": self.peak_bytes / self.megapixels,
            "first_call_seconds": self.first_seconds,
            "megapixels": self.megapixels,
            "threads": self.threads,
            "device_name": self.device_name,
            "share_of_other_programs": self.others,
            "seconds": list(self.seconds),
        }


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Return the lower and the upper quartile."""
    if len(values) < 2:
        return values[0], values[0]
    low, _, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, high


def cases_of(methods: Sequence[Method], chosen: Mapping[str, Sequence[Any]], **same: Any) -> list[Case]:
    """Return a case for every combination, those of one method one after another.

    Args:
        methods: What to measure; an exported file gets one mode only, that of its format.
        chosen: `kind`, `size` (width, height; none: a usual one of the kind), `batch` (the same),
            `precision`, `device`, `mode`.
        same: Fields that all cases share.
    """
    cases = []
    for method in methods:
        modes = [method.format] if method.format else chosen["mode"]
        axes = (chosen["kind"], chosen["device"], chosen["precision"], modes)
        for kind, device, precision, mode in product(*axes):
            sizes, batches = chosen["size"] or [SIZES[kind]], chosen["batch"] or [BATCHES[kind]]
            for (width, height), batch in product(sizes, batches):
                cases.append(Case(method, kind, width, height, batch, precision, device, mode, **same))
    return cases
