import math

import numpy as np
import pytest
import torch

from data.frame import Frame
from data.frames import FrameSet
from data.root import resolve_root
from trainer.metrics.functional import gamma
from trainer.metrics.temporal import change_gamma, flicker_gamma, places_before


def moving(height=12, width=16, right=0.0, index=0):
    """A frame all of whose pixels moved to the left since the frame before by `right` pixels."""
    motion = np.zeros((height, width, 2), np.float32)
    motion[..., 0] = right
    return Frame(
        {"motion": motion, "normal": np.tile(np.float32([0, 0, 1]), (height, width, 1))}, "wall", index
    )


def image(seed, height=12, width=16):
    return torch.rand(3, height, width, generator=torch.Generator().manual_seed(seed))


def test_a_picture_that_moves_as_a_whole_does_not_change():
    places = places_before(moving(right=3.0), moving())
    before = image(0)
    now = torch.roll(before, -3, -1)
    assert change_gamma(now, before, places) == 0
    assert change_gamma(now, now, places) > 0.01
    assert (places[0] >= 0).sum() == 12 * 13


def test_error_that_stays_does_not_flicker_and_error_that_comes_does():
    places = places_before(moving(), moving())
    reference, constant = image(1), 0.1
    off = (gamma(reference) * 0.8 + constant).pow(1 / 0.454545)
    assert flicker_gamma(off, off, reference, reference, places) == pytest.approx(0, abs=1e-6)
    found = flicker_gamma(off, reference, reference, reference, places)
    assert found == pytest.approx(float((gamma(off) - gamma(reference)).abs().mean()), rel=1e-5)


def test_surfaces_that_were_not_seen_before_do_not_count():
    last = moving()
    last.buffers["normal"][:, :8] = [0, 0, -1]
    places = places_before(moving(), last)
    assert (places[:, :, :8] == -1).all()
    assert (places[:, :, 8:] >= 0).all()
    changed = image(2)
    changed[..., :8] = 5
    assert change_gamma(changed, torch.where(changed == 5, 0.0, changed), places) == 0


def test_nothing_seen_before_is_no_number():
    places = places_before(moving(right=100.0), moving())
    assert math.isnan(change_gamma(image(3), image(4), places))


def test_references_of_a_real_sequence_change_less_than_its_noise():
    frames = FrameSet(resolve_root("sample:bmfr").path)
    scene = frames.scenes()[0]
    first, second = (frames.read(scene, record.index) for record in frames.frames(scene)[:2])
    places = places_before(second, first)
    assert (places[0] >= 0).mean() > 0.8

    def tensor(frame, name):
        return torch.from_numpy(np.ascontiguousarray(frame.buffers[name].transpose(2, 0, 1)))

    noise = change_gamma(tensor(second, "color"), tensor(first, "color"), places)
    still = change_gamma(tensor(second, "reference"), tensor(first, "reference"), places)
    nothing = change_gamma(
        tensor(second, "reference"), tensor(first, "reference"), places_before(*[moving(180, 320)] * 2)
    )
    assert still < nothing
    assert still < 0.05 * noise


def test_a_frame_that_cannot_be_followed_says_what_it_lacks():
    bare = Frame({"normal": np.ones((4, 4, 3), np.float32)}, "s", 1)
    with pytest.raises(ValueError, match="motion"):
        places_before(bare, bare)
