"""The small data set that ships: real frames of three scenes, in ingested form, under `bmfr/`."""

from pathlib import Path

SAMPLES = {"bmfr": Path(__file__).parent / "bmfr"}
"""Name after `sample:` → folder."""
