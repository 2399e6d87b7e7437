"""What may be rendered into a folder and what gives way; the plan of a data set. No renderer."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from data.manifest import load_manifest
from data.render.output import check_room, examine, prepare
from data.render.recipe import Recipe, with_options
from data.render.rendering import RenderOptions, _manifest, _works, plan
from data.render.spec import Shot
from data.render.variant import Variant
from data.render.views import render_view
from tests.data.render.fake_tracer import FakeTracer, spec

RECIPE = Recipe("stills", 24, 16, (2,), 16)
OPTIONS = RenderOptions(Variant("scalar_rgb", None, ""))


@dataclass
class Named:
    """A source that is only planned."""

    name: str
    shot: Shot = field(default_factory=lambda: Shot(24, 16))
    content: str = ""

    def identity(self):
        return {"content": self.content or self.name, "frames": self.shot.frames}


def rendered(root, *sources, recipe=RECIPE, renderer="renderer 1"):
    works = _works(sources, recipe, root)
    prepare(root, recipe, examine(root, recipe, works, False))
    for name, views in works.items():
        tracer = FakeTracer(spec(views=len(views)))
        tracer.spec.name = name
        for work in views:
            render_view(work, tracer, renderer, lambda count: None)
    return works


def files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


def test_a_finished_set_misses_nothing_and_more_scenes_are_added(tmp_path):
    rendered(tmp_path, Named("a"))
    assert plan([Named("a")], RECIPE, tmp_path, OPTIONS).missing == 0
    todo = plan([Named("a"), Named("b")], RECIPE, tmp_path, OPTIONS)
    assert todo.missing == RECIPE.samples_per_view()
    assert list(todo.unfinished) == ["b"]


def test_scenes_that_a_command_does_not_name_are_not_dropped_unless_forced(tmp_path):
    rendered(tmp_path, Named("a"), Named("b"))
    before = files(tmp_path)
    with pytest.raises(ValueError, match="also holds b, which this command does not name"):
        plan([Named("a")], RECIPE, tmp_path, OPTIONS)
    assert files(tmp_path) == before
    works = _works([Named("a")], RECIPE, tmp_path)
    prepare(tmp_path, RECIPE, examine(tmp_path, RECIPE, works, True))
    assert not any(name.startswith("b/") for name in files(tmp_path))
    assert len([name for name in files(tmp_path) if name.endswith(".npz")]) == 1


def test_fewer_frames_by_force_leave_no_frame_and_no_sums_behind(tmp_path):
    rendered(tmp_path, Named("a", Shot(24, 16, 3)))
    works = _works([Named("a", Shot(24, 16, 2))], RECIPE, tmp_path)
    with pytest.raises(ValueError, match="number of frames were different"):
        examine(tmp_path, RECIPE, works, False)
    prepare(tmp_path, RECIPE, examine(tmp_path, RECIPE, works, True))
    assert files(tmp_path) == {".render/job.json"}


def test_another_recipe_is_refused_in_the_words_of_the_command_line(tmp_path):
    rendered(tmp_path, Named("a"))
    other = with_options(RECIPE, chunk=2**18, width=32)
    works = _works([Named("a")], other, tmp_path)
    with pytest.raises(ValueError, match=r"--size, columns 24 instead of 32, --memory, samples at once"):
        examine(tmp_path, other, works, False)
    prepare(tmp_path, other, examine(tmp_path, other, works, True))
    assert files(tmp_path) == {".render/job.json"}


def test_an_addition_is_another_recipe_and_named_by_its_option(tmp_path):
    rendered(tmp_path, Named("a"))
    other = with_options(RECIPE, second_hit=True)
    with pytest.raises(ValueError, match=r"another recipe \(--second-hit False instead of True\)"):
        examine(tmp_path, other, _works([Named("a")], other, tmp_path), False)


def test_views_of_a_recipe_with_additions_have_the_seeds_of_those_without(tmp_path):
    plain, asked = (
        _works([Named("a")], r, tmp_path)["a"][0] for r in (RECIPE, with_options(RECIPE, histogram=True))
    )
    assert plain.key != asked.key
    assert plain.seed("input") == asked.seed("input")
    assert plain.seed("reference", 64) == asked.seed("reference", 64)


def test_a_command_that_failed_before_any_frame_was_made_does_not_bind_the_next(tmp_path):
    works = _works([Named("a")], RECIPE, tmp_path)
    prepare(tmp_path, RECIPE, examine(tmp_path, RECIPE, works, False))
    other = with_options(RECIPE, spp=(4,))
    assert plan([Named("a")], other, tmp_path, OPTIONS).missing == other.samples_per_view()


def test_files_that_were_not_rendered_are_never_removed(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    works = _works([Named("a")], RECIPE, tmp_path)
    for force in (False, True):
        with pytest.raises(ValueError, match="was not rendered"):
            examine(tmp_path, RECIPE, works, force)
    (tmp_path / "file").write_text("x")
    with pytest.raises(OSError, match="is a file; --output must name a folder"):
        examine(tmp_path / "file", RECIPE, works, True)


def test_scenes_of_one_name_or_one_content_are_refused(tmp_path):
    with pytest.raises(ValueError, match="two scenes are called 'a'"):
        plan([Named("a"), Named("a", content="other")], RECIPE, tmp_path, OPTIONS)
    with pytest.raises(ValueError, match="'a' and 'b' have the same content"):
        plan([Named("a", content="same"), Named("b", content="same")], RECIPE, tmp_path, OPTIONS)


def test_a_plan_knows_the_scenes_to_hold_out(tmp_path):
    options = RenderOptions(OPTIONS.variant, test=("c",))
    with pytest.raises(ValueError, match="no scene 'c' to hold out"):
        plan([Named("a"), Named("b")], RECIPE, tmp_path, options)


def test_the_manifest_names_every_renderer_that_took_part(tmp_path):
    shot = Shot(24, 16, 2)
    works = rendered(tmp_path, Named("a", shot))
    work = works["a"][1]
    memory = json.loads(work.memory.read_text())
    work.memory.write_text(json.dumps({**memory, "renderer": "renderer 2"}))
    source = Named("a", shot)
    todo = plan([source], RECIPE, tmp_path, OPTIONS)
    _manifest([source], todo, RECIPE, {"train": ["a"]}, OPTIONS, tmp_path).save(tmp_path)
    assert "renderer 1 and renderer 2" in load_manifest(tmp_path).scenes["a"].provenance


def test_an_altered_file_counts_as_missing_and_a_glance_sees_only_its_size(tmp_path):
    (work,) = rendered(tmp_path, Named("a"))["a"]
    path = tmp_path / work.remembered()["records"][0].file
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert work.remembered() is None
    assert work.remembered(unaltered=False) is not None
    path.write_bytes(data[:-1])
    assert work.remembered(unaltered=False) is None


def test_a_full_disk_is_said_in_units_that_show_the_difference(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda root: type("Usage", (), {"free": 12_000}))
    with pytest.raises(OSError, match=r"about 0\.25 MB are needed and 0\.012 MB are free"):
        check_room(tmp_path, 250_000)
