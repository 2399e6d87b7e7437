import json
from dataclasses import replace

import numpy as np
import pytest

from data.derive import derive
from data.exr import read_frame
from data.histograms import sample_histogram
from data.manifest import FrameRecord
from data.render.frames import noisy_frames
from data.render.recipe import Recipe, defaults, seed_of, stream_key, view_key, with_options
from data.render.references import Reference, energy_z
from data.render.views import ViewWork, add_pass, render_view
from tests.data.render.fake_tracer import FakeTracer, spec

STILLS = Recipe("stills", 24, 16, (2, 4), 64)


def work(root, recipe=STILLS, key="k"):
    return ViewWork(root, "fake", 0, key, recipe)


def records(done):
    return [FrameRecord(**r) for r in json.loads(done.memory.read_text())["records"]]


def render(done, tracer=None):
    counts = []
    render_view(done, tracer or FakeTracer(), "renderer 1", counts.append)
    return counts


def test_a_still_has_a_frame_per_count_with_halves_variances_and_both_references(tmp_path):
    done = work(tmp_path)
    render(done)
    low, high = records(done)
    assert [(r.index, r.view, r.spp, r.reference_spp) for r in (low, high)] == [(0, 0, 2, 64), (1, 0, 4, 64)]
    frame = read_frame(tmp_path / high.file)
    for name in ("color", "diffuse", "normal", "diffuse_albedo", "depth", "visibility"):
        assert {f"{name}_a", f"{name}_b", f"{name}_variance"} <= frame.buffers.keys()
    assert {
        "reference",
        "reference_diffuse",
        "position",
        "roughness",
        "specular_albedo",
    } <= frame.buffers.keys()
    assert frame.exposure == pytest.approx(high.exposure)


def test_counts_of_a_still_come_from_one_stream(tmp_path):
    tracer = FakeTracer()
    render(work(tmp_path), tracer)
    assert [spp for _, spp, _ in tracer.calls] == [4, 64]


def test_the_difference_of_the_halves_estimates_the_variance(tmp_path):
    done = work(tmp_path, Recipe("stills", 24, 16, (64,), 64))
    render(done)
    frame = read_frame(tmp_path / records(done)[0].file)
    squared = ((frame.buffers["color_a"] - frame.buffers["color_b"]) / 2) ** 2
    assert squared.mean() == pytest.approx(frame.buffers["color_variance"].mean(), rel=0.2)


def test_depth_of_pixels_that_hit_nothing_is_zero_and_others_keep_their_distance(tmp_path):
    done = work(tmp_path)
    render(done)
    depth = read_frame(tmp_path / records(done)[1].file).buffers["depth"][..., 0]
    assert (depth[:, 12:] == 0).all()
    assert ((depth[:, :12] >= 1) & (depth[:, :12] <= 3)).all()


def test_samples_are_kept_apart_and_their_mean_is_the_colour(tmp_path):
    done = work(tmp_path, Recipe("samples", 24, 16, (8,), 16))
    render(done, FakeTracer(chunk=1024))
    frame = read_frame(tmp_path / records(done)[0].file)
    assert (frame.samples.count, len(frame.samples.channels)) == (8, 20)
    assert np.allclose(frame.buffers["color"], frame.samples.get("radiance").mean(0), rtol=2e-3, atol=1e-3)


def test_a_second_call_does_nothing(tmp_path):
    done = work(tmp_path)
    render(done)
    before = records(done)
    tracer = FakeTracer()
    assert render(done, tracer) == []
    assert tracer.calls == []
    assert records(done) == before


def test_more_reference_samples_are_added_to_what_is_there(tmp_path):
    render(work(tmp_path))
    tracer = FakeTracer()
    finer = with_options(STILLS, reference_spp=96)
    done = work(tmp_path, finer)
    counts = render(done, tracer)
    assert sum(counts) == finer.pixels * 32
    assert max(counts) < sum(counts), "a pass may take minutes: it is reported in parts"
    assert [spp for _, spp, _ in tracer.calls] == [32]
    assert records(done)[0].reference_spp == 96


def test_a_reference_refined_by_whole_passes_equals_one_rendered_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr("data.render.recipe.PASS_SAMPLES", 24 * 16 * 32)
    render(work(tmp_path / "a", with_options(STILLS, reference_spp=32)))
    render(work(tmp_path / "a", with_options(STILLS, reference_spp=96)))
    render(work(tmp_path / "b", with_options(STILLS, reference_spp=96)))
    for a, b in zip(records(work(tmp_path / "a")), records(work(tmp_path / "b")), strict=True):
        assert a.sha256 == b.sha256


class StoppedError(Exception):
    pass


@pytest.mark.parametrize("calls", [1, 2, 3])
def test_stopped_at_any_pass_it_goes_on_to_the_same_files(tmp_path, monkeypatch, calls):
    monkeypatch.setattr("data.render.recipe.PASS_SAMPLES", 24 * 16 * 16)

    class Failing(FakeTracer):
        def trace(self, *args, **kwargs):
            if len(self.calls) == calls:
                raise StoppedError
            return super().trace(*args, **kwargs)

    with pytest.raises(StoppedError):
        render(work(tmp_path / "a"), Failing())
    resumed = FakeTracer()
    render(work(tmp_path / "a"), resumed)
    assert len(resumed.calls) == 5 - calls
    render(work(tmp_path / "b"))
    for a, b in zip(records(work(tmp_path / "a")), records(work(tmp_path / "b")), strict=True):
        assert a.sha256 == b.sha256


def test_an_altered_frame_is_rendered_again_with_the_reference_that_is_there(tmp_path):
    done = work(tmp_path)
    render(done)
    before = records(done)
    (tmp_path / before[0].file).write_bytes(b"broken")
    tracer = FakeTracer()
    render(done, tracer)
    assert [spp for _, spp, _ in tracer.calls] == [4]
    assert records(done) == before


def test_damaged_sums_of_a_reference_start_it_anew(tmp_path):
    render(work(tmp_path))
    work(tmp_path).sums.write_bytes(b"PK damaged")
    assert Reference.load(work(tmp_path).sums, 16, 24, True).count == 0


def test_energy_of_equal_means_is_within_three_errors_and_of_brighter_input_is_not():
    def noisy(scale, seed):
        tracer = FakeTracer(scale=scale)
        parts = list(tracer.trace(0, 4, seed, ("radiance",)))
        values = np.concatenate([p.values["radiance"] for p in parts])
        return values.mean(0)

    reference = Reference.empty(16, 24)
    add_pass(reference, FakeTracer(), work(None, Recipe("samples", 24, 16, (4,), 64)))
    assert all(abs(energy_z(noisy(1.0, seed), 4, reference)) < 4 for seed in range(20))
    assert energy_z(noisy(1.3, 1), 4, reference) > 5


def test_rounding_of_stored_radiance_is_no_difference_of_energy():
    constant = np.full((16, 24, 3), 0.8003, np.float32)
    reference = Reference.empty(16, 24)
    reference.add(slice(0, 16), np.repeat(constant[None], 64, 0))
    reference.count = 64
    stored = constant.astype(np.float16).astype(np.float32)
    assert not np.array_equal(stored, constant)
    assert energy_z(stored, 4, reference) == 0
    assert energy_z(stored * np.float32(1.01), 4, reference) == 999


def test_frames_of_a_view_are_made_one_after_the_other():
    tracer = FakeTracer(chunk=24 * 16 * 2)
    counts = []
    frames = noisy_frames(tracer, 0, STILLS, 1, counts.append)
    assert next(frames).spp == 2
    assert sum(counts) == 24 * 16 * 2
    assert [frame.spp for frame in frames] == [4]
    assert sum(counts) == 24 * 16 * 4


def test_frames_say_through_which_lens_they_were_rendered():
    scene = spec()
    lens = replace(scene.views[0], aperture=0.25, focus=3.0)
    recipe = Recipe("samples", 24, 16, (2,), 64)
    (pinhole,) = noisy_frames(FakeTracer(scene), 0, recipe, 1)
    (wide,) = noisy_frames(FakeTracer(replace(scene, views=(lens,))), 0, recipe, 1)
    assert (pinhole.thin_lens, wide.thin_lens) == ((0, 0, 40.0), (0.25, 3.0, 40.0))


def test_standard_errors_of_the_energy_have_unit_spread():
    reference = Reference.empty(16, 24)
    add_pass(reference, FakeTracer(), work(None, Recipe("samples", 24, 16, (4,), 256)))
    zs = []
    for seed in range(200):
        (part,) = FakeTracer(chunk=2**20).trace(0, 4, 1000 + seed, ("radiance",))
        zs.append(energy_z(part.values["radiance"].mean(0), 4, reference))
    # The largest of three standard normal numbers has a root mean square of 1.58.
    assert np.sqrt(np.mean(np.square(zs))) == pytest.approx(1.58, abs=0.25)


def test_keys_depend_on_scene_view_and_recipe_but_not_on_the_reference_samples():
    key = view_key({"seed": 1}, 0, STILLS)
    assert key == view_key({"seed": 1}, 0, with_options(STILLS, reference_spp=5000))
    others = [
        view_key({"seed": 2}, 0, STILLS),
        view_key({"seed": 1}, 1, STILLS),
        view_key({"seed": 1}, 0, with_options(STILLS, spp=(2, 8))),
    ]
    assert len({key, *others}) == 4
    assert len({seed_of(key, "input"), seed_of(key, "reference", 0), seed_of(key, "reference", 64)}) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": (3,)}, "must be even"),
        ({"spp": (4, 2)}, "ascending"),
        ({"reference_spp": 1}, "at least 2"),
        ({"width": 8}, "--size 8x256: expected at least 16x16"),
        ({"max_depth": 1}, "--max-depth 1: expected at least 2"),
    ],
)
def test_recipes_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        with_options(defaults("stills"), **options)


def test_specular_light_has_its_own_variance_and_follows_from_the_rest(tmp_path):
    done = work(tmp_path, Recipe("stills", 24, 16, (32,), 64))
    render(done)
    frame = derive(read_frame(tmp_path / records(done)[0].file), ["color", "specular"])
    assert np.allclose(
        frame.buffers["specular"], np.maximum(frame.buffers["color"] - frame.buffers["diffuse"], 0), atol=2e-3
    )
    # In this tracer both parts are independent, so that their variances add up to the specular one's.
    expected = frame.buffers["color_variance"].mean() + frame.buffers["diffuse_variance"].mean()
    assert frame.buffers["specular_variance"].mean() == pytest.approx(expected, rel=0.05)
    assert "specular_albedo_variance" in frame.buffers


WITH_HISTOGRAMS = with_options(STILLS, spp=(2, 6, 8), histogram=True)


@pytest.mark.parametrize("chunk", [384, 1024, 2**14])
def test_histograms_hold_the_first_samples_of_each_pixel_however_they_arrive(tmp_path, chunk):
    tracer = FakeTracer(chunk=chunk)
    seed = seed_of("k", "input")
    chunks = list(FakeTracer(chunk=chunk).trace(0, 8, seed, WITH_HISTOGRAMS.names))
    bands = {part.rows.start: [] for part in chunks}
    for part in chunks:
        bands[part.rows.start].append(part.values["radiance"])
    samples = np.concatenate([np.concatenate(bands[top]) for top in sorted(bands)], 1)
    done = work(tmp_path, WITH_HISTOGRAMS)
    render(done, tracer)
    assert [(spp, s == seed) for _, spp, s in tracer.calls[:2]] == [(1, False), (8, True)]
    for record, spp in zip(records(done), (2, 6, 8), strict=True):
        found = read_frame(tmp_path / record.file).buffers["histogram"]
        expected = sample_histogram(samples[:spp], record.checks["histogram_exposure"])
        assert np.allclose(found, expected, atol=1e-5)


def test_the_exposure_of_histograms_follows_the_brightness_of_the_scene(tmp_path):
    exposures = []
    for scale in (1.0, 50.0):
        done = work(tmp_path / str(scale), WITH_HISTOGRAMS)
        render(done, FakeTracer(scale=scale))
        exposures.append(records(done)[-1].checks["histogram_exposure"])
    assert exposures[0] == pytest.approx(50 * exposures[1], rel=1e-4)


def test_without_histograms_a_recipe_is_what_it_was_and_with_them_another():
    assert "histogram" not in STILLS.to_json()
    asked = with_options(STILLS, histogram=True)
    assert view_key({}, 0, asked) != view_key({}, 0, STILLS)
    assert asked.same_work(with_options(asked, reference_spp=128).to_json())
    assert not asked.same_work(STILLS.to_json())
    assert not STILLS.same_work(asked.to_json())
    with pytest.raises(ValueError, match="--histogram is for stills, not samples: their histograms follow"):
        with_options(defaults("samples"), histogram=True)


SECOND_HITS = with_options(STILLS, second_hit=True)


def test_with_second_hits_a_still_has_their_albedo_and_positions_have_halves(tmp_path):
    tracer = FakeTracer(chunk=2**14)
    (chunk,) = FakeTracer(chunk=2**14).trace(0, 4, seed_of("k", "input"), SECOND_HITS.names)
    done = work(tmp_path, SECOND_HITS)
    render(done, tracer)
    buffers = read_frame(tmp_path / records(done)[1].file).buffers
    for name in ("position", "second_albedo"):
        samples = chunk.values[name].astype(np.float64)
        assert np.allclose(buffers[f"{name}_a"], samples[::2].mean(0), rtol=1e-3)
        assert np.allclose(buffers[f"{name}_b"], samples[1::2].mean(0), rtol=1e-3)
        assert np.allclose(buffers[f"{name}_variance"], samples.var(0, ddof=1) / 4, rtol=1e-5)
    assert np.allclose(buffers["second_albedo"], chunk.values["second_albedo"].mean(0), rtol=1e-3)


def test_additions_leave_all_other_buffers_as_they_are(tmp_path):
    kept = {}
    for name, options in {"without": {}, "with": {"second_hit": True, "histogram": True}}.items():
        done = work(tmp_path / name, with_options(STILLS, **options))
        render(done, FakeTracer(chunk=2**14))
        kept[name] = read_frame(tmp_path / name / records(done)[1].file).buffers
    added = kept["with"].keys() - kept["without"].keys()
    parts = ("_a", "_b", "_variance")
    assert added == {
        "histogram",
        "second_albedo",
        *(f"{name}{part}" for name in ("second_albedo", "position") for part in parts),
    }
    assert all(np.array_equal(kept["with"][name], image) for name, image in kept["without"].items())


def test_seeds_of_a_view_do_not_depend_on_additions_and_its_key_does():
    asked = [
        STILLS,
        SECOND_HITS,
        with_options(STILLS, histogram=True),
        with_options(SECOND_HITS, histogram=True),
    ]
    assert {stream_key({"seed": 1}, 0, recipe) for recipe in asked} == {view_key({"seed": 1}, 0, STILLS)}
    assert len({view_key({"seed": 1}, 0, recipe) for recipe in asked}) == 4
    other = stream_key({"seed": 1}, 0, with_options(SECOND_HITS, spp=(8,)))
    assert other != stream_key({"seed": 1}, 0, SECOND_HITS)


def test_without_additions_a_recipe_is_what_it_was_before_there_were_any():
    before = {"kind", "width", "height", "spp", "reference_spp", "max_depth", "chunk", "version"}
    assert STILLS.to_json().keys() == before
    assert SECOND_HITS.to_json().keys() == before | {"second_hit"}
    assert SECOND_HITS.same_work(with_options(SECOND_HITS, reference_spp=128).to_json())
    for other in (STILLS, with_options(STILLS, histogram=True), with_options(SECOND_HITS, histogram=True)):
        assert not SECOND_HITS.same_work(other.to_json())
        assert not other.same_work(SECOND_HITS.to_json())
    with pytest.raises(ValueError, match="--second-hit is for stills, not sequences; leave it out"):
        with_options(defaults("sequences"), second_hit=True)


def test_the_seeds_of_a_view_follow_from_its_stream():
    plain = ViewWork(None, "fake", 0, "k", STILLS)
    assert plain.seed("input") == seed_of("k", "input")
    assert replace(plain, stream="s").seed("reference", 64) == seed_of("s", "reference", 64)


def test_histograms_of_radiance_as_it_was_rendered_can_be_asked_for(tmp_path):
    asked = with_options(STILLS, histogram=True, histogram_exposure=1.0)
    tracer = FakeTracer(chunk=2**14, scale=50.0)
    (chunk,) = FakeTracer(chunk=2**14, scale=50.0).trace(0, 4, seed_of("k", "input"), asked.names)
    done = work(tmp_path, asked)
    render(done, tracer)
    assert [spp for _, spp, _ in tracer.calls] == [4, 64], "no sample is needed to measure an exposure"
    last = records(done)[-1]
    found = read_frame(tmp_path / last.file).buffers["histogram"]
    assert np.allclose(found, sample_histogram(chunk.values["radiance"]), atol=1e-5)
    assert last.checks["histogram_exposure"] == 1
    assert not asked.same_work(with_options(STILLS, histogram=True).to_json())
    assert not with_options(STILLS, histogram=True).same_work(asked.to_json())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"histogram_exposure": 1.0}, "--histogram-exposure is for --histogram"),
        ({"histogram": True, "histogram_exposure": 0.0}, "--histogram-exposure 0.0: expected a positive"),
        ({"histogram": True, "histogram_exposure": float("nan")}, "expected a positive number"),
    ],
)
def test_exposures_of_histograms_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        with_options(STILLS, **options)
