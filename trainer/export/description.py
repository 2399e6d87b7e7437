"""What an exported artifact says about itself: the contract of its denoiser and where it came from."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from models.denoiser import Denoiser
from models.tiling import BYTES_PER_PIXEL

KEY = "penumbra"
"""Name of the entry in an ONNX file's `metadata_props`; a TorchScript archive holds `penumbra.json`."""

FORMAT_VERSION = 3
"""1: images. 2: also samples, what stands for what they lack, and working memory. 3: also the state
of recurrent methods."""

DISTRIBUTION = "penumbra-denoise"
DEFAULTS: dict[str, tuple[float, ...]] = {
    "exposure": (1.0,),
    "depth_range": (float("nan"), float("nan")),
    "thin_lens": (0.0, 0.0, 0.0),
}
"""Frame numbers of a caller that gives none; NaN means: measure it from these images."""


_MORE_MEMORY = 1.5
"""Working memory of an exported file beside that of its denoiser. For Layer at 256x256, with 8 or 32 samples,
ONNX Runtime was measured to take 1.2 times as much per pixel and TorchScript 1.4; for WSKP 1.6 times."""


@dataclass(frozen=True)
class Source:
    """Where the weights came from.

    Attributes:
        reference: What the user named: a path, an MLflow URI, a class.
        class_path: Import path of the denoiser's class.
        init_args: Its hyper-parameters, as plain values.
        sha256: Checksum of the file, empty where there is none.
        step: Training step of the weights, None where that is not known.
    """

    reference: str
    class_path: str = ""
    init_args: dict[str, Any] = field(default_factory=dict)
    sha256: str = ""
    step: int | None = None


@dataclass(frozen=True)
class Parity:
    """Largest difference between an artifact and the eager module it was made from.

    Attributes:
        error: Largest relative difference over all sizes (`trainer.export.parity` defines it).
        limit: Largest error with which an artifact is accepted.
        sizes: (batch, height, width) of each comparison.
        runtime: What ran the artifact, with its version.
        rounding: Where the error exceeds the limit: the eager module's own error against float64.
        counts: Samples per pixel of each comparison; empty where the denoiser reads none.
    """

    error: float
    limit: float
    sizes: tuple[tuple[int, int, int], ...]
    runtime: str
    rounding: float = 0.0
    counts: tuple[int, ...] = ()


@dataclass(frozen=True)
class Description:
    """Metadata of an artifact: all that tiling, `trainer denoise` and a reader of the file need to know.

    Attributes:
        model: Name of the denoiser's class.
        inputs, frame_numbers, halo, multiple, temporal, per_sample, samples, fill: As declared by it.
        source: Where the weights came from.
        parity: How well the file agrees with it.
        format: `onnx` or `torchscript`.
        output: Name of the output.
        version: Of this format (`FORMAT_VERSION`).
        versions: Of the distributions that wrote the file.
        bytes_per_pixel, bytes_once: Working memory, as in `models.denoiser.Denoiser`.
        state: `Denoiser.state_maps`.
    """

    model: str
    inputs: tuple[str, ...]
    frame_numbers: tuple[str, ...]
    halo: int
    multiple: int
    temporal: bool
    per_sample: bool
    source: Source
    parity: Parity | None = None
    format: str = "onnx"
    output: str = "color"
    version: int = FORMAT_VERSION
    versions: dict[str, str] = field(default_factory=dict)
    samples: tuple[str, ...] = ()
    fill: dict[str, float] = field(default_factory=dict)
    bytes_per_pixel: int = BYTES_PER_PIXEL
    bytes_once: int = 0
    state: dict[str, tuple[int, int]] = field(default_factory=dict)

    def to_json(self) -> str:
        """Return the description as one JSON object."""
        return json.dumps(asdict(self), default=str)

    @classmethod
    def from_json(cls, text: str) -> Description:
        """Read what `to_json` wrote.

        Raises:
            ValueError: The text is no description, or one of a later version of the format.
        """
        try:
            values = json.loads(text)
            if values["version"] > FORMAT_VERSION:
                raise ValueError(
                    f"its metadata has version {values['version']}, known up to {FORMAT_VERSION}; "
                    f"update {DISTRIBUTION}"
                )
            parity = values.pop("parity")
            if parity is not None:
                sizes = tuple((int(b), int(h), int(w)) for b, h, w in parity.pop("sizes"))
                counts = tuple(int(count) for count in parity.pop("counts", ()))
                parity = Parity(sizes=sizes, counts=counts, **parity)
            for name in ("inputs", "frame_numbers", "samples"):
                values[name] = tuple(values.get(name, ()))
            values["state"] = {n: (c, side) for n, (c, side) in values.get("state", {}).items()}
            description = cls(source=Source(**values.pop("source")), parity=parity, **values)
        except (LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
            raise ValueError(f"damaged metadata ({error!r}); export the model again") from error
        except json.JSONDecodeError as error:
            raise ValueError(f"damaged metadata ({error}); export the model again") from error
        if wrong := description.wrong():
            raise ValueError(
                f"damaged metadata ({wrong} has a value that it cannot have); export the model again"
            )
        return description

    def wrong(self) -> str:
        """Return the name of an entry whose value tiling or a reader could not use, nothing for none."""
        names = (*self.inputs, *self.frame_numbers, *self.samples)
        fits = {
            "inputs": bool(self.inputs) and all(isinstance(name, str) for name in names),
            "model": all(isinstance(text, str) for text in (self.model, self.format, self.output)),
            "halo": _within(self.halo, 0, 1 << 16),
            "multiple": _within(self.multiple, 1, 1 << 16),
            "bytes_per_pixel": _within(self.bytes_per_pixel, 0, 1 << 40),
            "bytes_once": _within(self.bytes_once, 0, 1 << 62),
            "state": all(_within(n, 1, 1 << 16) for pair in self.state.values() for n in pair)
            and all(self.multiple % side == 0 for _, side in self.state.values()),
            "temporal": isinstance(self.temporal, bool) and isinstance(self.per_sample, bool),
            "fill": isinstance(self.fill, dict)
            and all(isinstance(v, int | float) for v in self.fill.values()),
            "source": isinstance(self.source.class_path, str) and isinstance(self.source.init_args, dict),
        }
        return next((name for name, good in fits.items() if not good), "")


def _within(value: object, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def output_name(inputs: tuple[str, ...]) -> str:
    """Return the name of an ONNX file's output: `color`, or `denoised` where that is an input.

    An ONNX graph cannot have an input and an output of one name.
    """
    return "denoised" if "color" in inputs else "color"


def describe(denoiser: Denoiser, format: str, source: Source | None) -> Description:
    """Return the description of a denoiser that is about to be exported."""
    cls = type(denoiser)
    source = source or Source(reference="memory", class_path=f"{cls.__module__}.{cls.__qualname__}")
    return Description(
        model=cls.__name__,
        inputs=tuple(denoiser.inputs),
        frame_numbers=tuple(denoiser.frame_numbers),
        halo=int(denoiser.halo),
        multiple=int(denoiser.multiple),
        temporal=bool(denoiser.temporal),
        per_sample=bool(denoiser.per_sample),
        samples=tuple(denoiser.samples),
        fill=dict(denoiser.fill),
        source=source,
        format=format,
        output=output_name(tuple(denoiser.inputs)),
        bytes_per_pixel=max(
            BYTES_PER_PIXEL, denoiser.exported_bytes_per_pixel, int(_MORE_MEMORY * denoiser.bytes_per_pixel)
        ),
        bytes_once=int(denoiser.bytes_once),
        state={name: (int(c), int(side)) for name, (c, side) in denoiser.state_maps.items()},
        versions={name: installed_version(name) for name in (DISTRIBUTION, "torch", "onnx", "onnxruntime")},
    )


def installed_version(distribution: str) -> str:
    """Return the version of a distribution, or that it is not installed."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"
