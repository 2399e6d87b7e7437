import json

import numpy as np
import pytest

from tests.trainer.comparison_folder import make_folder, methods_of, scene_picture
from tests.trainer.comparison_streams import bytes_of, planes_of
from trainer.reports.comparison import write_page
from trainer.reports.comparison.coding import ALPHABET, bits_of, encode, to_text
from trainer.reports.comparison.gallery import QUALITIES, Column, gallery_of
from trainer.reports.comparison.levels import FLOOR, Scale, from_planes, to_planes


def facts_of(page):
    text = page.read_text(encoding="utf-8")
    return json.loads(text.partition('id="facts">')[2].partition("</script>")[0])


@pytest.mark.parametrize("bound", [QUALITIES[0].bound, 0.02, 2 * QUALITIES[-1].bound])
def test_stored_radiance_is_off_by_at_most_the_bound_of_its_value_and_the_floor(bound):
    generator = np.random.default_rng(0)
    radiance = (generator.normal(size=(40, 50, 3)) * 10.0 ** generator.uniform(-8, 6, (40, 50, 3))).astype(
        np.float32
    )
    radiance[0, 0] = (0, 65504, -1e30)
    scale = Scale(bound, 0.37)

    found = from_planes(to_planes(radiance, scale), scale)

    allowed = bound * (np.abs(radiance.astype(np.float64)) + FLOOR / 0.37) * (1 + 1e-5)
    assert (np.abs(found - radiance.astype(np.float64)) <= allowed).all()
    assert found[0, 0, 0] == 0


def test_what_is_not_finite_stays_so_channel_by_channel():
    radiance = np.ones((4, 5, 3), np.float32)
    radiance[1, 2] = (np.nan, np.inf, -np.inf)
    scale = Scale(0.01, 1.0)

    found = from_planes(to_planes(radiance, scale), scale)

    np.testing.assert_array_equal(found[1, 2], radiance[1, 2])
    assert np.isfinite(found).sum() == found.size - 3


def planes(kind):
    generator = np.random.default_rng(1)
    if kind == "picture":
        return to_planes(scene_picture(23, 31, 0), Scale(0.02, 1.0))
    if kind == "noise":
        return [generator.integers(-3000, 3000, (17, 40)).astype(np.int32) for _ in range(3)]  # with escapes
    if kind == "constant":
        return [np.full((9, 70), 7, np.int32)]
    return [np.array([[-5]], np.int32)]


@pytest.mark.parametrize("kind", ["picture", "noise", "constant", "one pixel"])
def test_a_stream_decodes_to_the_integers_it_was_made_of(kind):
    wanted = planes(kind)

    found = planes_of(bytes_of(to_text(encode(wanted))))

    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


def test_streams_take_as_many_bits_as_their_entropy():
    levels = to_planes(
        scene_picture(360, 640, 0) * np.random.default_rng(0).gamma(4, 0.25, (360, 640, 1)), Scale(0.02, 1.0)
    )

    bits = 8 * len(encode(levels))

    assert bits_of(levels) < bits < 1.05 * bits_of(levels) + 8 * 12_000  # tables and states


def test_letters_need_no_escape_in_a_script():
    assert len(ALPHABET) == 91
    assert not set('<\\" \n') & set(ALPHABET)


def columns(count):
    return [
        Column("input", "input"),
        *(Column(f"method {i}", f"method-{i}") for i in range(count)),
        Column("reference", "reference"),
    ]


def test_the_bound_grows_until_the_pictures_fit(tmp_path):
    folder = make_folder(tmp_path, frames=1, methods=1, size=(120, 160), spps=(4,))
    frames = json.loads((folder / "evaluation.json").read_text())["frames"]

    roomy, tight = (gallery_of(folder / "images", frames, columns(1), budget) for budget in (10**7, 190_000))

    assert roomy.quality == QUALITIES[0]
    assert roomy.quality.bound < tight.quality.bound < QUALITIES[-1].bound
    assert tight.frames == (0, 1)
    assert [p.scale.bound for p in tight.pictures[:3]] == [tight.quality.bound * n for n in (2, 1, 1)]


def test_frames_that_nothing_could_denoise_have_no_pictures(tmp_path):
    folder = make_folder(tmp_path, frames=1, methods=1, spps=(4,))
    frames = json.loads((folder / "evaluation.json").read_text())["frames"]
    frames[0] |= {"width": None, "height": None}

    assert gallery_of(folder / "images", frames, columns(1)).frames == (1,)
    lost = [frame | {"width": None, "height": None} for frame in frames]
    assert gallery_of(folder / "images", lost, columns(1)).frames == ()


def test_where_the_coarsest_bound_is_not_enough_frames_of_all_scenes_keep_pictures(tmp_path):
    folder = make_folder(tmp_path, frames=5, methods=1, spps=(4,))
    frames = json.loads((folder / "evaluation.json").read_text())["frames"]

    gallery = gallery_of(folder / "images", frames, columns(1), 160_000)

    assert 2 <= len(gallery.frames) < 10
    assert {frames[i]["scene"] for i in gallery.frames} == {"hall", "garden"}
    assert gallery.quality == QUALITIES[-1]


def test_the_pictures_of_a_page_are_those_of_the_files_within_the_bound(tmp_path):
    marked = {}

    def write(label, name, radiance):
        marked[label, name] = radiance
        return radiance

    page = write_page(make_folder(tmp_path, frames=1, methods=1, size=(20, 30), spps=(4,), write=write))

    facts, text = facts_of(page), page.read_text()
    for c, label in enumerate(("input", "method 0")):
        stream = text.partition(f'id="0-{c}p">')[2].partition("</script>")[0]
        scale = Scale(facts["columns"][c]["bound"], 0.8)
        found, wanted = from_planes(planes_of(bytes_of(stream)), scale), marked[label, "hall/f000"]
        assert (np.abs(found - wanted) <= scale.bound * (np.abs(wanted) + FLOOR / 0.8) * (1 + 1e-5)).all()


def test_names_cannot_end_the_script_that_holds_them(tmp_path):
    evil = methods_of(1, label="</script><script>alert(1)</script>", run_url="javascript:alert(1)")

    page = write_page(make_folder(tmp_path, frames=1, methods=evil, size=(16, 16), spps=(4,)))

    assert "<script>alert" not in page.read_text()
    assert facts_of(page)["methods"][0]["run_url"] is None


def test_a_folder_without_an_evaluation_is_refused_with_the_command(tmp_path):
    with pytest.raises(FileNotFoundError, match="trainer evaluate"):
        write_page(tmp_path)
