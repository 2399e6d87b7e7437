import json
import pickle
import subprocess
import sys

import numpy as np
import pytest

from data.derive import derive
from data.exr import write_exr
from data.exr_image import read_exr
from data.frames import FrameSet
from data.layouts import likeliest, mitsuba
from data.layouts.mitsuba_names import roles_of
from data.manifest import load_manifest
from tests.data import layout_samples
from tests.data.layout_samples import RGB, XYZ, half, lettered, mitsuba_channels, picture
from trainer.cli import main


def as_half(image):
    return image.astype(np.float16).astype(np.float32)


def one(tmp_path, channels, name="cbox_16spp.exr"):
    """Write one file and read its frame."""
    write_exr(tmp_path / "s" / name, channels)
    return next(mitsuba.frames(tmp_path))


def without(channels, *layers):
    return {name: c for name, c in channels.items() if name.rpartition(".")[0] not in layers}


def test_channels_become_buffers_by_letters_and_names(tmp_path):
    images = picture(1)
    frame = one(tmp_path, mitsuba_channels(images))
    for name in ("color", "normal", "position"):
        assert np.array_equal(frame.buffers[name], as_half(images[name])), name
    assert np.array_equal(frame.buffers["depth"], as_half(images["depth"] * np.float32(0.99)))
    assert (frame.scene, frame.spp) == ("s-cbox", 16)
    assert set(frame.notes["ignored"]) == {"uv.U", "uv.V", "si.I"}
    assert "near plane" in frame.notes["assumed"]["depth"]
    assert "not turned towards the camera" in frame.notes["assumed"]["normal"]


def test_albedo_of_glossy_surfaces_is_clipped_and_counted(tmp_path):
    frame = one(tmp_path, mitsuba_channels(picture(1)))
    assert frame.notes["clipped"] == {"diffuse_albedo": 1}
    assert frame.buffers["diffuse_albedo"].max() <= 1
    assert np.array_equal(frame.buffers["diffuse_albedo"][-1, -1], [1, 0.5, 1])
    hit = derive(frame, ["hit", "albedo"])
    assert (hit.buffers["hit"][:2, :3] == 0).all()
    assert (hit.buffers["albedo"][:2, :3] == 1).all()


@pytest.mark.parametrize(
    ("layer", "letters", "buffer"),
    [
        ("albedo", RGB, "diffuse_albedo"),
        ("my.albedo", RGB, "diffuse_albedo"),
        ("nn", XYZ, "normal"),
        ("sh_normal", XYZ, "normal"),
        ("Normals", XYZ, "normal"),
        ("pos", XYZ, "position"),
        ("world_position", XYZ, "position"),
        ("anything", "T", "depth"),
        ("depth", "Y", "depth"),
        ("img", RGB, None),
        ("dp_du", XYZ, None),
        ("depth_like", "UV", None),
    ],
)
def test_names_chosen_by_users_are_understood(layer, letters, buffer):
    channels = [f"{layer}.{letter}" for letter in letters]
    assert roles_of(channels).buffers == ({} if buffer is None else {buffer: channels})


def test_a_nested_integrator_called_a_is_not_taken_for_albedo():
    roles = roles_of([*(f"a.{c}" for c in "RGBA"), *(f"aa.{c}" for c in RGB)])
    assert roles.buffers == {"diffuse_albedo": ["aa.R", "aa.G", "aa.B"]}
    assert roles.nested == {"a": ["a.R", "a.G", "a.B"]}


def test_the_shading_normal_goes_before_the_geometric_one_which_serves_alone(tmp_path):
    images = picture(1)
    frame = one(tmp_path, without(mitsuba_channels(images), "nn"))
    assert np.array_equal(frame.buffers["normal"], -as_half(images["normal"]))


def test_an_unknown_name_is_a_normal_where_its_length_is_one(tmp_path):
    images = picture(1)
    channels = without(mitsuba_channels(images), "nn", "gn")
    channels |= half(lettered("tangent", images["color"], XYZ) | lettered("zeta", images["normal"], XYZ))
    assert np.array_equal(one(tmp_path, channels).buffers["normal"], as_half(images["normal"]))


def test_the_nested_picture_serves_where_r_g_b_are_absent_or_black(tmp_path):
    images = picture(1)
    channels = mitsuba_channels(images)
    plain = {n: c for n, c in channels.items() if n not in RGB}
    assert np.array_equal(one(tmp_path, plain).buffers["color"], as_half(images["color"]))
    black = channels | {c: np.zeros_like(channels["R"]) for c in RGB}
    assert np.array_equal(one(tmp_path, black).buffers["color"], as_half(images["color"]))


def test_an_aov_integrator_without_a_nested_one_is_told(tmp_path):
    channels = without(mitsuba_channels(picture(1)), "img")
    black = channels | {c: np.zeros_like(channels["R"]) for c in RGB}
    with pytest.raises(ValueError, match=r"cbox_16spp\.exr: R, G, B are all 0; nest a path integrator"):
        one(tmp_path, black)


def test_a_film_of_luminance_is_grey(tmp_path):
    channels = mitsuba_channels(picture(1))
    grey = {n: c for n, c in channels.items() if n not in RGB} | {"Y": channels["G"]}
    frame = one(tmp_path, grey)
    assert (frame.buffers["color"] == channels["G"][..., None]).all()
    assert "luminance" in frame.notes["assumed"]["color"]


def test_references_are_found_beside_a_frame_and_in_a_folder(tmp_path):
    frames = list(mitsuba.frames(layout_samples.mitsuba(tmp_path)))
    assert [(f.scene, f.index) for f in frames] == [("bathroom", 1), ("cbox", 0)]
    for frame, seed in zip(frames, (6, 5), strict=True):
        assert np.array_equal(frame.buffers["reference"], as_half(picture(seed)["reference"]))


def test_the_higher_number_of_samples_is_the_reference(tmp_path):
    write_exr(tmp_path / "s" / "cbox_4096spp.exr", mitsuba_channels(picture(1), "reference"))
    frame = one(tmp_path, mitsuba_channels(picture(1)))
    assert (frame.spp, frame.notes["reference_spp"]) == (16, 4096)


def moments(images, spp=16):
    """Return second moments of samples around the picture, as (nested) channels of the moment integrator."""
    random = np.random.default_rng(9)
    samples = images["color"] * random.gamma(2, 0.5, (spp, *images["color"].shape)).astype(np.float32)
    return samples, samples.mean(0), (samples**2).mean(0)


def test_second_moments_become_the_variance_of_the_mean(tmp_path):
    images = picture(1)
    samples, mean, second = moments(images)
    channels = (
        lettered("", mean, RGB) | lettered("img.path", mean, RGB) | lettered("m2_img.path", second, RGB)
    )
    channels |= lettered("img.albedo", images["albedo"], RGB)
    channels |= lettered("m2_img.albedo", images["albedo"] ** 2 + np.float32(0.15), RGB)
    channels |= lettered("img.nn", images["normal"], XYZ)
    frame = one(tmp_path, channels)
    expected = samples.astype(np.float64).var(0, ddof=1) / 16
    assert np.allclose(frame.buffers["color_variance"], expected, rtol=1e-3, atol=1e-5)
    assert np.allclose(frame.buffers["diffuse_albedo_variance"], 0.01, atol=1e-6)
    assert frame.notes["derived"]["color_variance"] == "(m2 - mean^2) / (spp - 1)"


def test_moments_without_a_number_of_samples_give_no_variance(tmp_path):
    images = picture(1)
    _, mean, second = moments(images)
    channels = mitsuba_channels(images) | lettered("img", mean, RGB) | lettered("m2_img", second, RGB)
    assert "color_variance" not in one(tmp_path, channels, "cbox.exr").buffers


def test_moments_in_xyz_give_the_variance_of_the_luminance(tmp_path):
    images = picture(1)
    samples, mean, second = moments(images)
    channels = without(mitsuba_channels(images), "img")
    channels |= lettered("img", mean, XYZ) | lettered("m2_img", second, XYZ)
    frame = one(tmp_path, channels)
    expected = samples[..., 1].astype(np.float64).var(0, ddof=1) / 16
    assert np.allclose(frame.buffers["color_variance"], expected[..., None], rtol=1e-3, atol=1e-5)
    assert "luminance" in frame.notes["derived"]["color_variance"]
    assert np.array_equal(frame.buffers["normal"], as_half(images["normal"]))


def test_depth_is_derived_where_positions_and_the_camera_are_known(tmp_path):
    images = picture(1)
    origin = np.float32([1, -2, 3])
    to_world = np.eye(4)
    to_world[:3, 3] = origin
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "cbox_16spp.json").write_text(json.dumps({"to_world": to_world.tolist()}))
    frame = one(tmp_path, mitsuba_channels(images))
    hit = images["depth"] > 0
    expected = np.linalg.norm(as_half(images["position"]) - origin, axis=-1, keepdims=True)
    assert np.allclose(frame.buffers["depth"], np.where(hit, expected, 0), atol=1e-4)
    assert frame.notes["derived"]["depth"] == "distance of position from the camera"


@pytest.mark.parametrize("text", ['{"to_world": [[1, 2]]}', "[]", "{", '{"world_to_pixel": 3}'])
def test_a_damaged_camera_file_is_named(tmp_path, text):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "cbox_16spp.json").write_text(text)
    with pytest.raises(ValueError, match=r"cbox_16spp\.json: no camera"):
        one(tmp_path, mitsuba_channels(picture(1)))


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        (("", "img"), r"missing color \(R, G, B\)"),
        (("aa",), r"missing albedo \(such as albedo\.R of the AOV albedo\)"),
        (("nn", "gn"), r"missing normal \(such as nn\.X of the AOV sh_normal\)"),
    ],
)
def test_a_missing_aov_is_named_with_the_channels_found(tmp_path, layers, message):
    with pytest.raises(ValueError, match=rf"cbox_16spp\.exr: {message}; found "):
        one(tmp_path, without(mitsuba_channels(picture(1)), *layers))


def test_broken_values_are_counted_and_truncated_files_named(tmp_path):
    channels = mitsuba_channels(picture(1))
    channels["R"][3, 3] = np.inf
    channels["nn.X"][4, 4] = np.nan
    assert one(tmp_path, channels).notes["repaired"] == {"color": 1, "normal": 1}
    path = tmp_path / "s" / "cbox_16spp.exr"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"cbox_16spp\.exr: .*(truncated|damaged)"):
        next(mitsuba.frames(tmp_path))


def test_references_of_another_size_are_named(tmp_path):
    write_exr(tmp_path / "s" / "cbox_ref.exr", mitsuba_channels(picture(1, (5, 6))))
    with pytest.raises(ValueError, match=r"cbox_ref\.exr: 'reference' is 6x5"):
        one(tmp_path, mitsuba_channels(picture(1)))


def test_pictures_without_aovs_are_not_taken_for_this_layout(tmp_path):
    write_exr(tmp_path / "a.exr", lettered("", picture(1)["color"], RGB))
    assert mitsuba.likeness(tmp_path) == 0
    (tmp_path / "a.exr").unlink()
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(ValueError, match=r"no scene of the layout `mitsuba` found, expected EXR files"):
        mitsuba.describe(tmp_path)


RENDER = """
import sys
import mitsuba as mi
mi.set_variant("scalar_rgb")
scene = mi.cornell_box()
film = {"type": "hdrfilm", "width": 12, "height": 9, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
scene["sensor"]["film"] = film
scene["sensor"]["sampler"] = {"type": "independent", "sample_count": 4}
aovs = "albedo:albedo,dd:depth,nn:sh_normal,pos:position,uv:uv,gn:geo_normal,si:shape_index"
nested = {"type": "aov", "aovs": aovs, "img": {"type": "path"}}
for name, integrator in (("a_4spp", nested), ("b_4spp", {"type": "moment", "in": nested})):
    loaded = mi.load_dict({**scene, "integrator": integrator})
    mi.render(loaded)
    loaded.sensors()[0].film().write(f"{sys.argv[1]}/{name}.exr")
"""


def test_films_of_the_real_renderer_are_read(tmp_path):
    # A process of its own: the renderer keeps its variant and threads until the end.
    done = subprocess.run([sys.executable, "-c", RENDER, str(tmp_path)], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    assert likeliest(tmp_path) == "mitsuba"
    plain, moment = list(mitsuba.frames(tmp_path))
    for frame in (plain, moment):
        assert {"color", "diffuse_albedo", "normal", "position", "depth"} <= frame.buffers.keys()
        assert frame.spp == 4
        length = np.linalg.norm(frame.buffers["normal"], axis=-1)
        assert length.max() == pytest.approx(1, abs=1e-3)
    image = read_exr(tmp_path / "a_4spp.exr")
    assert np.array_equal(plain.buffers["color"][..., 0], image.channels["img.R"])
    assert moment.buffers["color_variance"].max() > 0
    assert "luminance" not in moment.notes["derived"]["color_variance"]


def test_the_miniature_is_recognised_pickled_and_ingested(tmp_path, monkeypatch):
    source = layout_samples.mitsuba(tmp_path / "source")
    assert likeliest(source) == "mitsuba"
    original = pickle.loads(pickle.dumps(mitsuba.describe(source)[1])).read(0)
    output = tmp_path / "set"
    arguments = ["trainer", "ingest", source, "--layout", "mitsuba", "--output", output, "--processes", 1]
    monkeypatch.setattr("sys.argv", [str(a) for a in arguments])
    assert main() == 0
    record = load_manifest(output).scenes["cbox"].frames[0]
    assert record.spp == 16
    stored = FrameSet(output).read("cbox", 0)
    assert {"albedo", "irradiance"} <= stored.buffers.keys()
    assert np.array_equal(stored.buffers["reference"], original.buffers["reference"])
