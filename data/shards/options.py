"""How frames become shards: the options, and what the published methods were trained on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

from data.buffers import buffer
from data.importance import CANDIDATES, FLOOR

BUFFERS = ("color", "irradiance", "albedo", "normal", "depth", "history", "reference")
"""What shards hold of every frame that has it, where the options do not say otherwise."""

GUIDED = ("color", "albedo", "normal", "depth", "reference")
"""What methods without history read."""

LONGEST_CLIP = 1024
"""Frames of a clip, at most."""

Sampling = Literal["uniform", "importance"]
KeepSamples = Literal["auto", "half", "none"]


@dataclass(frozen=True)
class PrepareOptions:
    """How frames become shards.

    Attributes:
        patch_size: Width and height of training and validation patches.
        train_patches: Training patches per 1280x720 frame; other sizes keep the density.
        validation_patches: Validation patches per 1280x720 frame.
        samples_per_shard: Largest number of patches in a shard.
        accumulate: Accumulate irradiance over the preceding frames of a sequence.
        seed: Seed of the patch positions.
        wskp_legacy_crops: Positions and number as in the authors' script of WSKP (77 crops, zero padding).
        buffers: Buffers to keep beside the usual ones; every frame must have them.
        sampling: `uniform` positions, or `importance`: more where a frame is noisy (`data.importance`).
        candidates: Candidates per 1280x720 frame for importance sampling, before pruning; other sizes keep
            the density. Where validation patches come from the training frames, they have the share that
            `validation_patches` has of `train_patches`.
        importance_floor: Smallest squared mean that the variance of colour is divided by.
        validation_share: Share of the training scenes' views that is held out for validation, where the
            manifest has no scenes for it; at 0 validation patches come from the training frames.
        spp: Frames with these samples per pixel alone; empty: all.
        samples: What happens to samples that frames keep apart. `auto`: stored without loss of precision;
            `half`: in half precision, radiance clipped to [0, 65504], as the published set of the layer
            method; `none`: left out.
        only: Buffers to keep instead of `BUFFERS`, of every frame that has them.
        frames: Consecutive frames of a patch. More than one makes clips: the same window of so many frames of
            a sequence. Patches keep their number per pixel, so that there are about as many times fewer.
        recipe: Name of the recipe that the options began with, for the record.
    """

    patch_size: int = 128
    train_patches: int = 80
    validation_patches: int = 20
    samples_per_shard: int = 256
    accumulate: bool = True
    seed: int = 1
    wskp_legacy_crops: bool = False
    buffers: tuple[str, ...] = ()
    sampling: Sampling = "uniform"
    candidates: int = CANDIDATES
    importance_floor: float = FLOOR
    validation_share: float = 0.0
    spp: tuple[int, ...] = ()
    samples: KeepSamples = "auto"
    only: tuple[str, ...] = ()
    frames: int = 1
    recipe: str = ""

    def __post_init__(self) -> None:
        lowest = {"patch_size": 1, "train_patches": 1, "validation_patches": 0, "samples_per_shard": 1}
        for name, low in {**lowest, "candidates": 1, "frames": 1}.items():
            if getattr(self, name) < low:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {low}")
        for name, kind in (("sampling", Sampling), ("samples", KeepSamples)):
            if getattr(self, name) not in get_args(kind):
                known = ", ".join(get_args(kind))
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected one of {known}")
        if not 0 <= self.validation_share < 1:
            raise ValueError(
                f"validation_share is {self.validation_share}; expected a share, 0 or more and less than 1"
            )
        if not self.importance_floor > 0:
            raise ValueError(f"importance_floor is {self.importance_floor}; expected a positive number")
        if self.wskp_legacy_crops and self.sampling == "importance":
            raise ValueError("legacy crops of WSKP are uniform; use them without importance sampling")
        self._check_clips()
        for name in (*self.buffers, *self.only):
            buffer(name)

    def _check_clips(self) -> None:
        if self.frames > LONGEST_CLIP:
            raise ValueError(f"frames is {self.frames}; expected at most {LONGEST_CLIP}")
        if self.frames > 1 and self.validation_share > 0:
            raise ValueError(
                f"validation_share is {self.validation_share}, which holds out single views; clips of "
                f"{self.frames} frames would run through them: ingest with scenes for validation instead"
            )
        if self.frames > 1 and self.samples == "half":
            raise ValueError("clips hold no samples of each pixel; leave them out with --samples none")

    @property
    def stored(self) -> tuple[str, ...]:
        """Buffers that go into shards."""
        return tuple(dict.fromkeys((*(self.only or BUFFERS), *self.buffers, "reference")))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


RECIPES: dict[str, dict[str, Any]] = {
    "bmfr": {"samples": "none"},
    "afgsa": {
        "sampling": "importance",
        "validation_share": 0.05,
        "accumulate": False,
        "samples": "none",
        "only": GUIDED,
    },
    "layers": {
        "train_patches": 56,
        "validation_patches": 14,
        "accumulate": False,
        "samples": "half",
        "only": GUIDED,
    },
    "recurrent": {
        "frames": 7,
        "samples_per_shard": 36,
        "accumulate": False,
        "samples": "none",
        "only": GUIDED,
    },
}
"""What differs from the defaults for each published method.

bmfr: WSKP's protocol on the BMFR data set, 80 training and 20 validation patches per frame, accumulated [Fan
et al. 2021, section 5]. afgsa: 400 candidates per frame, pruned, one frame in twenty held out [Yu et al. 2021
and their code]. layers: Munkberg and Hasselgren 2020 train on a new 128-pixel crop of each frame in every
epoch; shards hold as many crops as cover a frame's area once, 56 per 1280x720, and samples in half precision.
recurrent: Chaitanya et al. 2017 train on the same 128-pixel window of seven consecutive frames, of which the
network makes its own history; 36 clips take as many bytes as the 256 patches of other shards.
"""


def recipe_options(recipe: str | None, explicit: Mapping[str, Any]) -> PrepareOptions:
    """Return the options of a recipe, with those that were named explicitly in their place.

    Args:
        recipe: A name of `RECIPES`, None for the defaults.
        explicit: Option → value; None values count as not named.

    Raises:
        ValueError: Unknown recipe, or an option that cannot be.
    """
    if recipe is not None and recipe not in RECIPES:
        raise ValueError(f"unknown recipe {recipe!r}; expected one of {', '.join(RECIPES)}")
    known = {field.name for field in fields(PrepareOptions)}
    named = {name: value for name, value in explicit.items() if value is not None}
    assert named.keys() <= known
    return PrepareOptions(**{**RECIPES.get(recipe or "", {}), "recipe": recipe or "", **named})
