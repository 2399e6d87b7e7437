"""What training asks of a data set that is prepared on the fly: buffers, and how many patches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from data.buffers import SAMPLES
from data.manifest import FrameRecord
from data.root import SAMPLE
from data.sample import CANDIDATES, CLIP_PATCHES, CROPS, TRAIN_PATCHES
from data.shards.options import recipe_options


def beside(recipe: str | None, names: Sequence[str]) -> tuple[str, ...]:
    """Return which of these buffers must be asked for: those that batches do not have anyway."""
    usual = recipe_options(recipe, {}).stored
    made = (*usual, "color", "irradiance", SAMPLES)  # one of the two follows from the other in a batch
    return tuple(dict.fromkeys(name for name in names if name not in made))


def patch_number(root: str, recipe: str | None, number: int | None) -> dict[str, int | None]:
    """Return how many patches are cut, as an option of `PrepareOptions`; see `data.Shards`."""
    sample = root.startswith(SAMPLE)
    if recipe_options(recipe, {}).sampling == "importance":
        return {"candidates": CANDIDATES if number is None and sample else number}
    if number is None and sample:
        number = {None: TRAIN_PATCHES, "layers": CROPS, "recurrent": CLIP_PATCHES}.get(recipe)
    return {"train_patches": number}


def explain_lacking(reader: str, root: Path, record: FrameRecord, missing: Sequence[str]) -> str:
    """Return what to tell where a frame lacks buffers that are read.

    Args:
        reader: Who reads them.
        root: The data set.
        record: The frame.
        missing: The buffers.
    """
    if any(name.endswith("_variance") for name in missing):
        needed = "variances of the mean, such as sample:stills or the layout kpcn"
    elif {"diffuse", "specular", "reference_diffuse"} & set(missing):
        needed = "diffuse and specular light apart, such as sample:stills or the layout acfm"
    else:
        needed = "them"
    return (
        f"{reader} reads {', '.join(missing)}, which {root / record.file} neither holds nor lets derive; "
        f"name a --data.root with {needed}, or train a network that does without"
    )
