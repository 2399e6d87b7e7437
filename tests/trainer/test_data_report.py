from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from data.frame import Frame, Samples
from data.frames import FrameSet
from data.ingestion import write_record
from data.manifest import Manifest, SceneRecord
from data.shards.division import plan_shards
from data.shards.options import RECIPES, recipe_options
from tests.data.miniature import Crop, ingested, sample_crop
from trainer.reports import data_page, data_report
from trainer.reports.data_page import column_frames, noise_rows, strip_frames
from trainer.reports.data_report import examine, make_jobs, write_report
from trainer.reports.frame_facts import FrameJob, look_at, scores
from trainer.reports.thumbnails import window

SHARED = Path(__file__).resolve().parents[3] / "shared" / "dataset" / "stills"


def made(root, scenes, splits=None, **records):
    """Write frames as a data set; scenes is name → frames, splits as in the manifest."""
    kept = {
        name: SceneRecord(
            frames=tuple(write_record(replace(f, scene=name), root) for f in frames),
            **{"sequence": False, "license": "CC0", **records.get(name.replace("-", "_"), {})},
        )
        for name, frames in scenes.items()
    }
    names = list(scenes)
    splits = splits or {"train": names[:-1], "validation": [], "test": names[-1:]}
    Manifest("made", "rendered", "euclidean", splits, kept).save(root)
    return root


def levels(scene="cbox-glossy", spps=(4, 16), views=2):
    """Return frames of one scene: views with several numbers of samples, as a rendered set of stills has."""
    frames = []
    for view in range(views):
        base = sample_crop(scene, 3 * view)
        for spp in spps:
            generator = np.random.default_rng(spp)
            noise = generator.gamma(spp, 1 / spp, base.buffers["color"].shape[:2])[..., None]
            color = (base.buffers["reference"] * noise).astype(np.float32)
            buffers = base.buffers | {"color": color, "color_variance": np.square(color) / np.float32(spp)}
            buffers.pop("irradiance")
            notes = {"view": view, "reference_spp": 512}
            frames.append(replace(base, buffers=buffers, index=len(frames), spp=spp, notes=notes))
    return frames


def report(root, tmp_path, **options):
    found = write_report(root, tmp_path / "report.html", **options)
    return found, (tmp_path / "report.html").read_text(encoding="utf-8")


def texts(found, level=None):
    return " | ".join(f.text for f in found if level in (None, f.level))


class Page(HTMLParser):
    """Collects tags; complains where elements are not closed in order."""

    void = {"meta", "img", "br", "path", "line", "rect"}

    def __init__(self, text):
        super().__init__()
        self.open, self.tags = [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in self.void:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def all(self, tag, key):
        return [a[key] for t, a in self.tags if t == tag and key in a]


def test_the_page_is_one_file_that_loads_nothing(tmp_path):
    _, text = report(ingested(tmp_path), tmp_path)
    page = Page(text)
    sources = page.all("img", "src")
    assert len(sources) > 20
    assert all(s.startswith(("data:image/jpeg;base64,", "data:image/png;base64,")) for s in sources)
    assert not page.all("link", "href")
    assert not page.all("script", "src")
    assert "http" not in text.replace("http://www.w3.org", "")
    assert "@import" not in text
    assert "url(" not in text


def test_every_link_of_the_page_has_a_target(tmp_path):
    _, text = report(ingested(tmp_path), tmp_path)
    page = Page(text)
    ids = {i for _, a in page.tags if (i := a.get("id"))}
    links = page.all("a", "href")
    assert {"#scene-0", "#scene-1"} <= set(links)
    assert {link.removeprefix("#") for link in links} <= ids


def test_every_buffer_of_a_scene_has_a_picture_with_its_name(tmp_path):
    root = made(tmp_path / "set", {"a": levels(), "b": levels("classroom")})
    _, text = report(root, tmp_path)
    alts = Page(text).all("img", "alt")
    names = FrameSet(root).read("a", 1).buffers
    assert {"color", "reference", "albedo", "normal", "depth", "position", "color_variance"} <= names.keys()
    for name in names:
        assert f"a, frame 1: {name}" in alts


def test_pictures_are_decoded_when_they_come_into_view(tmp_path):
    _, text = report(ingested(tmp_path), tmp_path)
    shown = [a for t, a in Page(text).tags if t == "img" and "src" in a]
    assert all(a["loading"] == "lazy" and a["width"] and a["height"] for a in shown)


def test_names_from_the_manifest_cannot_inject_markup(tmp_path):
    credit = {"a": {"credit": "<script>alert(1)</script>", "origin": {"kind": "</pre><b>x"}}}
    root = made(tmp_path / "set", {"a": levels(), "b": levels("classroom")}, **credit)
    _, text = report(root, tmp_path)
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert "</pre><b>x" not in text


def test_the_same_data_give_the_same_page_with_one_process_and_with_two(tmp_path):
    root = made(tmp_path / "set", {"a": levels(views=1), "b": levels("classroom", views=1)})
    _, one = report(root, tmp_path)
    _, two = report(root, tmp_path, processes=2, force=True)
    assert one == two


def test_progress_counts_every_frame_once(tmp_path):
    calls = []
    root = ingested(tmp_path)
    write_report(root, tmp_path / "r.html", progress=lambda *a: calls.append(a))
    assert [c[:2] for c in calls] == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert len({c[2] for c in calls}) == 4


def test_views_with_several_numbers_of_samples_are_shown_side_by_side(tmp_path):
    root = made(tmp_path / "set", {"a": levels(spps=(4, 16, 64)), "b": levels("classroom")})
    scene = FrameSet(root).manifest.scenes["a"]
    assert [f.spp for f in column_frames(scene)] == [4, 16, 64]
    assert [(f.view, f.spp) for f in strip_frames(scene)] == [(0, 64), (1, 64)]
    _, text = report(root, tmp_path)
    alts = Page(text).all("img", "alt")
    assert [alt for alt in alts if alt.startswith("a, ") and "spp" in alt] == [
        "a, 4 spp", "a, 16 spp", "a, 64 spp",
    ]  # fmt: skip
    assert "a, reference" in alts


def test_noise_is_stated_per_scene_and_number_of_samples_with_the_metrics_of_the_trainer(tmp_path):
    root = made(tmp_path / "set", {"a": levels(), "b": levels("classroom")})
    frames = FrameSet(root)
    facts = examine(frames)
    views = [data_report_view(frames, name, facts) for name in ("a", "b")]
    rows = noise_rows(views)
    assert [(r["scene"].name, r["spp"], r["frames"]) for r in rows] == [
        ("a", 4, 2), ("a", 16, 2), ("b", 4, 2), ("b", 16, 2),
    ]  # fmt: skip
    frame = frames.read("a", 0)
    x, r = (frame.buffers[n] * np.float32(frame.exposure) for n in ("color", "reference"))
    display = [np.clip(np.maximum(i.astype(np.float64), 0) ** 0.454545, 0, 1) for i in (x, r)]
    psnr = -10 * np.log10(np.square(display[0] - display[1]).mean())
    assert facts[0].scores["psnr_wskp"] == pytest.approx(psnr, abs=1e-3)
    assert facts[0].scores["relmse_layer"] == pytest.approx(np.mean((x - r) ** 2 / (r**2 + 1e-4)), rel=1e-4)
    assert rows[0]["psnr"] == pytest.approx(np.mean([facts[i].scores["psnr_wskp"] for i in (0, 2)]))
    assert rows[0]["psnr"] < rows[1]["psnr"]


def data_report_view(frames, name, facts):
    from trainer.reports.data_page import _scene_view

    return _scene_view(frames.manifest, name, [f for f in facts if f.scene == name])


def test_equal_input_and_reference_have_an_infinite_psnr_that_the_page_can_show(tmp_path):
    image = np.random.default_rng(0).random((8, 8, 3), np.float32)
    assert scores(image, image) == {"psnr_wskp": float("inf"), "relmse_layer": 0.0}
    frame = sample_crop("classroom", 0).with_buffers()
    frame.buffers["color"] = frame.buffers["reference"]
    _, text = report(made(tmp_path / "set", {"a": [frame], "b": levels()}), tmp_path)
    assert "∞" in text


def test_a_damaged_frame_is_a_problem_and_the_others_are_shown(tmp_path):
    root = ingested(tmp_path)
    (root / "classroom" / "f001.exr").write_bytes(b"x")
    (root / "cbox-glossy" / "f000.exr").unlink()
    found, text = report(root, tmp_path)
    assert found[0].level == "problem"
    assert found[0].damaged
    assert "2 frames cannot be read" in found[0].text
    assert "f001.exr has 1 bytes" in text
    assert "f000.exr is missing" in text
    assert "classroom, frame 0: color" in Page(text).all("img", "alt")


def test_a_set_without_any_readable_frame_still_has_a_page(tmp_path):
    root = ingested(tmp_path)
    for path in root.glob("*/*.exr"):
        path.write_bytes(b"x")
    found, text = report(root, tmp_path)
    assert "4 frames cannot be read" in found[0].text
    Page(text)


def test_a_planted_duplicate_across_splits_is_a_problem_with_both_pictures(tmp_path):
    whole = Crop(0, 0, 320, 180)
    frame = sample_crop("living-room-2", 0, whole)
    generator = np.random.default_rng(1)
    other = frame.buffers["reference"] * generator.exponential(size=(180, 320, 1)).astype(np.float32)
    again = replace(frame, buffers=frame.buffers | {"color": other})
    again.buffers.pop("irradiance")
    scenes = {"room": [frame], "classroom": [sample_crop("classroom", 0, whole)], "copy": [again]}
    found, text = report(made(tmp_path / "set", scenes), tmp_path)
    (alike,) = [f for f in found if "same view" in f.text]
    assert (alike.level, alike.scenes) == ("problem", ("room", "copy"))
    assert "same view in different splits" in text
    splits = {"train": ["room", "copy"], "validation": [], "test": ["classroom"]}
    found, text = report(made(tmp_path / "again", scenes, splits), tmp_path, force=True)
    (alike,) = [f for f in found if "same view" in f.text]
    assert alike.level == "note"
    assert "same view, one split" in text


def test_consecutive_frames_and_different_scenes_are_not_called_alike(tmp_path):
    found, text = report(ingested(tmp_path, frames=3), tmp_path)
    assert "same view" not in texts(found)
    assert "No two scenes show the same view." in text


def test_samples_kept_apart_are_shown_by_their_mean(tmp_path):
    base = sample_crop("classroom", 0)
    radiance = np.stack([base.buffers["color"] * np.float32(k) for k in (0.5, 1.5)])
    kept = {n: base.buffers[n] for n in ("reference", "normal")}
    frame = replace(base, buffers=kept, spp=2, samples=Samples.of({"radiance": radiance}))
    root = made(tmp_path / "set", {"a": [frame], "b": levels()})
    facts = examine(FrameSet(root))[0]
    assert "color" in facts.thumbnails
    expected = sample_crop("classroom", 0).buffers
    exposed = [expected[n].astype(np.float16).astype(np.float32) for n in ("color", "reference")]
    plain = scores(*(i * np.float32(base.exposure) for i in exposed))
    assert facts.scores["psnr_wskp"] == pytest.approx(plain["psnr_wskp"], abs=0.05)
    assert "kept per sample: radiance" in report(root, tmp_path)[1]


def test_the_motion_of_a_sequence_is_that_of_its_second_frame(tmp_path):
    frames = [
        sample_crop("classroom", i).with_buffers(motion=np.full((32, 48, 2), i, np.float32)) for i in (0, 1)
    ]
    root = made(tmp_path / "set", {"a": frames, "b": levels()}, a={"sequence": True})
    _, text = report(root, tmp_path)
    assert "motion of frame 1" in Page(text).all("img", "alt")
    assert "hue: direction, up to 1.4 px" in text


def test_motion_that_is_not_stored_is_derived_from_positions_and_cameras(tmp_path):
    scene = "classroom"
    pair = [sample_crop(scene, i) for i in (0, 1)]
    for frame in pair:
        frame.buffers.pop("motion", None)
    root = made(tmp_path / "set", {scene: pair, "b": levels()}, classroom={"sequence": True})
    frames = FrameSet(root)
    second = frames.frames(scene)[1]
    assert "motion" not in second.buffers
    _, text = report(root, tmp_path)
    assert f"motion of frame {second.index}" in Page(text).all("img", "alt")
    last = list(frames.sequence(scene, ["motion"]))[1].buffers["motion"]
    longest = np.percentile(np.hypot(last[..., 0], last[..., 1]), 99)
    assert f"up to {longest:.2g} px" in text
    stranger = FrameJob(str(root), scene, second, "main", 64, before="none.exr")
    assert "motion" not in look_at(stranger).thumbnails


def test_the_numbers_of_patches_are_those_that_prepare_plans(tmp_path):
    frames = [
        frame
        for view in (0, 1, 2)
        for frame in (
            Frame(
                {
                    "color": np.ones((144, 160, 3), np.float32),
                    "reference": np.ones((144, 160, 3), np.float32),
                },
                "a",
                2 * view + level,
                spp=spp,
                exposure=1.0,
                notes={"view": view},
            )
            for level, spp in enumerate((4, 16))
        )
    ]
    root = made(tmp_path / "set", {"a": frames, "b": [replace(f, scene="b") for f in frames[:1]]})
    rows = {row["recipe"]: row for row in data_page.patch_rows(FrameSet(root))}
    assert list(rows) == [None, *RECIPES]
    clips = rows.pop("recurrent")
    assert "no training scene with 7 consecutive frames of one sequence: a is no sequence" in clips["problem"]
    for recipe, row in rows.items():
        options = recipe_options(recipe, {"samples": "none"})
        planned = Counter()
        for plan in plan_shards(FrameSet(root), options):
            planned[plan.split] += len(plan.samples)
        assert row["counts"] == planned
    text = report(root, tmp_path)[1]
    assert f"<td>≤ {rows['afgsa']['counts']['train']}</td>" in text
    assert "400 candidates, pruned by importance, 128×128" in text


def test_sets_that_prepare_would_refuse_say_why_in_place_of_numbers(tmp_path):
    text = report(made(tmp_path / "set", {"a": levels(), "b": levels("classroom")}), tmp_path)[1]
    assert text.count(".exr is 48x32, smaller than a patch of 128x128") == len(RECIPES)
    assert (
        text.count(
            "the set has no training scene with 7 consecutive frames of one sequence: a is no sequence"
        )
        == 1
    )
    assert str(tmp_path) not in text


def test_the_number_of_clips_of_sequences_is_told_with_their_length(tmp_path):
    image = np.ones((144, 320, 3), np.float32)
    frames = [Frame({"color": image, "reference": image}, "a", i, exposure=1.0) for i in range(8)]
    sequence = {"sequence": True}
    root = made(tmp_path / "set", {"a": frames, "b": frames[:1]}, a=sequence, b=sequence)
    row = next(row for row in data_page.patch_rows(FrameSet(root)) if row["recipe"] == "recurrent")
    assert row["counts"] == {"train": 80 * 8 // 20 // 7, "validation": 20 * 8 // 20 // 7, "test": 1}
    assert "80 uniform, 128×128, in clips of 7 frames" in report(root, tmp_path)[1]


def test_pairs_that_are_not_shown_are_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(data_page, "PAIRS", 1)
    names = {"a": "train", "b": "train", "c": "test"}
    frames = {name: [replace(sample_crop("classroom", 0), scene=name)] for name in names}
    root = made(tmp_path / "set", frames, splits={"train": ["a", "b"], "validation": [], "test": ["c"]})
    text = report(root, tmp_path)[1]
    assert "2 more pairs of scenes are not shown, 1 of them in different splits" in text


def test_long_lists_of_scenes_are_folded(tmp_path):
    tiny = Frame({"color": np.ones((8, 8, 3), np.float32)}, "s", 0, exposure=1.0)
    root = made(tmp_path / "set", {f"s{i:02d}": [replace(tiny, scene=f"s{i:02d}")] for i in range(27)})
    text = report(root, tmp_path)[1]
    assert "<summary>26 scenes of train</summary>" in text


def test_checks_origin_recipe_and_reference_noise_are_on_the_page(tmp_path):
    frames = levels(views=1)
    frames[0].notes["checks"] = {"energy_z": 1.25, "reference_relmse": 0.00125}
    root = made(tmp_path / "set", {"a": frames, "b": levels()}, a={"origin": {"seed": 4711}})
    manifest = FrameSet(root).manifest
    replace(manifest, recipe={"recipe": "stills"}).save(root)
    _, text = report(root, tmp_path)
    for expected in ("4711", "0.00125", "&#34;recipe&#34;: &#34;stills&#34;", manifest.hash[:0]):
        assert expected in text


def test_thumbnails_shrink_so_that_the_page_stays_small(tmp_path, monkeypatch):
    root = made(tmp_path / "set", {"a": levels(views=1), "b": levels("classroom", views=1)})
    jobs = make_jobs(FrameSet(root))
    assert {(j.pictures, j.limit) for j in jobs if j.pictures != "none"} == {("all", 320)}
    monkeypatch.setattr(data_report, "PAGE", 1.0)
    jobs = make_jobs(FrameSet(root))
    assert [j.pictures for j in jobs if j.pictures != "none"] == ["all", "main"]
    assert {j.limit for j in jobs} == {128}
    Page(report(root, tmp_path)[1])


def test_large_frames_are_reduced_and_their_middle_shown_in_full_size(tmp_path):
    frame = sample_crop("living-room-2", 0, Crop(0, 0, 320, 180))
    large = replace(frame, buffers={n: np.repeat(b, 2, 1) for n, b in frame.buffers.items()}, camera=None)
    facts = examine(FrameSet(made(tmp_path / "set", {"a": [large], "b": levels()})))[0]
    assert (facts.thumbnails["color"].width, facts.thumbnails["color"].height) == (320, 90)
    assert facts.columns["color"].width == 320
    middle = window(large.buffers["color"], 320)
    np.testing.assert_array_equal(middle, large.buffers["color"][:, 160:480])


def test_both_ways_to_choose_patches_are_drawn_over_the_frame(tmp_path):
    facts = examine(FrameSet(ingested(tmp_path)))[0]
    assert list(facts.density) == ["uniform", "importance"]
    assert facts.patch == 16  # half of the shorter side, as the frame is smaller than a patch
    assert all("of them hold a pixel" in t.note for t in facts.density.values())


def test_a_page_is_not_replaced_unasked_nor_left_half_written(tmp_path, monkeypatch):
    root = ingested(tmp_path)
    target = tmp_path / "report.html"
    target.write_text("mine")
    with pytest.raises(ValueError, match="already there"):
        write_report(root, target)

    def fail(*arguments):
        raise OSError("no space")

    monkeypatch.setattr(data_report, "render", fail)
    with pytest.raises(OSError, match="no space"):
        write_report(root, target, force=True)
    assert target.read_text() == "mine"
    assert not list(tmp_path.glob(".report*"))


def test_targets_that_cannot_be_are_refused_before_any_work(tmp_path):
    root = ingested(tmp_path)
    with pytest.raises(ValueError, match="is a folder"):
        write_report(root, tmp_path)
    with pytest.raises(FileNotFoundError, match="none does not exist"):
        write_report(root, tmp_path / "none" / "report.html")


def test_frames_are_read_once(tmp_path, monkeypatch):
    root = ingested(tmp_path)
    read = []
    plain = FrameSet.read

    def counting(self, scene, index, *arguments, **options):
        read.append((scene, index))
        return plain(self, scene, index, *arguments, **options)

    monkeypatch.setattr(FrameSet, "read", counting)
    report(root, tmp_path)
    assert sorted(read) == sorted(set(read))
    assert len(read) == 4


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared development data")
def test_rendered_stills_have_a_small_page_that_tells_two_materials_of_one_scene(tmp_path):
    from data.ingestion import IngestOptions, ingest

    (tmp_path / "source").mkdir()
    for name in ("cbox-glossy", "matpreview-copper", "matpreview-plastic"):
        (tmp_path / "source" / name).symlink_to(SHARED / name)
    ingest("penumbra", tmp_path / "source", tmp_path / "set", IngestOptions(test=("cbox-glossy",)))
    found, text = report(tmp_path / "set", tmp_path)
    assert len(text) < 3e6
    assert [f.level for f in found if f.level == "problem"] == []
    assert "same geometry and camera" in text  # matpreview-copper and matpreview-plastic
    assert "3 scenes do not state a licence" in text
    Page(text)


def test_frame_without_radiance_is_described_by_what_it_has(tmp_path):
    base = sample_crop("classroom", 0)
    bare = Frame({"depth": base.buffers["depth"]}, "x", 0, exposure=1.0)
    facts = examine(FrameSet(made(tmp_path / "set", {"a": [bare], "b": levels()})))[0]
    assert list(facts.thumbnails) == ["depth"]
    assert facts.strip is None
    Page(report(tmp_path / "set", tmp_path)[1])
