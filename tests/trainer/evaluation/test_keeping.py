"""The folder of an evaluation is for its frames; rows are taken over where all that belongs to them is."""

import json
import os

import numpy as np
import pytest

from data.exr_image import write_exr
from trainer.clips import find_clips
from trainer.evaluation import keeping
from trainer.evaluation.keeping import Kept, id_of, identity_of, take_folder
from trainer.evaluation.plan import Method

HALF = Method("half", "x", folder="half")


def row(name="f0", **more):
    return {"method": "half", "identity": "now", "name": name, "status": "done", "reference": True, **more}


@pytest.fixture
def folder(tmp_path):
    """An evaluation with one picture of one method."""
    place = tmp_path / "out"
    take_folder(place, "these", "frames")
    picture(place, "half", "f0.exr")
    return place


def picture(folder, method, name):
    path = folder / "images" / method / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")


def test_an_evaluation_goes_on_in_its_folder(folder):
    before = id_of(folder)
    take_folder(folder, "these", "frames")
    assert id_of(folder) == before
    assert (folder / "images").is_dir()


def test_other_frames_need_another_folder_or_force(folder):
    (folder / "notes.txt").write_text("mine")
    before = id_of(folder)
    with pytest.raises(ValueError, match=r"an evaluation of frames whose frames are others.*--force"):
        take_folder(folder, "those", "others")
    assert (folder / "images").is_dir()
    take_folder(folder, "those", "others", force=True)
    assert id_of(folder) != before
    assert {path.name for path in folder.iterdir()} == {"data.json", "notes.txt"}


def test_a_folder_with_something_else_is_left_alone_even_by_force(tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(ValueError, match="something else"):
        take_folder(tmp_path, "these", "frames", force=True)
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize("change", ["time", "size", "name", "more"])
def test_frames_that_were_changed_are_others(tmp_path, change):
    for name in ("f0", "f1"):
        write_exr(tmp_path / f"{name}.exr", {"R": np.zeros((4, 4), np.float32)})

    def identity():
        return identity_of(str(tmp_path), find_clips([str(tmp_path)]))

    before, file = identity(), tmp_path / "f1.exr"
    assert identity() == before
    if change == "time":
        os.utime(file, (1, 1))
    elif change == "size":
        state = file.stat()
        file.write_bytes(file.read_bytes() + b"x")
        os.utime(file, ns=(state.st_atime_ns, state.st_mtime_ns))
    elif change == "name":
        file.rename(tmp_path / "f2.exr")
    else:
        (tmp_path / "f2.exr").write_bytes(file.read_bytes())
    assert identity() != before


def test_rows_are_taken_over_where_they_were_made_as_now_and_did_not_fail(folder):
    kept = Kept(folder)
    for made in (row(), row("f1"), row("f2", identity="before"), row("f3", status="failed")):
        kept.add(made)
    for name in ("f1", "f2", "f3"):
        picture(folder, "half", f"{name}.exr")
    assert set(Kept(folder).of(HALF, "now")) == {"f0", "f1"}


def test_rows_whose_pictures_are_gone_are_not_taken_over(folder):
    kept = Kept(folder)
    kept.add(row())
    kept.add(row("f1"))
    assert set(Kept(folder).of(HALF, "now")) == {"f0"}


def test_the_input_needs_its_reference_and_places_too(folder):
    noisy = Method("input", "x", folder="input")
    Kept(folder).add(row(method="input", places=True))
    for needed in ("input/f0.exr", "reference/f0.exr", "places/f0.npz"):
        assert not Kept(folder).of(noisy, "now")
        picture(folder, *needed.split("/"))
    assert set(Kept(folder).of(noisy, "now")) == {"f0"}


def test_damaged_lines_are_left_out_and_others_stay(folder):
    whole = json.dumps(row()) + "\n"
    (folder / "rows.jsonl").write_text(whole + '{"method": "ha\n' + "7\n" + whole[:10])
    assert set(Kept(folder).of(HALF, "now")) == {"f0"}
    assert (folder / "rows.jsonl").read_text() == whole


class FullDisk:
    """A file of which half a line can be written."""

    def __init__(self, file):
        self.file = file

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        self.file.close()

    def tell(self):
        return self.file.tell()

    def write(self, data):
        self.file.write(data[: len(data) // 2])
        self.file.flush()
        raise OSError(28, "No space left on device")


def test_a_full_disk_leaves_no_half_line(folder, monkeypatch):
    kept = Kept(folder)
    kept.add(row())
    before, real = kept.path.read_bytes(), keeping.Path.open
    with monkeypatch.context() as full:
        full.setattr(keeping.Path, "open", lambda path, mode: FullDisk(real(path, mode)))
        with pytest.raises(OSError, match="No space"):
            kept.add(row("f1"))
    assert kept.path.read_bytes() == before
