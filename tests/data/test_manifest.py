import json
import os

import pytest

from data.manifest import MANIFEST, FrameRecord, Manifest, SceneRecord, load_manifest, make_splits, write_json


def record(index, scene="a", **changes):
    values = {"file": f"{scene}/f{index:03d}.exr", "bytes": 10, "sha256": "0" * 64, "width": 8, "height": 4}
    return FrameRecord(index=index, exposure=1.0, **{**values, **changes})


def manifest(**changes):
    scenes = {n: SceneRecord((record(0, n), record(1, n)), credit="Zoë") for n in "ab"}
    splits = {"train": ["a"], "validation": [], "test": ["b"]}
    values = {"name": "set", "layout": "bmfr", "depth": "z", "splits": splits, "scenes": scenes}
    return Manifest(**{**values, **changes})


def test_a_manifest_survives_writing_and_reading(tmp_path):
    manifest().save(tmp_path)
    copy = load_manifest(tmp_path)
    assert copy == manifest()
    assert copy.hash == manifest().hash
    assert copy.frame_count == 4


def test_the_hash_depends_on_content_and_not_on_order_of_keys(tmp_path):
    values = manifest().to_json()
    turned = {k: values[k] for k in reversed(values)}
    assert Manifest.from_json(json.loads(json.dumps(turned))).hash == manifest().hash
    changed = manifest(notes="rounded")
    assert changed.hash != manifest().hash


def test_the_hash_is_stable_across_versions_of_this_program():
    assert manifest().hash == "aaed91a1d28ce0aab8fa476458b8c324b9f5a21b432816eef78020ed37535869"


def test_split_of_a_scene_is_found():
    assert manifest().split_of("b") == "test"
    with pytest.raises(ValueError, match="scene 'c' is in no split; scenes: a, b"):
        manifest().split_of("c")


def test_an_absent_manifest_says_what_to_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no ingested data set.*run `trainer ingest --layout"):
        load_manifest(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is damaged"),
        ("[]", "is not a manifest of frames"),
        ('{"format": "other"}', "is not a manifest of frames"),
        ('{"format": "penumbra-frames", "version": 9}', "has version 9, this program reads version 1"),
        ('{"format": "penumbra-frames", "version": 1}', "is incomplete or damaged"),
    ],
)
def test_a_damaged_manifest_is_refused(tmp_path, text, message):
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(ValueError, match=message):
        load_manifest(tmp_path)


def test_an_unknown_key_is_named():
    values = manifest().to_json() | {"colour": 1}
    with pytest.raises(ValueError, match="unknown key 'colour'"):
        Manifest.from_json(values)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"splits": {"train": ["a"]}}, "scene 'b' is in no split"),
        ({"splits": {"train": ["a", "b"], "test": ["b"]}}, "scene 'b' is listed twice"),
        ({"splits": {"train": ["a", "b", "c"]}}, "a split names 'c', but the scenes are a, b"),
        ({"splits": {"train": ["a", "b"], "eval": []}}, "unknown split 'eval'"),
        ({"depth": "inverse"}, "depth is 'inverse'"),
        ({"scenes": {"a": SceneRecord(()), "b": SceneRecord((record(0),))}}, "scene 'a' has no frames"),
        (
            {"scenes": {"a": SceneRecord((record(1), record(0))), "b": SceneRecord((record(0),))}},
            "ascending order",
        ),
    ],
)
def test_content_that_does_not_fit_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        manifest(**changes).validate()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"file": "../secret.exr"}, "lies outside the data set"),
        ({"file": "/etc/passwd"}, "lies outside the data set"),
        ({"sha256": "12"}, "is damaged"),
        ({"exposure": 0.0}, "is damaged"),
    ],
)
def test_damaged_frame_records_are_refused(changes, message):
    values = manifest().to_json()
    values["scenes"]["a"]["frames"][0].update(changes)
    with pytest.raises(ValueError, match=message):
        Manifest.from_json(json.loads(json.dumps(values)))


def test_the_last_scene_is_held_out_unless_one_is_named():
    assert make_splits("abc") == {"train": ["a", "b"], "validation": [], "test": ["c"]}
    assert make_splits("abc", ["a"], ["c"]) == {"train": ["b"], "validation": ["c"], "test": ["a"]}
    assert make_splits("abc", validation=["c"])["test"] == ["b"]
    assert make_splits("a") == {"train": ["a"], "validation": [], "test": []}


@pytest.mark.parametrize(
    ("test", "validation", "message"),
    [
        (["x"], [], "there is no scene 'x' to hold out; scenes: a, b"),
        (["a"], ["a"], "scene 'a' is named for both"),
        (["a", "b"], [], "no scene is left for training"),
    ],
)
def test_splits_that_cannot_be_are_refused(test, validation, message):
    with pytest.raises(ValueError, match=message):
        make_splits("ab", test, validation)


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_else(tmp_path, monkeypatch):
    write_json(tmp_path / "x.json", {"a": 1})

    def full(*_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("data.manifest.os.replace", full)
    with pytest.raises(OSError, match=r"x\.json: cannot write the file: No space left on device"):
        write_json(tmp_path / "x.json", {"a": 2})
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]
    assert json.loads((tmp_path / "x.json").read_text()) == {"a": 1}


def test_a_path_with_several_numbers_of_samples_is_a_sequence_for_each_and_all_else_is_one_list():
    both = tuple(record(2 * view + level, view=view, spp=4**level) for view in range(3) for level in range(2))
    assert SceneRecord(both).strands() == [both[::2], both[1::2]]
    assert SceneRecord(both, sequence=False).strands() == [both]
    assert SceneRecord(both[::2]).strands() == [both[::2]]
    plain = (record(0), record(1))
    assert SceneRecord(plain).strands() == [plain]
