import math

import flip_evaluator
import numpy as np
import pytest
import torch

from data.frames import FrameSet
from data.root import resolve_root
from trainer.metrics.flip import exposures, flip_hdr, flip_hdr_map, flip_ldr_map


@pytest.fixture(scope="module")
def frames():
    """Noisy and reference radiance of a frame of each shipped scene, (H, W, 3)."""
    found = FrameSet(resolve_root("sample:bmfr").path)
    read = [found.read(scene, found.frames(scene)[0].index) for scene in found.scenes()]
    return [(frame.buffers["color"], frame.buffers["reference"]) for frame in read]


def tensor(image):
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]


def authors(output, reference, kind):
    """Return the map and the parameters of the authors' program."""
    found, _, used = flip_evaluator.evaluate(
        np.ascontiguousarray(reference), np.ascontiguousarray(output), kind, inputsRGB=False, applyMagma=False
    )
    return found[..., 0], used


def test_ldr_flip_equals_the_authors_program(frames):
    for output, reference in frames:
        pair = [np.clip(image, 0, 1) for image in (output, reference)]
        expected, _ = authors(*pair, "LDR")
        found = flip_ldr_map(*map(tensor, pair))[0].numpy()
        np.testing.assert_allclose(found, expected, atol=1e-4)
        assert found.mean() == pytest.approx(expected.mean(), abs=1e-5)


def test_hdr_flip_and_its_exposures_equal_the_authors_program(frames):
    for output, reference in frames:
        expected, used = authors(output, reference, "HDR")
        np.testing.assert_allclose(
            flip_hdr_map(tensor(output), tensor(reference))[0].numpy(), expected, atol=1.5e-4
        )
        stops = exposures(tensor(reference)[0])
        assert len(stops) == used["numExposures"]
        assert [stops[0], stops[-1]] == pytest.approx([used["startExposure"], used["stopExposure"]], abs=1e-3)
        mean = float(flip_hdr(tensor(output), tensor(reference)))
        assert mean == pytest.approx(expected.mean(), abs=1e-5)


def test_equal_images_differ_by_nothing():
    image = 3 * torch.rand(2, 3, 40, 30)
    assert flip_hdr(image, image).tolist() == [0, 0]
    assert flip_ldr_map(image, image).max() == 0


def test_exposure_of_both_changes_nothing(frames):
    output, reference = (tensor(image)[..., :60, :80] for image in frames[0])
    assert float(flip_hdr(8 * output, 8 * reference)) == pytest.approx(
        float(flip_hdr(output, reference)), abs=1e-4
    )


@pytest.mark.parametrize("value", [0.0, 65504.0, math.inf, math.nan, -1.0])
def test_flip_of_extreme_values_is_a_number_up_to_one(value):
    reference = torch.rand(1, 3, 24, 24)
    broken = reference.clone()
    broken[..., 10, 10] = value
    for found in (flip_hdr(broken, reference), flip_hdr(reference, broken), flip_hdr(broken, broken * 0)):
        assert 0 <= float(found) <= 1


def test_a_batch_is_its_images_one_by_one():
    output, reference = (
        torch.rand(2, 3, 20, 20),
        torch.rand(2, 3, 20, 20) + torch.tensor([0.0, 4]).view(2, 1, 1, 1),
    )
    alone = [float(flip_hdr(o[None], r[None])) for o, r in zip(output, reference, strict=True)]
    assert flip_hdr(output, reference).tolist() == pytest.approx(alone, abs=1e-6)
