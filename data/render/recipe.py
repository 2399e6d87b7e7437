"""What is rendered of every scene: three recipes, for stills, for sequences and for samples kept apart."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

from data.buffers import SECOND_ALBEDO

Kind = Literal["stills", "sequences", "samples"]

PASS_SAMPLES = 2**23
"""Samples of one pass of a reference: about half a minute of work, which is what an interruption can lose."""

RECIPE_VERSION = 1
"""Part of every job's key; raise it when the same recipe gives other pixels than before."""

STILLS = (
    "radiance",
    "diffuse",
    "normal",
    "depth",
    "position",
    "diffuse_albedo",
    "specular_albedo",
    "roughness",
    "hit",
    "visibility",
)
SEQUENCES = (
    "radiance",
    "normal",
    "depth",
    "position",
    "motion",
    "diffuse_albedo",
    "specular_albedo",
    "roughness",
    "hit",
)
SAMPLES = (
    "radiance",
    "normal",
    "depth",
    "diffuse_albedo",
    "specular_albedo",
    "roughness",
    "motion",
    "coc",
    "lens",
    "time",
)
"""The radiance and the guides of Munkberg and Hasselgren 2020: 20 numbers."""


ADDITIONS: dict[str, Any] = {"histogram": False, "histogram_exposure": None, "second_hit": False}
"""Options about buffers that are added, of the same samples, and what they are where nothing is added."""


@dataclass(frozen=True)
class Recipe:
    """What is rendered of every view.

    Attributes:
        kind: `stills`, `sequences` or `samples`.
        width: Columns.
        height: Rows.
        spp: Samples per pixel of the noisy images, ascending; a view of `stills` gives one frame for each.
        reference_spp: Samples per pixel of the reference.
        max_depth: Longest path, in segments.
        chunk: Samples traced at once. Larger ones need more memory: about 1 kB per sample.
        histogram: `stills` also have the histogram of each pixel's samples.
        histogram_exposure: Factor on the radiance that histograms count; None: measured of each view. 1 is
            radiance as it was rendered, which the authors' program counts.
        second_hit: `stills` also have the albedo of the second hits, and halves and variance of positions.
    """

    kind: Kind
    width: int
    height: int
    spp: tuple[int, ...]
    reference_spp: int
    max_depth: int = 8
    chunk: int = 2**20
    histogram: bool = False
    histogram_exposure: float | None = None
    second_hit: bool = False

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: Names the option and what was expected.
        """
        if self.kind not in get_args(Kind):
            raise ValueError(f"recipe {self.kind!r}: expected one of {', '.join(get_args(Kind))}")
        if min(self.width, self.height) < 16:
            raise ValueError(f"--size {self.width}x{self.height}: expected at least 16x16 pixels")
        if not self.spp or list(self.spp) != sorted(set(self.spp)) or self.spp[0] < 1:
            raise ValueError(f"--spp {' '.join(map(str, self.spp))}: expected ascending positive numbers")
        if self.kind == "stills" and any(n % 2 for n in self.spp):
            odd = next(n for n in self.spp if n % 2)
            raise ValueError(f"--spp {odd}: stills have two half buffers, so the numbers must be even")
        if self.kind != "stills" and len(self.spp) > 1:
            raise ValueError(f"--spp: {self.kind} take one number")
        if self.histogram and self.kind != "stills":
            follows = ": their histograms follow from their samples" if self.kind == "samples" else ""
            raise ValueError(f"--histogram is for stills, not {self.kind}{follows}; leave it out")
        if self.histogram_exposure is not None:
            if not self.histogram:
                raise ValueError("--histogram-exposure is for --histogram: give both, or leave it out")
            if not 0 < self.histogram_exposure < math.inf:
                raise ValueError(
                    f"--histogram-exposure {self.histogram_exposure}: expected a positive number"
                )
        if self.second_hit and self.kind != "stills":
            raise ValueError(f"--second-hit is for stills, not {self.kind}; leave it out")
        if self.reference_spp < 2:
            raise ValueError(f"--reference-spp {self.reference_spp}: expected at least 2")
        if self.max_depth < 2:
            raise ValueError(f"--max-depth {self.max_depth}: expected at least 2, which is direct light")
        if self.chunk < 1024:
            raise ValueError(f"chunk {self.chunk}: expected at least 1024 samples")

    @property
    def pixels(self) -> int:
        """Pixels of a view."""
        return self.width * self.height

    @property
    def pass_spp(self) -> int:
        """Samples per pixel of a pass of the reference; the last pass may have fewer."""
        return max(1, PASS_SAMPLES // self.pixels)

    @property
    def names(self) -> tuple[str, ...]:
        """Quantities of the noisy samples."""
        names = {"stills": STILLS, "sequences": SEQUENCES, "samples": SAMPLES}[self.kind]
        return (*names, SECOND_ALBEDO) if self.second_hit else names

    @property
    def reference_names(self) -> tuple[str, ...]:
        """Quantities of a reference's samples; only methods for stills have the light split."""
        return ("radiance", "diffuse") if self.kind == "stills" else ("radiance",)

    def samples_per_view(self) -> int:
        """Return how many samples a view needs, reference included."""
        return self.pixels * (self.spp[-1] + self.reference_spp)

    def to_json(self) -> dict[str, Any]:
        """Return plain data for the manifest; additions that are not asked for are not in it.

        So a recipe without them is what it was before there were any.
        """
        values = {**asdict(self), "spp": list(self.spp), "version": RECIPE_VERSION}
        return {
            name: value for name, value in values.items() if name not in ADDITIONS or value != ADDITIONS[name]
        }

    def same_work(self, other: dict[str, Any]) -> bool:
        """Return whether a manifest's recipe is this one but for the samples of the reference."""
        mine = {**self.to_json(), "reference_spp": other.get("reference_spp")}
        same = all(other.get(name, without) == getattr(self, name) for name, without in ADDITIONS.items())
        return same and all(other.get(name) == value for name, value in mine.items())


def defaults(kind: Kind) -> Recipe:
    """Return the recipe of a kind where nothing is said: sizes for one machine without a GPU.

    The published sets are larger: BMFR 1280x720 with 4096 samples, AFGSA 1280x720 with 32768, layers 8 and
    4096 samples.
    """
    if kind == "stills":
        return Recipe(kind, 256, 256, (4, 8, 16, 32, 64, 128), 1024)
    if kind == "sequences":
        return Recipe(kind, 320, 180, (1,), 512)
    return Recipe(kind, 128, 128, (8,), 1024)


def view_key(identity: dict[str, Any], frame: int, recipe: Recipe) -> str:
    """Return the hash of everything that decides the pixels of a view, but for the reference's samples.

    Args:
        identity: What tells the scene from others; plain JSON.
        frame: Number of the view.
        recipe: What is rendered.
    """
    kept = {name: value for name, value in recipe.to_json().items() if name != "reference_spp"}
    job = json.dumps({"scene": identity, "frame": frame, "recipe": kept}, sort_keys=True)
    return hashlib.sha256(job.encode()).hexdigest()[:24]


def stream_key(identity: dict[str, Any], frame: int, recipe: Recipe) -> str:
    """Return the hash that the seeds of a view follow from.

    It is the key of the view without additions: whoever renders again with them gets the same samples.
    """
    return view_key(identity, frame, replace(recipe, **ADDITIONS))


def seed_of(key: str, role: str, number: int = 0) -> int:
    """Return an independent 31-bit seed for a role (`input`, `reference`) and number of a view's pass."""
    digest = hashlib.sha256(f"{key}\0{role}\0{number}".encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x7FFFFFFF


def with_options(recipe: Recipe, **options: Any) -> Recipe:
    """Return a recipe in which the options that are not None replace the defaults."""
    return replace(recipe, **{name: value for name, value in options.items() if value is not None})
