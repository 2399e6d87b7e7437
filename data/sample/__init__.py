"""The small data set that ships: real frames of three scenes, in ingested form, under `bmfr/`."""

from pathlib import Path

SAMPLES = {"bmfr": Path(__file__).parent / "bmfr"}
"""Name after `sample:` → folder."""

TRAIN_PATCHES = 320
"""Training patches per 1280x720 frame that a sample is prepared with unless told otherwise: at the usual
density its few small frames give 5 patches each, too few to learn from."""
