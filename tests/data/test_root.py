from __future__ import annotations

from pathlib import Path

import pytest

from data.root import resolve_root
from tests.data.small_sets import write_shards


def touch(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")


def test_the_sample_that_ships_is_a_data_root():
    root = resolve_root("sample:bmfr")
    assert root.kind == "frames"
    assert (root.path / "manifest.json").is_file()


def test_a_misspelt_sample_names_the_nearest_and_all():
    with pytest.raises(
        FileNotFoundError, match=r"no data set sample:bmrf; did you mean sample:bmfr\? known: "
    ):
        resolve_root("sample:bmrf")


def test_ingested_and_prepared_folders_are_told_apart(tmp_path: Path):
    index = write_shards(tmp_path)
    assert resolve_root(index.root).kind == "shards"
    assert resolve_root(tmp_path / "frames").kind == "frames"


def test_a_missing_folder_names_the_commands(tmp_path: Path):
    with pytest.raises(
        FileNotFoundError, match=r"does not exist.*trainer ingest.*trainer prepare.*sample:bmfr"
    ):
        resolve_root(tmp_path / "nothing")


def test_shards_without_index_say_how_to_prepare_anew(tmp_path: Path):
    touch(tmp_path / "train-00000.tar")
    with pytest.raises(ValueError, match=f"no index.json.*trainer prepare FRAMES --output {tmp_path}"):
        resolve_root(tmp_path)


def test_an_interrupted_preparation_says_how_to_continue(tmp_path: Path):
    touch(tmp_path / "set.partial" / "plan.json")
    with pytest.raises(ValueError, match=f"continue it with: trainer prepare FRAMES --output {tmp_path}/set"):
        resolve_root(tmp_path / "set")


def test_frames_without_manifest_say_how_to_ingest(tmp_path: Path):
    touch(tmp_path / "hall" / "f000.exr")
    with pytest.raises(ValueError, match=f"no manifest.json.*trainer ingest .*--output {tmp_path}"):
        resolve_root(tmp_path)


@pytest.mark.parametrize(
    ("file", "below", "layout"),
    [
        ("classroom/inputs/color0.exr", "", "bmfr"),
        ("classroom/inputs/color0.exr", "classroom", "bmfr"),
        ("hall/sequence.json", "", "penumbra"),
        ("video/hall/sequence.json", "", "penumbra"),
    ],
)
def test_raw_layouts_name_the_ingest_command(tmp_path: Path, file: str, below: str, layout: str):
    touch(tmp_path / "set" / file)
    root = tmp_path / "set" / below
    with pytest.raises(
        ValueError, match=f"trainer ingest --layout {layout} {tmp_path / 'set'} --output {root}-"
    ):
        resolve_root(root)


def test_a_folder_above_a_data_set_names_it(tmp_path: Path):
    write_shards(tmp_path)
    with pytest.raises(ValueError, match=f"--data.root {tmp_path}/frames"):
        resolve_root(tmp_path)


def test_any_other_folder_names_both_commands(tmp_path: Path):
    with pytest.raises(
        ValueError, match=r"neither manifest.json .*trainer ingest.*nor index.json .*trainer prep"
    ):
        resolve_root(tmp_path)
