"""What the data report finds before training: one fact each, planted into a good data set."""

import numpy as np
import pytest

from data.frames import FrameSet
from tests.data.miniature import ingested
from tests.trainer.test_data_report import levels, made, report, texts
from trainer.reports.data_report import examine
from trainer.reports.findings import findings


def found_in(tmp_path, change, **notes):
    """Return what is found in a set whose first scene's frame is changed."""
    frame = levels(views=1, spps=(16,))[0]
    frame.notes.update(notes)
    root = made(tmp_path / "set", {"a": [change(frame)], "b": levels("classroom")})
    frames = FrameSet(root)
    return [f for f in findings(frames.manifest, examine(frames), []) if "a" in f.scenes]


def buffers(**changes):
    def change(frame):
        kept = frame.with_buffers()
        for name, function in changes.items():
            if function is None:
                del kept.buffers[name]
            else:
                kept.buffers[name] = function(kept.buffers[name]).astype(np.float32)
        return kept

    return change


def same(frame):
    return frame


def longer(normal):
    return normal * 1.3


def quantised(image):
    return np.round(np.clip(image, 0, 1) * 255) / 255


@pytest.mark.parametrize(
    ("change", "notes", "level", "text"),
    [
        (buffers(reference=None), {}, "warning", "1 frame has no reference"),
        (same, {"repaired": {"color": 3, "depth": 1}}, "warning", "4 pixels in 1 frame were NaN or Inf"),
        (same, {"checks": {"energy_z": -4.5}}, "warning", "differ in mean radiance by more than 4"),
        (buffers(color=lambda c: c * 1.5), {}, "warning", "differ in mean radiance by more than 4"),
        (same, {"checks": {"reference_relmse": 1.0}}, "warning", "is itself noisy"),
        (same, {"reference_spp": 64}, "warning", "less than 8 times the input's samples"),
        (buffers(color=quantised), {}, "warning", "looks 8-bit or tone-mapped"),
        (buffers(albedo=lambda a: a * 0 + 1.5), {}, "warning", "albedo: values outside"),
        (buffers(normal=longer), {}, "warning", "not unit vectors"),
        (buffers(normal=lambda n: n * 0.5 + 0.5), {}, "warning", "not unit vectors"),
        (buffers(normal=lambda n: n * 0), {}, "note", "normal: the same in all pixels"),
        (buffers(color=lambda c: np.where(np.arange(48)[:, None] < 8, 1e3, c)), {}, "note", "fireflies"),
    ],
)
def test_what_would_spoil_training_is_found(tmp_path, change, notes, level, text):
    found = found_in(tmp_path, change, **notes)
    assert text in texts(found, level)


def test_nothing_is_found_in_a_good_frame(tmp_path):
    assert found_in(tmp_path, same) == []


def test_an_energy_score_within_limits_is_not_reported(tmp_path):
    assert found_in(tmp_path, same, checks={"energy_z": 3.9, "reference_relmse": 1e-6}) == []


def test_missing_licences_splits_and_buffers_are_found(tmp_path):
    bare = buffers(depth=None, position=None)(levels(views=1, spps=(4,))[0])
    root = made(
        tmp_path / "set",
        {"a": [bare], "b": levels("classroom")},
        {"train": ["a", "b"], "validation": [], "test": []},
        b={"license": ""},
    )
    found, _ = report(root, tmp_path)
    assert "1 scene does not state a licence" in texts(found, "warning")
    assert "no scene in split test" in texts(found, "note")
    (missing,) = [f for f in found if f.text.startswith("missing in frames")]
    assert missing.scenes == ("a",)
    assert "depth" in missing.text
    assert "position" in missing.text


def test_problems_come_first(tmp_path):
    root = ingested(tmp_path)
    (root / "classroom" / "f001.exr").write_bytes(b"x")
    order = [f.level for f in report(root, tmp_path)[0]]
    assert order == sorted(order, key=["problem", "warning", "note"].index)
    assert order[0] == "problem"
