import pickle
import sys

import h5py
import numpy as np
import pytest

from data.frames import FrameSet
from data.layouts import layerdenoise, likeliest
from data.manifest import load_manifest
from tests.data import layout_samples
from tests.data.layout_samples import layer_pair
from trainer.cli import main


def last(array):
    return np.moveaxis(array.astype(np.float32), -3, -1)


def changed(path, **datasets):
    """Replace data sets of a file; None removes one."""
    with h5py.File(path, "a") as file:
        for name, array in datasets.items():
            del file[name]
            if array is not None:
                file[name] = array


def test_every_channel_becomes_its_quantity(tmp_path):
    arrays = layer_pair(tmp_path, "clip")
    frames = list(layerdenoise.frames(tmp_path))
    assert [(f.scene, f.index, f.spp, f.notes["view"]) for f in frames] == [
        ("clip", 0, 3, 0),
        ("clip", 1, 3, 1),
    ]
    for index, frame in enumerate(frames):
        get = frame.samples.get
        raw = {name: last(array[index]) for name, array in arrays.items()}
        assert np.array_equal(get("radiance"), raw["color"])
        assert np.array_equal(get("normal"), raw["normals_depth"][..., :3])
        assert np.array_equal(get("depth"), raw["normals_depth"][..., 3:])
        assert np.array_equal(get("diffuse_albedo"), raw["albedo"])
        assert np.array_equal(get("specular_albedo"), raw["specular"][..., :3])
        assert np.array_equal(get("roughness"), raw["specular"][..., 3:])
        assert np.array_equal(get("lens"), raw["uvt"][..., :2])
        assert np.array_equal(get("time"), raw["uvt"][..., 2:])
        assert np.allclose(frame.buffers["color"], raw["color"].mean(0), atol=1e-6)
        assert np.array_equal(frame.buffers["reference"], raw["reference"])


def test_motion_becomes_pixels_and_the_radius_of_confusion_a_diameter(tmp_path):
    arrays = layer_pair(tmp_path, "clip")
    frame = next(layerdenoise.frames(tmp_path))
    raw = last(arrays["motionvecs"][0])
    assert np.allclose(frame.samples.get("motion"), raw[..., :2] * np.float32([4, 3]), atol=1e-6)
    assert np.allclose(frame.samples.get("coc"), 2 * raw[..., 2:], atol=1e-6)
    assert {"motion", "coc", "normal", "depth"} == frame.notes["assumed"].keys()
    assert "view space" in frame.notes["assumed"]["normal"]
    assert frame.notes["normalised"] == ["depth"]


@pytest.mark.parametrize(("rank", "suffix"), [(4, "in"), (5, "input"), (5, "in")])
def test_both_names_and_both_ranks_of_the_reference_are_read(tmp_path, rank, suffix):
    arrays = layer_pair(tmp_path, "clip", rank, suffix)
    frame = next(layerdenoise.frames(tmp_path))
    assert np.array_equal(frame.buffers["reference"], last(arrays["reference"][0]))


def test_a_set_without_reference_is_read_without_it(tmp_path):
    layer_pair(tmp_path, "clip")
    (tmp_path / "clip_ref.h5").unlink()
    assert "reference" not in next(layerdenoise.frames(tmp_path)).buffers


def test_hidden_files_are_no_scenes(tmp_path):
    layer_pair(tmp_path, "clip")
    (tmp_path / "._clip_input.h5").write_bytes(b"resource fork")
    assert [s.name for s in layerdenoise.describe(tmp_path)] == ["clip"]


def test_files_in_folders_are_scenes_with_their_path(tmp_path):
    for folder in ("train", "test"):
        layer_pair(tmp_path / folder, "clip")
    assert [s.name for s in layerdenoise.describe(tmp_path)] == ["test-clip", "train-clip"]


def test_overflowed_radiance_is_the_largest_half_and_broken_values_are_counted(tmp_path):
    arrays = layer_pair(tmp_path, "clip")
    color, albedo, reference = (arrays[n].copy() for n in ("color", "albedo", "reference"))
    color[0, 0, 0, 1, 1], color[0, 1, 1, 2, 2], albedo[0, 0, 0, 3, 3] = np.inf, np.nan, 2
    reference[0, 2, 4, 4] = np.inf
    changed(tmp_path / "clip_input.h5", color=color, albedo=albedo)
    changed(tmp_path / "clip_ref.h5", color=reference)
    frame = next(layerdenoise.frames(tmp_path))
    assert frame.samples.get("radiance")[0, 1, 1, 0] == 65504
    assert frame.buffers["reference"][4, 4, 2] == 65504
    assert "repaired" not in frame.notes
    assert frame.notes["dropped"] == [1, 1, 0]
    assert np.isnan(frame.samples.values[1, 2, 2]).all()
    assert frame.notes["clipped"] == {"samples.diffuse_albedo": 1}


@pytest.mark.parametrize("name", ["color", "normals_depth", "albedo", "specular", "uvt", "motionvecs"])
def test_a_missing_data_set_is_named_with_what_is_there(tmp_path, name):
    layer_pair(tmp_path, "clip")
    changed(tmp_path / "clip_input.h5", **{name: None})
    with pytest.raises(ValueError, match=rf"clip_input\.h5: missing '{name}' \(.*\); found .*"):
        layerdenoise.describe(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"uvt": np.zeros((2, 3, 2, 6, 8), np.float16)}, "'uvt' has 2 channels in the shape"),
        ({"albedo": np.zeros((2, 3, 3, 6, 9), np.float16)}, r"'albedo' has the shape .*, but 'color' has"),
        ({"specular": np.zeros((2, 3, 4, 6), np.float16)}, "'specular' has the shape .* expected 5 axes"),
        ({"specular": np.zeros((2, 3, 4, 6, 8), "S4")}, "'specular' holds .* expected numbers"),
    ],
)
def test_data_sets_of_another_shape_are_named(tmp_path, changes, message):
    layer_pair(tmp_path, "clip")
    changed(tmp_path / "clip_input.h5", **changes)
    with pytest.raises(ValueError, match=rf"clip_input\.h5: data set {message}"):
        layerdenoise.describe(tmp_path)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((1, 3, 6, 8), "but clip_input.h5 has"),
        ((2, 3, 6, 9), "but clip_input.h5 has"),
        ((2, 4, 6, 8), r"expected \[frame, 3, y, x\]"),
        ((2, 2, 3, 6, 8), r"expected \[frame, 3, y, x\]"),
        ((2, 6, 8), "expected 4 axes"),
    ],
)
def test_a_reference_that_does_not_fit_is_named(tmp_path, shape, message):
    layer_pair(tmp_path, "clip")
    changed(tmp_path / "clip_ref.h5", color=np.zeros(shape, np.float16))
    with pytest.raises(ValueError, match=rf"clip_ref\.h5.*{message}"):
        layerdenoise.describe(tmp_path)


def test_a_reference_without_colour_names_what_it_has(tmp_path):
    layer_pair(tmp_path, "clip")
    changed(tmp_path / "clip_ref.h5", color=None)
    with pytest.raises(ValueError, match=r"clip_ref\.h5: missing reference; it has "):
        layerdenoise.describe(tmp_path)


def link(path, name, target):
    with h5py.File(path, "a") as file:
        del file[name]
        file[name] = target


@pytest.mark.parametrize("file", ["clip_input.h5", "clip_ref.h5"])
def test_links_and_virtual_data_are_refused_and_not_followed(tmp_path, file):
    layer_pair(tmp_path, "clip")
    path = tmp_path / file
    link(path, "color", h5py.ExternalLink("/etc/passwd", "color"))
    with pytest.raises(ValueError, match=rf"{file}: data set 'color' is a link to another file"):
        layerdenoise.describe(tmp_path)
    link(path, "color", h5py.SoftLink("/albedo"))
    with pytest.raises(ValueError, match=rf"{file}: data set 'color' is a soft link"):
        layerdenoise.describe(tmp_path)
    virtual = h5py.VirtualLayout((2, 3, 3, 6, 8), np.float16)
    with h5py.File(path, "a") as opened:
        del opened["color"]
        opened.create_virtual_dataset("color", virtual)
    with pytest.raises(ValueError, match=rf"{file}: data set 'color' is virtual"):
        layerdenoise.describe(tmp_path)


def test_an_absurd_shape_is_refused_without_taking_memory(tmp_path):
    layer_pair(tmp_path, "clip")
    with h5py.File(tmp_path / "clip_input.h5", "a") as file:
        del file["color"]
        file.create_dataset("color", (1 << 20, 8, 3, 4096, 4096), np.float16, chunks=(1, 1, 1, 64, 64))
    with pytest.raises(ValueError, match=r"clip_input\.h5: data set 'color'"):
        layerdenoise.describe(tmp_path)


def test_truncated_files_and_other_files_of_that_name_are_named(tmp_path):
    layer_pair(tmp_path, "clip")
    path = tmp_path / "clip_input.h5"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"clip_input\.h5"):
        layerdenoise.describe(tmp_path)
    path.write_bytes(b"not HDF5")
    with pytest.raises(ValueError, match=r"clip_input\.h5: not an HDF5 file"):
        layerdenoise.describe(tmp_path)


def test_only_the_asked_frame_is_read(tmp_path):
    layer_pair(tmp_path, "clip")
    scene = layerdenoise.describe(tmp_path)[0]
    with pytest.raises(ValueError, match="has 2 items, asked for 2"):
        scene.read(2)


def test_without_h5py_the_error_names_the_extra(tmp_path, monkeypatch):
    layer_pair(tmp_path, "clip")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ValueError, match=r"penumbra-denoise\[layouts\]"):
        layerdenoise.describe(tmp_path)


def test_a_folder_without_pairs_says_what_is_expected(tmp_path):
    (tmp_path / "train.h5").write_bytes(b"")
    with pytest.raises(
        ValueError, match=r"no file of the layout `layerdenoise` found, expected <name>_input"
    ):
        layerdenoise.describe(tmp_path)


def test_the_miniature_is_recognised_pickled_and_ingested(tmp_path, monkeypatch):
    source = layout_samples.layerdenoise(tmp_path / "source")
    assert likeliest(source) == "layerdenoise"
    scene = pickle.loads(pickle.dumps(layerdenoise.describe(source)[0]))
    original = scene.read(1)
    layer_pair(source, "training")
    output = tmp_path / "set"
    arguments = [
        "trainer",
        "ingest",
        source,
        "--layout",
        "layerdenoise",
        "--output",
        output,
        "--processes",
        1,
    ]
    monkeypatch.setattr("sys.argv", [str(a) for a in arguments])
    assert main() == 0
    record = load_manifest(output).scenes["validation"].frames[1]
    assert (record.spp, record.view, record.samples) == (3, 1, list(original.samples.names))
    stored = FrameSet(output).read("validation", 1)
    assert np.allclose(stored.samples.values, original.samples.values, rtol=1e-3, atol=1e-6)
    assert np.array_equal(stored.buffers["reference"], original.buffers["reference"])
