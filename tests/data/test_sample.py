import numpy as np
import pytest

from data.exr import read_exr
from data.frames import FrameSet
from data.sample import SAMPLES
from data.sample.build import MANTISSA_BITS, SOURCES, build, round_mantissa
from tests.data.miniature import penumbra_scene

ROOT = SAMPLES["bmfr"]


def test_the_sample_is_whole_and_under_twenty_megabytes():
    assert FrameSet(ROOT).check() == []
    assert sum(p.stat().st_size for p in ROOT.rglob("*") if p.is_file()) <= 20_000_000


def test_the_sample_holds_three_scenes_and_one_is_held_out():
    frames = FrameSet(ROOT)
    assert frames.scenes("train") == ["cbox-glossy", "living-room-2"]
    assert frames.scenes("test") == ["classroom"]
    for scene in frames.scenes():
        assert [f.index for f in frames.frames(scene)] == list(range(9))
        assert frames.manifest.scenes[scene].sequence


def test_every_scene_names_its_author_and_licence_also_in_the_licence_file():
    text = (ROOT / "LICENSES.md").read_text(encoding="utf-8")
    for name, scene in FrameSet(ROOT).manifest.scenes.items():
        assert scene.credit
        assert scene.license
        assert f"| {name} | {scene.credit} | {scene.license} |" in text
    for author in ("NovaZeeke", "Jay-Artist", "Benedikt Bitterli", "Mitsuba"):
        assert author in text


@pytest.mark.parametrize("scene", list(SOURCES))
def test_sample_frames_have_all_that_training_needs_and_sound_values(scene):
    frame = FrameSet(ROOT).read(scene, 8)
    assert (frame.width, frame.height, frame.spp) == (320, 180, 1)
    assert frame.camera is not None
    assert frame.exposure > 0
    for name in ("color", "irradiance", "albedo", "normal", "depth", "position", "reference"):
        assert np.isfinite(frame.buffers[name]).all()
    assert frame.buffers["albedo"].min() >= 0.009
    length = np.linalg.norm(frame.buffers["normal"], axis=-1)
    assert ((length == 0) | (np.abs(length - 1) < 2e-3)).all()
    assert np.array_equal(length == 0, frame.buffers["depth"][..., 0] == 0)


def test_noise_is_unbiased_so_reference_and_mean_of_frames_agree():
    for scene in SOURCES:
        frames = list(FrameSet(ROOT).sequence(scene))
        noisy = np.mean([f.buffers["color"].mean() for f in frames])
        clean = np.mean([f.buffers["reference"].mean() for f in frames])
        assert noisy == pytest.approx(clean, rel=0.1)


def test_the_sample_needs_no_file_of_the_development_machine():
    text = (ROOT / "manifest.json").read_text(encoding="utf-8")
    assert "/work" not in text
    assert "shared" not in text
    header = read_exr(ROOT / "classroom" / "f000.exr").attributes
    assert not any("/work" in str(v) for v in header.values())


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize("bits", [5, 8, 10])
def test_rounding_keeps_the_stated_number_of_bits(half, bits):
    values = np.random.default_rng(0).normal(0, 10, (50, 50, 3)).astype(np.float32)
    if half:
        values = values.astype(np.float16).astype(np.float32)
    rounded = round_mantissa(values, bits, half)
    assert (np.abs(rounded - values) <= np.abs(values) * 2.0 ** -(bits + 1) + 1e-7).all()
    mantissa = np.frexp(rounded)[0] * 2.0 ** (bits + 1)
    assert np.array_equal(mantissa, np.round(mantissa))
    assert np.array_equal(round_mantissa(rounded, bits, half), rounded)


def test_rounding_ties_go_to_even():
    values = np.array([1 + 1 / 8, 1 + 3 / 8, -1 - 1 / 8], np.float32)
    assert round_mantissa(values, 2, half=True).tolist() == [1, 1.5, -1]
    assert round_mantissa(values, 2, half=False).tolist() == [1, 1.5, -1]


@pytest.mark.parametrize("bits", [0, 11])
def test_rounding_to_an_impossible_number_of_bits_is_refused(bits):
    with pytest.raises(ValueError, match="expected 1 to 10"):
        round_mantissa(np.ones(3, np.float32), bits, half=True)


@pytest.fixture
def source(tmp_path):
    for scene in SOURCES:
        penumbra_scene(tmp_path / "source", scene, 2)
    return tmp_path / "source"


def test_the_script_builds_the_sample_deterministically(source, tmp_path):
    first, second = build(source, tmp_path / "a", 2), build(source, tmp_path / "b", 2)
    assert first.hash == second.hash
    assert FrameSet(tmp_path / "a").check() == []
    assert (tmp_path / "a" / "LICENSES.md").is_file()
    assert {p.name for p in tmp_path.iterdir()} == {"source", "a", "b"}


def test_the_script_stores_the_effective_albedo_and_rounds_only_what_it_says(source, tmp_path):
    build(source, tmp_path / "a", 2)
    frame = FrameSet(tmp_path / "a").read("classroom", 1)
    original = FrameSet(ROOT).read("classroom", 1)
    rows, columns = slice(70, 102), slice(130, 178)
    for name in ("color", "albedo", "normal", "reference"):
        assert name not in MANTISSA_BITS
        assert np.array_equal(frame.buffers[name], original.buffers[name][rows, columns])


def test_a_failed_build_keeps_the_sample_that_is_there(source, tmp_path):
    before = build(source, tmp_path / "a", 2)
    with pytest.raises(ValueError, match=r"classroom has frames .*needed 0 to 2"):
        build(source, tmp_path / "a", 3)
    assert FrameSet(tmp_path / "a").manifest.hash == before.hash
    assert {p.name for p in tmp_path.iterdir()} == {"source", "a"}


def test_a_build_over_the_limit_is_refused(source, tmp_path, monkeypatch):
    monkeypatch.setattr("data.sample.build.LIMIT_BYTES", 1000)
    with pytest.raises(ValueError, match=r"the sample has 0\.1 MB, over 0 MB"):
        build(source, tmp_path / "a", 2)
    assert not (tmp_path / "a").exists()


def test_a_source_without_a_scene_is_refused(tmp_path):
    penumbra_scene(tmp_path, "classroom")
    with pytest.raises(ValueError, match="lacks the scene 'cbox-glossy'; it has classroom"):
        build(tmp_path, tmp_path / "a")
