"""The small data sets that ship, in ingested form.

`bmfr`: sequences of three known scenes. `stills` and `layers`: random scenes, made by `trainer render`.
"""

from pathlib import Path

FOLDER = Path(__file__).parent
"""Where they lie."""

SAMPLES = {name: FOLDER / name for name in ("bmfr", "stills", "layers")}
"""Name after `sample:` → folder."""

TRAIN_PATCHES = 320
"""Training patches per 1280x720 frame that a sample is prepared with unless told otherwise: at the usual
density its few small frames give 5 patches each, too few to learn from."""

CLIP_PATCHES = 320
"""Training patches per 1280x720 frame of clips that a sample is prepared with unless told otherwise: 25 clips
of seven frames for each scene of nine frames of 320x180, 160 MB of two, and 12 batches of four."""

CANDIDATES = 3600
"""Candidates of importance sampling per 1280x720 frame that a sample is prepared with unless told otherwise:
a hundred per frame of 160x160, of which about two thirds are kept."""

CROPS = 7200
"""Crops per 1280x720 frame of frames with samples of each pixel that a sample is prepared with unless told
otherwise: 32 per frame of 64x64."""
