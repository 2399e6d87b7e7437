"""`trainer prepare` and what it stands on: planning, several processes, interruption, refusal."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import types
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from data.frames import FrameSet
from data.patches import REFERENCE_AREA
from data.shards.batch import Batches, Order
from data.shards.cut import CUT_VERSION
from data.shards.division import plan_shards
from data.shards.estimate import estimate
from data.shards.index import INDEX, Index
from data.shards.options import PrepareOptions
from data.shards.prepare import cached_path, prepare, prepare_cached
from data.shards.read import ShardReader
from tests.data.small_sets import OPTIONS, write_set
from trainer.cli import main

ARGUMENTS = ["--patch-size", "16", "--train-patches", "4000", "--validation-patches", "1000"]


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_set(tmp_path_factory.mktemp("set") / "frames", frames=4)


@pytest.fixture(scope="module")
def expected(frames: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    output = tmp_path_factory.mktemp("expected") / "shards"
    prepare(frames, output, OPTIONS)
    return content(output)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def command(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["trainer", "prepare", *map(str, arguments)])
    return main()


def test_the_command_prints_what_it_made(frames, tmp_path, monkeypatch, capsys):
    assert command(monkeypatch, frames, "--output", tmp_path / "shards", *ARGUMENTS) == 0
    printed = capsys.readouterr().out.split()
    index = Index.read(tmp_path / "shards")
    assert printed[printed.index("train") + 1 : printed.index("train") + 4] == [
        str(index.count("train")),
        "patches",
        "of",
    ]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["shards"]


def test_patches_have_the_published_density_and_splits_go_by_scene(frames: Path):
    plans = plan_shards(FrameSet(frames), OPTIONS)
    for split, number, scenes in (("train", 4000, {"hall", "roof"}), ("validation", 1000, {"hall", "roof"})):
        mine = [plan for plan in plans if plan.split == split]
        assert {plan.scene for plan in mine} == scenes
        per_scene = int(4 * Fraction(number * 48 * 40, REFERENCE_AREA))
        assert sum(len(plan.samples) for plan in mine) == 2 * per_scene
    test = [plan for plan in plans if plan.split == "test"]
    assert [sample for plan in test for sample in plan.samples] == [(index, None) for index in range(4)]


def test_validation_comes_from_its_own_scenes_where_the_manifest_has_some(tmp_path: Path):
    splits = {"train": ["hall"], "validation": ["roof"], "test": ["cave"]}
    plans = plan_shards(FrameSet(write_set(tmp_path, splits, frames=1)), OPTIONS)
    assert {(plan.split, plan.scene) for plan in plans} == {
        ("train", "hall"), ("validation", "roof"), ("test", "cave"),
    }  # fmt: skip


def test_small_sets_have_shards_for_eight_ranks(frames: Path):
    plans = plan_shards(FrameSet(frames), replace(OPTIONS, samples_per_shard=256))
    sizes = [len(plan.samples) for plan in plans if plan.split == "train"]
    assert len(sizes) >= 8
    assert max(sizes) - min(sizes) <= 1


def test_the_result_does_not_depend_on_the_number_of_processes(frames, expected, tmp_path):
    prepare(frames, tmp_path / "shards", OPTIONS, processes=3)
    assert content(tmp_path / "shards") == expected


def run_until(
    frames: Path,
    output: Path,
    processes: int,
    shards: int,
    options: Sequence[str] = ("--samples-per-shard", "4"),
) -> int:
    """Start the command, end it with SIGKILL once so many shards are finished; return how many were."""
    arguments = [sys.executable, "-m", "trainer.cli", "prepare", str(frames), "--output", str(output)]
    arguments += [*ARGUMENTS, *options, "--processes", str(processes)]
    code = "import sys, time; from data.shards import cut; write = cut.write_json\n"
    code += "def slow(*a):\n    time.sleep(0.1); write(*a)\n"
    code += "cut.write_json = slow\nfrom trainer.cli import main\nsys.exit(main())"
    if processes == 1:
        arguments[1:3] = ["-c", code]
    process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    records = output.with_name(output.name + ".partial") / "records"
    deadline = time.monotonic() + 60
    while len(list(records.glob("*.tar.json"))) < shards and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    return len(list(records.glob("*.tar.json")))


@pytest.mark.parametrize("shards", [0, 1, 5])
def test_killed_at_any_time_it_continues_to_the_same_bytes(frames, expected, tmp_path, monkeypatch, shards):
    output = tmp_path / "shards"
    finished = run_until(frames, output, 1, shards)
    assert shards <= finished < len(expected) - 1
    assert not output.exists()
    kept = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "shards.partial" / "shards").glob("*.tar")}
    assert command(monkeypatch, frames, "--output", output, *ARGUMENTS, "--samples-per-shard", 4) == 0
    assert content(output) == expected
    recorded = [name for name in kept if (output / name).stat().st_mtime_ns == kept[name]]
    assert len(recorded) >= finished
    assert [p.name for p in tmp_path.iterdir()] == ["shards"]


def test_a_finished_shard_that_was_damaged_since_is_made_again(frames, expected, tmp_path):
    output = tmp_path / "shards"
    run_until(frames, output, 1, 3)
    work = tmp_path / "shards.partial" / "shards"
    damaged = sorted(work.glob("*.tar"))[0]
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    prepare(frames, output, OPTIONS)
    assert content(output) == expected


def test_workers_end_with_the_process_that_started_them(frames: Path, tmp_path: Path):
    code = (
        "import os, sys, time\n"
        "from concurrent.futures import ProcessPoolExecutor\n"
        "from multiprocessing import get_context\n"
        "from data.shards.processes import end_with_parent\n"
        "if __name__ == '__main__':\n"
        "    pool = ProcessPoolExecutor(1, get_context('spawn'), end_with_parent)\n"
        "    print(pool.submit(os.getpid).result(), flush=True)\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    script = tmp_path / "start.py"
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    made = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, env=environment, check=False
    )
    worker = int(made.stdout)
    deadline = time.monotonic() + 30
    while alive(worker):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_an_interrupted_preparation_is_not_continued_with_other_options(
    frames, tmp_path, monkeypatch, capsys
):
    run_until(frames, tmp_path / "shards", 1, 1)
    assert command(monkeypatch, frames, "--output", tmp_path / "shards", "--patch-size", 8) == 1
    assert "holds the beginning of shards from other frames or options" in capsys.readouterr().err
    assert command(monkeypatch, frames, "--output", tmp_path / "shards", "--patch-size", 8, "--force") == 0
    assert Index.read(tmp_path / "shards").options["patch_size"] == 8


def test_existing_shards_are_replaced_only_with_force(frames, expected, tmp_path, monkeypatch, capsys):
    output = tmp_path / "shards"
    prepare(frames, output, replace(OPTIONS, seed=7))
    before = content(output)
    with pytest.raises(ValueError, match="holds shards already; --force replaces them"):
        prepare(frames, output, OPTIONS)
    assert content(output) == before
    prepare(frames, output, OPTIONS, force=True)
    assert content(output) == expected
    assert [p.name for p in tmp_path.iterdir()] == ["shards"]


class Ended(BaseException):
    """Stands for the end of the process."""


@pytest.mark.parametrize("call", [1, 2])
def test_an_end_while_replaced_shards_are_removed_does_not_disturb_the_next_force(
    frames, expected, tmp_path, monkeypatch, call
):
    output = tmp_path / "shards"
    prepare(frames, output, replace(OPTIONS, seed=7))
    calls = []

    def end(folder: Path) -> None:
        calls.append(folder)
        if len(calls) == call:
            raise Ended
        remove(folder)

    remove = shutil.rmtree
    with monkeypatch.context() as patched:
        patched.setattr("data.shards.prepare.shutil.rmtree", end)
        with pytest.raises(Ended):
            prepare(frames, output, OPTIONS, force=True)
    assert content(output) == expected
    assert (tmp_path / ".shards.old" / INDEX).is_file()
    prepare(frames, output, OPTIONS, force=True)
    assert content(output) == expected
    assert [p.name for p in tmp_path.iterdir()] == ["shards"]


def test_a_folder_of_other_files_is_never_replaced(frames: Path, tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match="holds other files"):
        prepare(frames, tmp_path, OPTIONS, force=True)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_an_empty_folder_may_be_the_output(frames, expected, tmp_path):
    (tmp_path / "shards").mkdir()
    prepare(frames, tmp_path / "shards", OPTIONS)
    assert content(tmp_path / "shards") == expected


def test_a_folder_that_cannot_be_written_is_named(frames: Path):
    with pytest.raises(OSError, match="cannot write shards into /proc"):
        prepare(frames, Path("/proc/shards"), OPTIONS)


def test_patches_with_a_black_reference_are_left_out_and_counted(tmp_path, monkeypatch, capsys):
    frames = write_set(tmp_path / "frames", black=("hall", 1))
    assert command(monkeypatch, frames, "--output", tmp_path / "shards", *ARGUMENTS) == 0
    index = Index.read(tmp_path / "shards")
    planned = sum(len(plan.samples) for plan in plan_shards(FrameSet(frames), OPTIONS))
    kept = sum(index.count(split) for split in ("train", "validation", "test"))
    assert index.skipped == planned - kept > 8
    assert f"{index.skipped} patches with a black reference" in capsys.readouterr().out
    reader = ShardReader(index, "train")
    assert {(reader.sample(i).scene, reader.sample(i).frame) for i in range(len(reader))} == {
        (scene, frame) for scene in ("hall", "roof") for frame in range(3)
    } - {("hall", 1)}


def test_without_accumulation_irradiance_is_that_of_the_frame(frames: Path, tmp_path: Path):
    index = prepare(frames, tmp_path / "shards", replace(OPTIONS, accumulate=False))
    reader = ShardReader(index, "test")
    batch = Batches(reader, ("irradiance", "color", "albedo", "history"), True)[Order(0, (3,))].unpack()
    assert not reader.sample(3).accumulated
    assert (batch["history"] == 1).all()
    assert np.allclose(batch["irradiance"] * batch["albedo"], batch["color"], rtol=2e-3)


def test_scenes_that_are_no_sequence_are_not_accumulated(tmp_path: Path):
    frames = write_set(tmp_path / "frames", sequence=False)
    reader = ShardReader(prepare(frames, tmp_path / "shards", OPTIONS), "test")
    assert not any(reader.sample(i).accumulated for i in range(len(reader)))


def test_radiance_beyond_half_precision_is_stored_in_float32(tmp_path: Path):
    frames = write_set(tmp_path / "frames", frames=1, scale=1e7)
    index = prepare(frames, tmp_path / "shards", OPTIONS)
    batch = Batches(ShardReader(index, "test"), ("reference",), True)[Order(0, (0,))].unpack()
    expected = FrameSet(frames).read("cave", 0).buffers["reference"].transpose(2, 0, 1)
    assert np.array_equal(batch["reference"][0], expected)
    assert batch["reference"].max() > 65504


def test_further_buffers_are_kept_when_named_and_refused_when_absent(frames, tmp_path):
    index = prepare(frames, tmp_path / "shards", replace(OPTIONS, buffers=("motion",)))
    assert ShardReader(index, "train").array(0, "motion").shape == (2, 16, 16)
    with pytest.raises(ValueError, match="missing buffer position"):
        prepare(frames, tmp_path / "other", replace(OPTIONS, buffers=("position",)))
    with pytest.raises(ValueError, match="unknown buffer 'motoin'"):
        PrepareOptions(buffers=("motoin",))


def test_legacy_crops_take_77_per_published_frame_and_need_large_frames(frames, tmp_path):
    legacy = replace(OPTIONS, wskp_legacy_crops=True, train_patches=80, validation_patches=20)
    plans = plan_shards(FrameSet(write_set(tmp_path / "large", frames=1, size=(640, 360))), legacy)
    assert sum(len(plan.samples) for plan in plans if plan.split == "train") == 2 * (77 // 4)
    with pytest.raises(ValueError, match="larger than two patches"):
        plan_shards(FrameSet(frames), replace(legacy, patch_size=24))


def test_legacy_crops_that_reach_into_the_padding_are_black_there(frames: Path, tmp_path: Path):
    index = prepare(frames, tmp_path / "shards", replace(OPTIONS, wskp_legacy_crops=True))
    reader = ShardReader(index, "train")
    depths = [reader.array(i, "depth") for i in range(len(reader))]
    assert any((depth == 0).any() and (depth > 0).any() for depth in depths)


def test_frames_smaller_than_a_patch_name_file_and_option(frames, tmp_path, monkeypatch, capsys):
    assert command(monkeypatch, frames, "--output", tmp_path / "shards") == 1
    message = capsys.readouterr().err
    assert "hall/f000.exr is 48x40" in message
    assert "--patch-size 40" in message
    assert [p.name for p in tmp_path.iterdir() if p.suffix != ".partial"] == []


def test_shards_cannot_be_prepared_again(frames, tmp_path, monkeypatch, capsys):
    prepare(frames, tmp_path / "shards", OPTIONS)
    assert command(monkeypatch, tmp_path / "shards", "--output", tmp_path / "more") == 1
    assert "holds shards already; name a folder made by `trainer ingest`" in capsys.readouterr().err


def test_processes_that_want_the_same_cached_shards_make_them_once(frames, expected, tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path))
    code = "import sys; from pathlib import Path; from data.shards.prepare import prepare_cached\n"
    code += (
        "from tests.data.small_sets import OPTIONS\nprint(prepare_cached(Path(sys.argv[1]), OPTIONS).root)"
    )
    arguments = [sys.executable, "-c", code, str(frames)]
    started = [subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    printed = {process.communicate()[0].strip() for process in started}
    assert [process.returncode for process in started] == [0, 0, 0]
    root = Path(printed.pop())
    assert not printed
    assert root.parent == tmp_path / "shards"
    assert content(root) == expected
    assert [p.name for p in root.parent.iterdir()] == [root.name]
    assert prepare_cached(frames, OPTIONS).root == root
    assert prepare_cached(frames, replace(OPTIONS, seed=3)).root != root


def test_the_estimate_is_close_to_what_is_made(frames, expected):
    found = estimate(FrameSet(frames), OPTIONS)
    shards = json.loads(expected[INDEX])["shards"]
    assert found.frames == sum(len(s["samples"]) for s in shards if s["split"] == "test")
    assert found.patches == sum(len(s["samples"]) for s in shards if s["split"] != "test")
    assert found.bytes == pytest.approx(sum(s["bytes"] for s in shards), rel=0.05)


def test_filling_the_cache_says_size_place_and_how_to_choose_it(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path))
    found = estimate(FrameSet(frames), OPTIONS)
    root = prepare_cached(frames, OPTIONS).root
    assert capsys.readouterr().err.splitlines() == [
        f"preparing frames: {found.patches} patches and {found.frames} whole frames, about 1 MB, in {root}; "
        f"to choose the place: trainer prepare {frames} --output DIR --processes N, then --data.root DIR"
    ]
    prepare_cached(frames, OPTIONS)
    assert capsys.readouterr().err == ""


def test_a_disk_without_room_is_told_before_anything_is_made(frames, tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path))
    usage = types.SimpleNamespace(free=400_000)
    monkeypatch.setattr("data.shards.estimate.shutil.disk_usage", lambda folder: usage)
    with pytest.raises(OSError, match=r"take about 1 MB, and 0 MB are free; make room, set PENUMBRA_CACHE"):
        prepare_cached(frames, OPTIONS)
    assert list((tmp_path / "shards").iterdir()) == []
    begun = tmp_path / "shards" / f"{cached_path(frames, OPTIONS).name}.partial" / "shards"
    begun.mkdir(parents=True)
    (begun / "train-00000.tar").write_bytes(bytes(10**6))  # what is there already needs no room
    assert prepare_cached(frames, OPTIONS).count("test") == 4


@pytest.mark.parametrize(("count", "cores", "processes"), [(50, 4, 1), (51, 4, 4), (51, 64, 8)])
def test_many_frames_are_cached_by_several_processes(frames, tmp_path, monkeypatch, count, cores, processes):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path))
    monkeypatch.setattr("data.shards.prepare.os.cpu_count", lambda: cores)
    monkeypatch.setattr("data.shards.prepare.MANY_FRAMES", 12 + 50 - count)  # the set has 12
    used = []
    monkeypatch.setattr("data.shards.prepare.prepare", lambda *a, processes, **k: used.append(processes))
    prepare_cached(frames, OPTIONS)
    assert used == [processes]


def test_a_script_without_a_main_guard_fills_the_cache_by_several_processes(frames, expected, tmp_path):
    script = tmp_path / "train.py"
    script.write_text(
        "import sys\nfrom pathlib import Path\nimport data.shards.prepare as module\n"
        "from tests.data.small_sets import OPTIONS\nmodule.MANY_FRAMES = 1\n"
        "module.os.cpu_count = lambda: 2\n"
        "print(module.prepare_cached(Path(sys.argv[1]), OPTIONS).root)\n"
    )
    environment = {
        **os.environ,
        "PENUMBRA_CACHE": str(tmp_path),
        "PYTHONPATH": str(Path(__file__).parents[2]),
    }
    made = subprocess.run(
        [sys.executable, script, frames],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
        timeout=60,
    )
    assert content(Path(made.stdout.strip())) == expected
    assert made.stderr.count("preparing frames") == 1


def test_cached_shards_of_earlier_code_are_not_taken(frames, tmp_path, monkeypatch):
    monkeypatch.setenv("PENUMBRA_CACHE", str(tmp_path))
    before = cached_path(frames, OPTIONS)
    assert cached_path(frames, OPTIONS) == before
    monkeypatch.setattr("data.shards.prepare.CUT_VERSION", CUT_VERSION + 1)
    assert cached_path(frames, OPTIONS) != before


def test_the_index_holds_manifest_options_and_checksums(expected: dict[str, bytes], frames: Path):
    index = json.loads(expected[INDEX])
    assert (index["format"], index["version"]) == ("penumbra-shards", 1)
    assert index["manifest_hash"] == FrameSet(frames).manifest.hash
    assert index["options"]["patch_size"] == 16
    assert {shard["file"] for shard in index["shards"]} == set(expected) - {INDEX}
